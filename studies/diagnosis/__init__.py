"""Figures of docs/diagnosis.md."""
