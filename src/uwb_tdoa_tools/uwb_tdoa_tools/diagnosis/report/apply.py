"""How effects.yaml is put to use."""

APPLY = (  # command, what it does
    (
        "ros2 run uwb_tdoa_tools evaluate FLIGHT --effects effects.yaml",
        "judges it on another flight; give --survey as for diagnose",
    ),
    ("ros2 run uwb_tdoa_bias bias_node --ros-args -p effects_file:=effects.yaml", "in flight: takes it out of TDOAs"),
    ("ros2 run uwb_tdoa_ekf ekf_node --ros-args -p effects_file:=effects.yaml", "in flight: takes it out of the IMU"),
)
