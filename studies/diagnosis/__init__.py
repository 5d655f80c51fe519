"""Figures of docs/notebook/diagnosis.md."""
