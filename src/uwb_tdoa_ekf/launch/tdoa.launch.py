# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""All nodes of one tag.

ros2 launch uwb_tdoa_ekf tdoa.launch.py anchors_file:=anchors.yaml
ros2 launch uwb_tdoa_ekf tdoa.launch.py namespace:=tag1 ekf_params:=my_ekf.yaml publish_tf:=odom rviz:=true
ros2 launch uwb_tdoa_ekf tdoa.launch.py --show-args
"""

from __future__ import annotations

from launch import LaunchDescription

from uwb_tdoa_ekf.launching_actions import description


def generate_launch_description() -> LaunchDescription:
    """Arguments, and what follows from them."""
    return description("tdoa.launch.py")
