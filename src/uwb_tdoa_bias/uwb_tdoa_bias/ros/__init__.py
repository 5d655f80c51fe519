"""Nodes, topics, parameters, frames and diagnostics: all code that uses ROS."""
