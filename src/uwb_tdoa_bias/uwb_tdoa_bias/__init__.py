"""Measurement side: anchors, TDOA geometry, features, effects and the network.

Only the nodes and `ros/` use ROS.
"""
