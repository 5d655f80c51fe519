"""A bag through the nodes of one tag, on the time of the bag.

ros2 launch uwb_tdoa_ekf bag.launch.py bag:=flight.bag
ros2 launch uwb_tdoa_ekf bag.launch.py bag:=flight.bag rate:=2 anchors_file:=anchors.yaml rviz:=true
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration

DELAY = "3"  # s until the nodes have been discovered: what is played before is lost


def generate_launch_description():
    """tdoa.launch.py, whose arguments all work here too, on simulated time, and ros2 bag play."""
    tag = PythonLaunchDescriptionSource(str(Path(__file__).with_name("tdoa.launch.py")))
    play = ["ros2", "bag", "play", LaunchConfiguration("bag"), "--clock", "200", "--delay", DELAY]
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="path of the bag"),
            DeclareLaunchArgument("rate", default_value="1.0", description="times as fast as recorded"),
            IncludeLaunchDescription(tag, launch_arguments={"use_sim_time": "true"}.items()),
            ExecuteProcess(cmd=[*play, "--rate", LaunchConfiguration("rate")], output="screen"),
        ]
    )
