"""Recordings judged by their ground truth: one after the other, and as a table."""
