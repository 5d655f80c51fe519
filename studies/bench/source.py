# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The surroundings of the nodes: publish a flight in real time and receive the odometry."""

from __future__ import annotations

from functools import partial
import struct
import time
from typing import TYPE_CHECKING

from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
import numpy as np
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Imu

from uwb_tdoa_bias.ros.anchors import ANCHORS_QOS, anchors_to_message
from uwb_tdoa_bias.ros.topics import OUTPUT_QOS, publish_stream
from uwb_tdoa_msgs.msg import AnchorArray, Tdoa

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rclpy.node import Node
    from rclpy.publisher import Publisher

    from uwb_tdoa_bias.common.flight import Flight

# of a little-endian CDR message that begins with a header, after 4 bytes
HEADER_STAMP = struct.Struct("<iI")
AHEAD = 0.5  # s from the call to the first message
SHORTEST_SLEEP = 5e-5  # s


class Source:
    """Publishes imu/data, uwb/tdoa and uwb/anchors with the default QoS; subscribes to `odometry`
    in each namespace.

    Takes messages from the middleware without callbacks. So received messages do not delay
    published ones, and an odometry arrives when the middleware of this process receives it.
    """

    def __init__(self, node: Node, namespaces: Sequence[str]) -> None:
        self.publishers = {
            kind: publish_stream(node, kind, topic)
            for kind, topic in ((Imu, "/imu/data"), (Tdoa, "/uwb/tdoa"))
        }
        self.anchors_sent = 0  # ns since 1970
        self._anchors = node.create_publisher(AnchorArray, "/uwb/anchors", ANCHORS_QOS)
        self.received: list[list[tuple[int, int]]] = [
            [] for _ in namespaces
        ]  # (arrival, stamp), ns
        # Their callbacks run only in a wait, before and after `play`.
        self.subscriptions = [
            node.create_subscription(
                Odometry, f"{space}/odometry", partial(_keep, received), OUTPUT_QOS, raw=True
            )
            for space, received in zip(namespaces, self.received)
        ]

    def play(
        self, flight: Flight, block: float, on_block: Callable[[], object], rounds: int = 1
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Publish a Flight as fast as it was flown, so many times, one after the other. on_block():
        called first, after every `block` s, and at the end.

        Returns (sent, stamps, late): of each TDOA when it was published and its stamp, (n,) ns
        since 1970; s by which each message was late.
        """
        assert flight.imu is not None
        message, self.anchors_sent = anchors_to_message(flight.anchors), time.time_ns()
        self._anchors.publish(message)
        start = time.time_ns() // 10**9 + 1  # stamps are of now, too
        events = self._events(flight, start - flight.imu.t[0])
        began, period = (
            time.perf_counter() + AHEAD,
            round((flight.imu.t[-1] - flight.imu.t[0]) * 1e3 + 1.0) * 10**6,
        )
        sent, stamps, late, next_block = [], [], [], began
        for turn, (due, stamp, publisher, data) in (
            (turn, event) for turn in range(rounds) for event in events
        ):
            due += began + 1e-9 * turn * period
            if due >= next_block:
                on_block()
                next_block += block
            while (left := due - time.perf_counter()) > 0.0:
                self.take()
                if left > SHORTEST_SLEEP:
                    time.sleep(max(due - time.perf_counter(), 0.0))
            late.append(-left)
            if stamp:
                sent.append(time.time_ns())
                stamps.append(stamp + turn * period)
            publisher.publish(later(data, turn * period) if turn else data)
        on_block()
        return np.array(sent), np.array(stamps), np.array(late)

    def take(self) -> None:
        """Keep what has arrived."""
        for subscription, received in zip(self.subscriptions, self.received):
            with subscription.handle:
                while (
                    taken := subscription.handle.take_message(subscription.msg_type, True)
                ) is not None:
                    data, information = taken
                    _keep(received, data, information["received_timestamp"])

    def _events(self, flight: Flight, epoch: float) -> list[tuple[float, int, Publisher, bytes]]:
        """(due s, stamp ns of a TDOA or 0, publisher, bytes) in the order in which they are due."""
        assert flight.imu is not None
        imu, tdoa, events = flight.imu, flight.tdoa, []
        message, publisher = Imu(), self.publishers[Imu]
        for t, (gx, gy, gz), (fx, fy, fz) in zip(
            imu.t.tolist(), imu.gyro.tolist(), imu.accel.tolist()
        ):
            message.header.stamp, _ = _stamp(t + epoch)
            rate, force = message.angular_velocity, message.linear_acceleration
            rate.x, rate.y, rate.z, force.x, force.y, force.z = gx, gy, gz, fx, fy, fz
            events.append((t - imu.t[0], 0, publisher, serialize_message(message)))
        message, publisher = Tdoa(), self.publishers[Tdoa]
        for t, a, b, d in zip(*(column.tolist() for column in (tdoa.t, tdoa.a, tdoa.b, tdoa.d))):
            message.header.stamp, stamp = _stamp(t + epoch)
            message.anchor_a, message.anchor_b, message.distance_difference = a, b, d
            events.append((t - imu.t[0], stamp, publisher, serialize_message(message)))
        return sorted(events, key=lambda event: event[0])


def _keep(received: list[tuple[int, int]], data: bytes, arrival: int | None = None) -> None:
    second, nanosecond = HEADER_STAMP.unpack_from(data, 4)
    received.append((arrival or time.time_ns(), second * 10**9 + nanosecond))


def later(data: bytes, ns: int) -> bytes:
    """A message as bytes, stamped so much later."""
    second, nanosecond = HEADER_STAMP.unpack_from(data, 4)
    second, nanosecond = divmod(second * 10**9 + nanosecond + ns, 10**9)
    return data[:4] + HEADER_STAMP.pack(second, nanosecond) + data[4 + HEADER_STAMP.size :]


def latencies(
    sent: np.ndarray, stamps: np.ndarray, arrivals: np.ndarray, of: np.ndarray
) -> np.ndarray:
    """s from the publication of each TDOA to the arrival of the first odometry whose stamp is not
    older: (n,), NaN for those that were published before there was any odometry, or that none
    contains.

    sent, stamps : (n,) ns, of TDOAs; arrivals, of : (k,) ns, arrival and stamp of each odometry in
        order of arrival.
    """
    out = np.full(len(sent), np.nan)
    if len(arrivals) == 0:
        return out
    place = np.searchsorted(np.maximum.accumulate(of), stamps)
    known = (place < len(of)) & (sent >= arrivals[0])
    out[known] = 1e-9 * (arrivals[place[known]] - sent[known])
    return out


def _stamp(seconds: float) -> tuple[Time, int]:
    """(Time, ns) of seconds since 1970, to the microsecond: a float has no finer resolution."""
    ns = round(seconds * 1e6) * 1000
    second, nanosecond = divmod(ns, 10**9)
    return Time(sec=second, nanosec=nanosecond), ns
