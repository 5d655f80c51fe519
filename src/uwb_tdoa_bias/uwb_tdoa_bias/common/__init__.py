# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Types that all packages share: flights, anchors, geometry, radio, surveys, stamps, files.

This folder uses no ROS.
"""
