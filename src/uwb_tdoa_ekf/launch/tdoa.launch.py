"""Both nodes of one tag:  ros2 launch uwb_tdoa_ekf tdoa.launch.py namespace:=tag1 bias_params:=my_bias.yaml"""

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    """The nodes read their documented defaults unless another parameter file is given."""
    bias, ekf = (get_package_share_directory(f"uwb_tdoa_{name}") for name in ("bias", "ekf"))
    return LaunchDescription(
        [
            DeclareLaunchArgument("namespace", default_value="", description="one per tag; the topics are relative to it"),
            DeclareLaunchArgument("bias_params", default_value=f"{bias}/config/bias_node.yaml"),
            DeclareLaunchArgument("ekf_params", default_value=f"{ekf}/config/ekf_node.yaml"),
            Node(
                package="uwb_tdoa_bias",
                executable="bias_node",
                namespace=LaunchConfiguration("namespace"),
                parameters=[LaunchConfiguration("bias_params")],
            ),
            Node(
                package="uwb_tdoa_ekf",
                executable="ekf_node",
                namespace=LaunchConfiguration("namespace"),
                parameters=[LaunchConfiguration("ekf_params")],
            ),
        ]
    )
