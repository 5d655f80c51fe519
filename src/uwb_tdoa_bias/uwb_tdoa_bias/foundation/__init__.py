"""What everything else stands on: flights, anchors, geometry, antennas, stamps, errors, compiled
code, and what talks ROS.
"""
