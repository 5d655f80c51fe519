# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A Crazyflie by cflib: its log blocks come and are published on topics, poses go.

cflib works in threads of its own. They hand everything over through one queue.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
import logging
from queue import SimpleQueue
import re
import time
from typing import Any

from geometry_msgs.msg import Vector3
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import FluidPressure, Imu, Range

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors.height import FIELD_OF_VIEW, INFRARED, LONGEST_RANGE
from uwb_tdoa_bias.ros.topics import OUTPUT_QOS
from uwb_tdoa_msgs.msg import Tdoa

from ..bags.messages import BODY_FRAME
from ..crazyflie import BLOCKS, LogBlock, VehicleClock
from .estimate import Estimate, Link, missing

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


ADDRESS = re.compile(r"(radio|usb|udp|tcp)://\S+")
CONNECTING, AGAIN = 60.0, 2.0  # s to connect at most; s until the next attempt
# Deviations that the firmware assumes for what is sent. Its defaults are those of a motion capture
# system: 0.01 m and 0.0045 rad.
POSITION_STD, ATTITUDE_STD = "locSrv.extPosStdDev", "locSrv.extQuatStdDev"
FINEST = {POSITION_STD: 0.01, ATTITUDE_STD: 0.0045}
TOLD, TRUSTED = 1.25, 1.5  # ratios of a stated to a told deviation: tell it anew; do not send
TELL = 0.5  # s between two requests of one parameter
POSE, POSITION = "pose", "position"
NOT_YET = "connecting to the Crazyflie: it is not known yet whether it answers"


class CrazyflieLink(Link):
    """A link to one Crazyflie, which is opened again after it was lost."""

    def __init__(
        self,
        uri: str,
        content: str,
        streams: Sequence[str],
        topics: VehicleTopics,
        clock: Callable[[], int],
    ) -> None:
        """Start to connect.

        Parameters
        ----------
        uri : str
            Of cflib, e.g. radio://0/80/2M/E7E7E7E7E7.
        content : str
            POSE, or POSITION without the attitude.
        streams : sequence of str
            Names from BLOCKS of what the vehicle is to log.
        topics : VehicleTopics
            Gets each message of a log block.
        clock : callable
            Returns the time that stamps refer to, in ns since 1970.
        """
        if not ADDRESS.fullmatch(uri):
            raise InputError(
                f"connection: {uri!r} is no address of a Crazyflie; give one such as "
                "radio://0/80/2M/E7E7E7E7E7."
            )
        try:
            from cflib import crtp
            from cflib.crazyflie import Crazyflie
            from cflib.crazyflie.log import LogConfig
        except ImportError as error:
            raise missing("crazyflie", error, "cflib") from error
        logging.getLogger("cflib").setLevel(logging.CRITICAL)  # `report` says what is wrong
        crtp.init_drivers()
        self._log_config, self._uri, self._content = LogConfig, uri, content
        self._streams, self._topics, self._clock = streams, topics, clock
        self._events: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._is_open = False
        # time.monotonic() of the last attempt to connect and of the next one, s; None during one
        self._attempted_at = 0.0
        self._next_attempt: float | None = 0.0
        # {parameter: time.monotonic() of the last request to set it, s}
        self._set_requested_at: dict[str, float] = {}
        self._trouble, self._missing = NOT_YET, ""
        self._poses_sent = self._messages_logged = 0
        self._vehicle: Any = Crazyflie()
        self._vehicle.fully_connected.add_callback(lambda _: self._events.put(self._start))
        for lost in (self._vehicle.connection_failed, self._vehicle.connection_lost):
            lost.add_callback(lambda _, why: self._events.put(lambda: self._lose(why)))

    def turn(self) -> None:
        """Run what the threads of cflib have queued, and connect if there is no link."""
        while not self._events.empty():
            self._events.get()()
        now = time.monotonic()
        is_connecting = self._next_attempt is None and not self._is_open
        if is_connecting and now > self._attempted_at + CONNECTING:
            self._lose("it does not answer")
        if self._next_attempt is not None and now >= self._next_attempt:
            self._attempted_at, self._next_attempt = now, None
            self._vehicle.open_link(self._uri)

    def _lose(self, why: str) -> None:
        why = why.partition("\n")[0]
        self._trouble = (
            f"no link to the Crazyflie ({why}): check its power, its address and the radio"
        )
        self.close()
        self._next_attempt = time.monotonic() + AGAIN

    def _start(self) -> None:
        """Start the log blocks of the vehicle, which is connected now."""
        self._is_open, self._trouble, self._missing = True, "", ""
        self._set_requested_at.clear()
        self._topics.restart()
        for stream in self._streams:
            variables, period = BLOCKS[stream]
            config = self._log_config(stream, round(1e3 * period))
            for name, kind in variables.items():
                config.add_variable(name, kind)
            try:
                self._vehicle.log.add_config(config)
            except (KeyError, AttributeError):
                self._missing = (
                    f"the Crazyflie has no log variables for {stream}: check its deck and its "
                    f"firmware, or leave {stream} out of log"
                )
                continue
            config.data_received_cb.add_callback(self._receiver(LogBlock(list(variables), period)))
            config.start()

    def _receiver(self, block: LogBlock) -> Callable[[float, dict[str, float], Any], None]:
        """Return what a thread of cflib calls with each message of a log block."""

        def receive(timestamp: float, values: dict[str, float], _: Any) -> None:
            arrival = 1e-9 * self._clock()
            self._events.put(lambda: self._deliver(block, timestamp, values, arrival))

        return receive

    def _deliver(
        self, block: LogBlock, timestamp: float, values: dict[str, float], arrival: float
    ) -> None:
        self._messages_logged += 1
        self._topics.take(block, timestamp, list(values.values()), arrival)

    def send(self, estimate: Estimate, resets: int) -> None:
        """Send the position, or the pose, once the Crazyflie does not trust it too much."""
        if not self._is_open:
            return
        stated = {POSITION_STD: estimate.deviation}
        if self._content == POSE:
            stated[ATTITUDE_STD] = estimate.attitude_deviation
        if not all([self._tell(name, value) for name, value in stated.items()]):
            return
        if self._content == POSE:
            self._vehicle.extpos.send_extpose(*estimate.p.tolist(), *estimate.q.tolist())
        else:
            self._vehicle.extpos.send_extpos(*estimate.p.tolist())
        self._poses_sent += 1

    def _tell(self, name: str, stated: float) -> bool:
        """Set a parameter to a deviation if it differs; return whether it is large enough."""
        stated = max(stated, FINEST[name])
        told, now = float(self._vehicle.param.get_value(name)), time.monotonic()
        same = stated / TOLD < told < stated * TOLD
        if not same and now >= self._set_requested_at.get(name, 0.0) + TELL:
            self._set_requested_at[name] = now
            self._vehicle.param.set_value(name, stated)
        return stated < TRUSTED * told

    def report(self) -> tuple[str, dict[str, Any]]:
        """Return the trouble, "" if there is none, and the counts for /diagnostics."""
        return self._trouble or self._missing, {
            "autopilot": "Crazyflie" if self._is_open else "none",
            "poses sent": self._poses_sent,
            "messages of log blocks": self._messages_logged,
        }

    def close(self) -> None:
        """End the link.

        close_link() of cflib would also send a thrust of 0: a flying vehicle would fall.
        """
        vehicle, self._is_open = self._vehicle, False
        link, vehicle.link = vehicle.link, None
        if link is not None:
            link.close()
            vehicle.disconnected.call(self._uri)  # ends the threads of cflib
