# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Several tags of one YAML file, each in its own namespace and with its own frame.

ros2 launch uwb_tdoa_ekf tags.launch.py tags:=tags.yaml
ros2 launch uwb_tdoa_ekf tags.launch.py tags:=tags.yaml processes:=auto    # takes a fraction of the CPU time

    anchors_file: anchors.yaml        # what all share: any parameters of bias_node and ekf_node
    processes: auto                   # localization_nodes that share the tags: one for each core
    tags:
      tag1: {}                        # topics /tag1/imu/data ..., frame tag1/base_link
      tag2: {effects_file: tag2.yaml, tdoa_std: 0.3}
"""

from __future__ import annotations

from launch import LaunchDescription

from uwb_tdoa_ekf.launching_actions import description


def generate_launch_description() -> LaunchDescription:
    """Arguments, and what follows from them and the file."""
    return description("tags.launch.py")
