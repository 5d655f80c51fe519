# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Publish other messages of a graph, in a separate process: a simulator's clock, a robot's
transforms, a tag's streams.

python -m studies.bench.load clock 200
python -m studies.bench.load tf 500
python -m studies.bench.load streams 30
"""

from __future__ import annotations

import sys
import time
from typing import TYPE_CHECKING, Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from tf2_msgs.msg import TFMessage

from uwb_tdoa_tools.live.session import session

from .flights import make_flight
from .source import Source

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from rclpy.node import Node

    from uwb_tdoa_tools.live.session import Stop

WHEELS = "odom", "base_link"  # of the transform on /tf


def main(argv: Sequence[str] | None = None) -> None:
    """Publish `what` at so many Hz (clock, tf), or streams of a flight of so many seconds over and
    over, until interrupted. Says an empty line when it begins.
    """
    what, number = sys.argv[1:] if argv is None else argv
    with session(f"load_{what}", []) as (node, stop):
        if what == "streams":
            source, flight = Source(node, []), make_flight(float(number))
            print(flush=True)
            source.play(flight, 1.0, lambda: stop_if(stop), 10_000)
        else:
            print(flush=True)
            publish(
                node,
                stop,
                float(number),
                *{"clock": (Clock, "/clock", of_clock), "tf": (TFMessage, "/tf", of_tf)}[what],
            )


def publish(
    node: Node, stop: Stop, rate: float, kind: type, topic: str, of: Callable[[Time], Any]
) -> None:
    """Publish of(Time of now) at `rate` Hz."""
    publisher, due = node.create_publisher(kind, topic, QoSProfile(depth=100)), time.monotonic()
    while not stop:
        publisher.publish(of(Time(sec=time.time_ns() // 10**9, nanosec=time.time_ns() % 10**9)))
        due = max(due + 1.0 / rate, time.monotonic() - 0.1)
        time.sleep(max(due - time.monotonic(), 0.0))


def of_clock(now: Time) -> Clock:
    """Clock at a Time."""
    return Clock(clock=now)


def of_tf(now: Time) -> TFMessage:
    """TFMessage with where the wheels say that the robot is, at a Time."""
    parent, child = WHEELS
    transform = TransformStamped(child_frame_id=child)
    transform.header.stamp, transform.header.frame_id = now, parent
    return TFMessage(transforms=[transform])


def stop_if(stop: Stop) -> None:
    """Raise KeyboardInterrupt once asked to end."""
    if stop:
        raise KeyboardInterrupt


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        pass
