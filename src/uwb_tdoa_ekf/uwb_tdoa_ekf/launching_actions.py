"""What launching.py says, as actions of launch_ros."""

from ament_index_python.packages import get_package_share_directory


def node_action(node, start):
    """The action of a Start. node : launch_ros.actions.Node."""
    return node(
        package=start.package,
        executable=start.executable,
        name=start.name,
        namespace=start.namespace,
        parameters=start.parameters,
        arguments=["--ros-args", "--log-level", start.log_level],
        output="screen",
    )


def rviz_action(node, use_sim_time):
    """RViz with our layout."""
    layout = f"{get_package_share_directory('uwb_tdoa_ekf')}/rviz/tdoa.rviz"
    return node(
        package="rviz2", executable="rviz2", arguments=["-d", layout], parameters=[{"use_sim_time": use_sim_time}]
    )
