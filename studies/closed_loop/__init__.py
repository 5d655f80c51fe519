"""Figures of docs/flying.md: the experiment of the paper."""
