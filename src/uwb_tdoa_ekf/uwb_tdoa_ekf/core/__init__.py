"""The filter itself, compiled: states, prediction, robust updates, hypotheses, start.

No ROS, no files.
"""
