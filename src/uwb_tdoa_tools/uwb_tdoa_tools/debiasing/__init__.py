"""Fit bias maps of positions, and evaluate them on flights."""
