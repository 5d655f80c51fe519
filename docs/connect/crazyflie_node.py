# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Log blocks of one Crazyflie, as crazyswarm2 publishes them, to uwb/tdoa and imu/data.

In crazyflies.yaml, for the robot type or the robot:

    firmware_logging:
      enabled: true
      custom_topics:
        tdoa_a:
          frequency: 100
          vars: ["tdoa2.d7-0", "tdoa2.d0-1", "tdoa2.d1-2", "tdoa2.d2-3", "tdoa2.d3-4", "tdoa2.d4-5"]
        tdoa_b: {frequency: 100, vars: ["tdoa2.d5-6", "tdoa2.d6-7"]}
        imu: {frequency: 100, vars: ["gyro.x", "gyro.y", "gyro.z", "acc.x", "acc.y", "acc.z"]}

then: python3 crazyflie_node.py --ros-args -r __ns:=/cf1

Without crazyswarm2, autopilot_node does this by cflib (docs/autopilot.md).
"""

import sys

import rclpy
from rclpy.executors import ExternalShutdownException

from uwb_tdoa_tools.autopilot.crazyflie import VehicleTopics
from uwb_tdoa_tools.crazyflie import LogBlock

try:
    from crazyflie_interfaces.msg import LogDataGeneric
except ImportError:
    sys.exit(
        "crazyflie_node: error: crazyflie_interfaces is not installed; install crazyswarm2 "
        "and source it."
    )

BLOCKS = {
    "tdoa_a": ["tdoa2.d7-0", "tdoa2.d0-1", "tdoa2.d1-2", "tdoa2.d2-3", "tdoa2.d3-4", "tdoa2.d4-5"],
    "tdoa_b": ["tdoa2.d5-6", "tdoa2.d6-7"],
    "imu": ["gyro.x", "gyro.y", "gyro.z", "acc.x", "acc.y", "acc.z"],
}


def main():
    rclpy.init()
    node = rclpy.create_node("crazyflie_node")
    topics = VehicleTopics(node, ["tdoa", "imu"])

    def on_block(message, block):
        arrival = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        topics.take(block, message.timestamp, message.values, arrival)

    for topic, variables in BLOCKS.items():
        block = LogBlock(variables)
        node.create_subscription(
            LogDataGeneric, topic, lambda message, block=block: on_block(message, block), 100
        )
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    node.destroy_node()  # before the interpreter ends, in whatever order it frees what is left
    rclpy.try_shutdown()


if __name__ == "__main__":
    main()
