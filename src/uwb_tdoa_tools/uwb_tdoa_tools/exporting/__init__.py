"""Corrections as one file for other runtimes: effects and network, traced, then printed."""
