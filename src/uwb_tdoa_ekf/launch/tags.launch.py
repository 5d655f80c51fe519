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

from typing import TYPE_CHECKING

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration

from uwb_tdoa_ekf.launching import FROZEN, NETWORK, RESPAWN, tags, typed
from uwb_tdoa_ekf.launching_actions import actions

if TYPE_CHECKING:
    from launch.action import Action
    from launch.launch_context import LaunchContext

OTHERS = {
    "processes": (
        "",
        (
            "localization_nodes that share the tags: a number, or auto, one for each core; "
            "default: as the file says, or two nodes for each tag"
        ),
    ),
    "use_sim_time": ("", "true for bags that are played with --clock"),
    "frozen": ("", FROZEN),
    "log_level": ("info", "debug, info, warn, error"),
    "rviz": ("false", "true opens RViz with the frames and the anchors"),
}


def generate_launch_description() -> LaunchDescription:
    """Arguments, and what follows from them and the file."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in OTHERS.items()
    ]
    arguments += [
        DeclareLaunchArgument(
            name,
            default_value="stay" if name == "on_exit" else default,
            description=text,
            choices=choices,
        )
        for name, (default, text, choices) in (RESPAWN | NETWORK).items()
    ]  # one tag does not take the others along
    file = DeclareLaunchArgument("tags", description="YAML file of the tags")
    return LaunchDescription([file, *arguments, OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list[Action]:
    given = {
        name: LaunchConfiguration(name).perform(context)
        for name in ("tags", *OTHERS, *RESPAWN, *NETWORK)
    }
    values = typed({name: given[name] for name in ("use_sim_time", "frozen")})
    starts = tags(given["tags"], values, given["log_level"], given["processes"])
    return actions(
        starts,
        *(given[name] for name in (*RESPAWN, *NETWORK, "rviz")),
        values.get("use_sim_time", False),
    )
