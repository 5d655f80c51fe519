"""The compiled filter: states, prediction, robust updates, hypotheses and initialization.

It uses no ROS and no files.
"""
