"""Figures of docs/notebook/bias.md, and the model that is shipped."""
