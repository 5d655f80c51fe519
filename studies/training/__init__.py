"""Figures of docs/bias.md, and the model that is shipped."""
