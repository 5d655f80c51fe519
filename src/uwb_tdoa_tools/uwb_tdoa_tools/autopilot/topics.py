# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Publish the samples that a Crazyflie logs on the topics of a robot."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

from geometry_msgs.msg import Vector3
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import FluidPressure, Imu, Range

from uwb_tdoa_bias.common.sensors.height import FIELD_OF_VIEW, INFRARED, LONGEST_RANGE
from uwb_tdoa_bias.ros.topics import OUTPUT_QOS
from uwb_tdoa_msgs.msg import Tdoa

from ..bags.messages import BODY_FRAME
from ..crazyflie import LogBlock, VehicleClock

TOPICS = {
    "tdoa": ("uwb/tdoa", Tdoa),
    "imu": ("imu/data", Imu),
    "height": ("height", Range),
    "pressure": ("pressure", FluidPressure),
}


OF_SENSOR: dict[str, Callable[[float], Range | FluidPressure]] = {  # {stream: makes a message}
    "height": lambda value: Range(
        radiation_type=INFRARED,
        field_of_view=FIELD_OF_VIEW,
        max_range=LONGEST_RANGE,
        range=value,
    ),
    "pressure": lambda value: FluidPressure(fluid_pressure=value),
}


class VehicleTopics:
    """The topics of one Crazyflie."""

    def __init__(self, node: Node, streams: Collection[str]) -> None:
        """Make the publishers.

        Parameters
        ----------
        node : Node
            Of rclpy.
        streams : collection of str
            Names from TOPICS.
        """
        self._publishers = {
            stream: node.create_publisher(kind, topic, OUTPUT_QOS)
            for stream, (topic, kind) in TOPICS.items()
            if stream in streams
        }
        self.restart()

    @property
    def subscribers(self) -> dict[str, int]:
        """Return {text: number of subscribers} of each topic, for /diagnostics."""
        return {
            f"subscribers of {TOPICS[stream][0]}": publisher.get_subscription_count()
            for stream, publisher in self._publishers.items()
        }

    def restart(self) -> None:
        """Forget the clock of the vehicle."""
        self._clock = VehicleClock()

    def take(
        self, block: LogBlock, timestamp: float, values: Sequence[float], arrival: float
    ) -> None:
        """Publish what one message of a log block holds.

        Parameters
        ----------
        block : LogBlock
            Of this message.
        timestamp : float
            Of the vehicle, in ms.
        values : sequence of float
            Of the variables of the block.
        arrival : float
            Of the message, in s since 1970.
        """
        tdoas, sample = block.take(timestamp, values)
        for t, a, b, d in tdoas:
            tdoa = Tdoa(anchor_a=a, anchor_b=b, distance_difference=d)
            self._publish("tdoa", tdoa, t, arrival)
        if sample is not None:
            t, *vectors = sample
            gyro, accel = (Vector3(**dict(zip("xyz", vector.tolist()))) for vector in vectors)
            imu = Imu(angular_velocity=gyro, linear_acceleration=accel)
            self._publish("imu", imu, t, arrival)
        for stream, t, value in block.take_sensors(timestamp, values):
            self._publish(stream, OF_SENSOR[stream](value), t, arrival)

    def _publish(
        self, stream: str, message: Tdoa | Imu | Range | FluidPressure, t: float, arrival: float
    ) -> None:
        stamp = self._clock.stamp(t, arrival)
        message.header.stamp = Time(nanoseconds=round(1e9 * stamp)).to_msg()
        message.header.frame_id = BODY_FRAME
        self._publishers[stream].publish(message)
