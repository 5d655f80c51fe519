"""The estimation side: error-state filter, robust weights, start-up, time ordering.

No ROS outside the nodes.
"""
