"""Localizing: trajectories of recordings without ground truth, and how reliable they are."""
