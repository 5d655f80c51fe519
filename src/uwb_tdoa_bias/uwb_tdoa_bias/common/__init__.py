"""Types that all packages share: flights, anchors, geometry, radio, surveys, stamps, files.

This folder uses no ROS.
"""
