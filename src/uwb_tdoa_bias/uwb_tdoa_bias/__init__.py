"""The measurement side: anchors, TDOA geometry, features, effects and the network. No ROS outside bias_node and ros.py."""
