"""Estimate the state of a tag: error-state filter, robust weights, initialization, time ordering.

Only the nodes use ROS.
"""
