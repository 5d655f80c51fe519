"""Figures of docs/notebook/flying.md: the experiment of the paper."""
