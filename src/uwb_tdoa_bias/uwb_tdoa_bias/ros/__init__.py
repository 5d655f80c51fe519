"""Nodes, topics, parameters, frames and diagnostics: all that touches ROS."""
