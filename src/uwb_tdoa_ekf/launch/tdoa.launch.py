# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""All nodes of one tag.

ros2 launch uwb_tdoa_ekf tdoa.launch.py anchors_file:=anchors.yaml ros2 launch uwb_tdoa_ekf
tdoa.launch.py namespace:=tag1 ekf_params:=my_ekf.yaml publish_tf:=odom rviz:=true ros2 launch
uwb_tdoa_ekf tdoa.launch.py --show-args
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration

from uwb_tdoa_ekf.launching import FROZEN, NETWORK, RESPAWN, start, tag, typed
from uwb_tdoa_ekf.launching_actions import actions

if TYPE_CHECKING:
    from launch.action import Action
    from launch.launch_context import LaunchContext

# parameters of the nodes; one that is not given is what the files say, or the node's default
VALUES = {
    "anchors_file": "survey of the anchors; without it they come on uwb/anchors",
    "effects_file": "effects.yaml that diagnose wrote",
    "model_file": "ONNX bias model",
    "map": "map.npz that debias wrote; starts debias_node",
    "world_frame": "frame of the odometry",
    "body_frame": "frame of the robot",
    "publish_tf": "none, base (map -> base_link) or odom (map -> odom, REP 105)",
    "odom_frame": "frame of the robot's own odometry, for publish_tf odom",
    "use_sim_time": "true for bags that are played with --clock",
    "frozen": FROZEN,
}
OTHERS = {
    "namespace": ("", "one per tag; the topics are relative to it"),
    "bias_params": ("", "parameter file of bias_node, which the values above override"),
    "ekf_params": ("", "parameter file of ekf_node, which the values above override"),
    "log_level": ("info", "debug, info, warn, error"),
    "rviz": ("false", "true opens RViz with the tag, its covariance and the anchors"),
}


def generate_launch_description() -> LaunchDescription:
    """Arguments, and what follows from them."""
    arguments = [
        DeclareLaunchArgument(name, default_value="", description=text)
        for name, text in VALUES.items()
    ]
    arguments += [
        DeclareLaunchArgument(name, default_value=default, description=text)
        for name, (default, text) in OTHERS.items()
    ]
    arguments += [
        DeclareLaunchArgument(name, default_value=default, description=text, choices=choices)
        for name, (default, text, choices) in (RESPAWN | NETWORK).items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list[Action]:
    values = typed({name: LaunchConfiguration(name).perform(context) for name in VALUES})
    given = {
        name: LaunchConfiguration(name).perform(context) for name in (*OTHERS, *RESPAWN, *NETWORK)
    }
    files = {
        node: [given[key]]
        for node, key in (("bias_node", "bias_params"), ("ekf_node", "ekf_params"))
        if given[key]
    }
    starts = tag(given["namespace"], values, files, given["log_level"])
    if "anchors_file" in values:
        starts.append(start("anchors_node", given["namespace"], values, (), given["log_level"]))
    return actions(
        starts,
        *(given[name] for name in (*RESPAWN, *NETWORK, "rviz")),
        values.get("use_sim_time", False),
    )
