"""Surveying: better anchors from rough positions and flights."""
