"""The measurement side: anchors, TDOA geometry, features, effects and the network.

No ROS outside the nodes and ros*.py.
"""
