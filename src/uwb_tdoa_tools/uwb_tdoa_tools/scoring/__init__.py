"""Estimates against ground truth: figures, pictures, files for others."""
