"""Figures of docs/notebook/debiasing.md."""
