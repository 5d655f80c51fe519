# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A bag through the nodes of one tag, on the time of the bag.

ros2 launch uwb_tdoa_ekf bag.launch.py bag:=flight_bag
ros2 launch uwb_tdoa_ekf bag.launch.py bag:=flight_bag rate:=2 anchors_file:=anchors.yaml rviz:=true
"""

from __future__ import annotations

from pathlib import Path

from launch import LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    ExecuteProcess,
    IncludeLaunchDescription,
    Shutdown,
    TimerAction,
)
from launch.events.process import ProcessExited
from launch.launch_context import LaunchContext
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

DELAY = "3"  # s until the nodes have been discovered: what is played before is lost
REST = 2.0  # s after the end of the bag, in which the nodes publish what they still wait with


def generate_launch_description() -> LaunchDescription:
    """tdoa.launch.py, whose arguments all work here too, on simulated time, and ros2 bag play; ends
    when the bag does.
    """
    tag = PythonLaunchDescriptionSource(str(Path(__file__).with_name("tdoa.launch.py")))
    play = ["ros2", "bag", "play", LaunchConfiguration("bag"), "--clock", "200", "--delay", DELAY]
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="path of the bag"),
            DeclareLaunchArgument(
                "rate", default_value="1.0", description="times as fast as recorded"
            ),
            DeclareLaunchArgument(
                "at_end",
                default_value="shutdown",
                choices=["shutdown", "stay"],
                description="of the bag: shutdown ends all, stay leaves nodes and RViz as they are",
            ),
            DeclareLaunchArgument(
                "respawn", default_value="false", description="a node that crashes is to be seen"
            ),
            IncludeLaunchDescription(tag, launch_arguments={"use_sim_time": "true"}.items()),
            ExecuteProcess(
                cmd=[*play, "--rate", LaunchConfiguration("rate")], output="screen", on_exit=_played
            ),
        ]
    )


def _played(event: ProcessExited, context: LaunchContext) -> TimerAction | None:
    """What follows when ros2 bag play has ended."""
    if context.is_shutdown:
        return None
    if event.returncode:
        raise RuntimeError(
            f"ros2 bag play has ended with exit code {event.returncode}; it says above why"
        )
    if LaunchConfiguration("at_end").perform(context) == "stay":
        return None
    return TimerAction(period=REST, actions=[Shutdown(reason="the bag is over")])
