"""Figures of docs/debiasing.md."""
