"""Benchmarks of diagnose: the figures of docs/diagnosis.md."""
