# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Turn the decisions of launching.py into actions of launch."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
import os
import time

from ament_index_python.packages import get_package_share_directory
from launch.action import Action
from launch.actions import DeclareLaunchArgument, LogInfo, OpaqueFunction, TimerAction
from launch.events.process import ProcessExited
from launch.launch_context import LaunchContext
from launch.launch_description import LaunchDescription
import launch.logging
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.executable import leave_present_folder_out

from .launching import LAUNCH_FILES, Lives, Start, discovery, network


def description(name: str) -> LaunchDescription:
    """Return the LaunchDescription of one of the LAUNCH_FILES."""
    file = LAUNCH_FILES[name]

    def nodes(context: LaunchContext) -> list[Action]:
        given = {name: LaunchConfiguration(name).perform(context) for name in file.arguments}
        used = {name: given[name] for name in ("respawn", "on_exit", "discovery_range", "rviz")}
        simulated = given["use_sim_time"] or "false"
        return actions(file.starts(given), **used, use_sim_time=simulated)

    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=text, choices=choices)
        for name, (default, text, choices) in file.arguments.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=nodes)])


def actions(
    starts: Iterable[Start],
    respawn: str,
    on_exit: str,
    discovery_range: str,
    rviz: str,
    use_sim_time: str = "false",
) -> list[Action]:
    """Return the launch actions of several Starts: a message on the network, the nodes, and RViz.

    Parameters
    ----------
    starts : iterable of Start
        Nodes to start.
    respawn, on_exit, discovery_range, rviz, use_sim_time : str
        Values of the launch arguments with these names. RViz starts if `rviz` is "true".
    """
    leave_present_folder_out()  # launched processes inherit this environment
    of_nodes = discovery(os.environ, discovery_range)
    nodes = [
        _node(each, Lives(each.label, respawn == "true", on_exit), of_nodes) for each in starts
    ]
    return [
        LogInfo(msg=network({**os.environ, **of_nodes})),
        *nodes,
        *([_rviz(use_sim_time)] if rviz == "true" else []),
    ]


def _node(start: Start, lives: Lives, variables: Mapping[str, str]) -> Node:
    """Return the launch action of a Start; its Lives decide whether it starts again.

    Parameters go on the command line, because launch_ros does not delete its parameter files.
    """
    began = time.monotonic()

    def on_exit(event: ProcessExited, context: LaunchContext) -> Action | None:
        if context.is_shutdown:
            return None
        then = lives.ended(event.returncode, time.monotonic() - began)
        if then.everything:
            raise InputError(then.text)  # ends the launch with exit code 1
        if then.text:
            launch.logging.get_logger("launch.user").error(then.text)
        again = OpaqueFunction(function=lambda _: [_node(start, lives, variables)])
        return None if then.again is None else TimerAction(period=then.again, actions=[again])

    return Node(
        package=start.package,
        executable=start.executable,
        name=start.name,
        namespace=start.namespace,
        ros_arguments=start.words,
        additional_env=variables,
        output="screen",
        on_exit=on_exit,
    )


def _rviz(use_sim_time: str) -> Node:
    """Return the launch action of RViz with the layout of this package."""
    layout = f"{get_package_share_directory('uwb_tdoa_ekf')}/rviz/tdoa.rviz"
    parameters = ["-p", f"use_sim_time:={str(use_sim_time).lower()}"]
    return Node(
        package="rviz2", executable="rviz2", arguments=["-d", layout], ros_arguments=parameters
    )
