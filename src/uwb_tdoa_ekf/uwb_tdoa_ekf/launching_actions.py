"""What launching.py says, as actions of launch."""

import os
import time

from ament_index_python.packages import get_package_share_directory
from launch.actions import LogInfo, OpaqueFunction, TimerAction
import launch.logging
from launch_ros.actions import Node
from uwb_tdoa_bias.foundation.errors import InputError

from .launching import Lives, discovery, network


def actions(starts, respawn, on_exit, discovery_range, rviz, use_sim_time=False):
    """Of [Start]s, as texts of launch arguments say: what is told of the network, the nodes, and RViz if rviz is "true"."""
    of_nodes = discovery(os.environ, discovery_range)
    nodes = [_node(each, Lives(each.label, respawn == "true", on_exit), of_nodes) for each in starts]
    return [LogInfo(msg=network({**os.environ, **of_nodes})), *nodes, *([_rviz(use_sim_time)] if rviz == "true" else [])]


def _node(start, lives, variables):
    """The action of a Start, which its Lives may have started again. Nothing is told to it by a file that launch_ros would leave."""
    began = time.monotonic()

    def on_exit(event, context):
        if context.is_shutdown:
            return None
        then = lives.ended(event.returncode, time.monotonic() - began)
        if then.everything:
            raise InputError(then.text)  # ends the launch, which then ends with code 1
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


def _rviz(use_sim_time):
    """RViz with our layout."""
    layout = f"{get_package_share_directory('uwb_tdoa_ekf')}/rviz/tdoa.rviz"
    told = ["-p", f"use_sim_time:={str(use_sim_time).lower()}"]
    return Node(package="rviz2", executable="rviz2", arguments=["-d", layout], ros_arguments=told)
