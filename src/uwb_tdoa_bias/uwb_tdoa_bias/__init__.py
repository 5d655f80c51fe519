# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measurement side: anchors, TDOA geometry, features, effects and the network.

Only the nodes and `ros/` use ROS.
"""
