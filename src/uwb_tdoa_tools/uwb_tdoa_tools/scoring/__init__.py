"""Scoring: errors of estimates against ground truth."""
