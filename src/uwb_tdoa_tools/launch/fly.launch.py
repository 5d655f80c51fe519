# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A simulated vehicle, and the nodes that it flies by.

ros2 launch uwb_tdoa_tools fly.launch.py
ros2 launch uwb_tdoa_tools fly.launch.py mission:=true seed:=7 simulated_time:=true rviz:=true
ros2 launch uwb_tdoa_tools fly.launch.py --show-args
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import os

from launch import LaunchDescription
from launch.action import Action
from launch.actions import DeclareLaunchArgument, OpaqueFunction, Shutdown
from launch.events.process import ProcessExited
from launch.launch_context import LaunchContext
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from uwb_tdoa_ekf.launching import FROZEN, NETWORK, Start, discovery, tag, typed
from uwb_tdoa_ekf.launching_actions import actions
from uwb_tdoa_tools.flying.rover import FILTER

VALUES = {  # parameters of vehicle_node; one that is not given is its default
    "vehicle": "quadrotor, or rover, which drives, with mission alone",
    "world": "what it flies in (docs/flying.md)",
    "seed": "of all that is random",
    "told": "place or nothing: what it tells the filter at the start",
    "mission": "true: fly the standard mission, say what became of it, and end",
    "simulated_time": "true: publish /clock, and wait for the odometry; else in real time",
    "duration": "s; how long it can be flown, without the mission",
}
OTHERS = {
    "effects_file": ("", "effects.yaml that diagnose wrote"),
    "frozen": ("", FROZEN),
    "namespace": ("", "of the vehicle; the topics are relative to it"),
    "log_level": ("info", "debug, info, warn, error"),
    "rviz": ("false", "true opens RViz with the estimate, the truth and the anchors"),
}
NUMBERS = {"seed": int, "duration": float}


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
        for name, (default, text, choices) in NETWORK.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=_nodes)])


def _nodes(context: LaunchContext) -> list[Action]:
    values = typed({name: LaunchConfiguration(name).perform(context) for name in VALUES})
    values |= {
        name: _number(kind, values[name]) for name, kind in NUMBERS.items() if name in values
    }
    given = {name: LaunchConfiguration(name).perform(context) for name in (*OTHERS, *NETWORK)}
    simulated = values.get("simulated_time", False)
    of_nodes = {"use_sim_time": simulated} | typed(
        {name: given[name] for name in ("effects_file", "frozen")}
    )
    if values.get("vehicle") == "rover":
        of_nodes |= FILTER
    starts = tag(given["namespace"], of_nodes, None, given["log_level"])
    vehicle = Start(
        "uwb_tdoa_tools", "vehicle_node", given["namespace"], [values], given["log_level"]
    )
    return [
        *actions(starts, "false", "shutdown", given["discovery_range"], given["rviz"], simulated),
        _vehicle(vehicle, discovery(os.environ, given["discovery_range"])),
    ]


def _number(kind: Callable[[str], float], text: str) -> float | str:
    """A number, or the text where it is none: the node says so."""
    try:
        return kind(text)
    except ValueError:
        return text


def _vehicle(start: Start, variables: Mapping[str, str]) -> Node:
    """The action of its Start; all ends with it."""
    return Node(
        package=start.package,
        executable=start.executable,
        namespace=start.namespace,
        ros_arguments=start.words,
        additional_env=variables,
        output="screen",
        on_exit=_ended,
    )


def _ended(event: ProcessExited, context: LaunchContext) -> Shutdown | None:
    if context.is_shutdown:
        return None
    if event.returncode:
        raise RuntimeError(
            f"vehicle_node has ended with exit code {event.returncode}; it says above why"
        )
    return Shutdown(reason="the flight is over")
