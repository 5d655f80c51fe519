"""Record the odometry of running nodes to a bag."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING

from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy

from ..bags.files import new_bag
from ..bags.message_types import typestore
from .session import READER_DEPTH

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from rclpy.node import Node

MSGTYPE = "nav_msgs/msg/Odometry"


@contextmanager
def recorded_odometry(node: Node, path: str | Path, topic: str = "/odometry") -> Iterator[None]:
    """Record a topic of odometry while the block lasts. The caller must spin the node.

    The bag appears at `path` when the block ends without an exception. Raises InputError if
    a file is there.
    """
    with new_bag(path) as writer:
        connection = writer.add_connection(topic, MSGTYPE, typestore=typestore())

        def write(data: bytes, information: dict[str, int]) -> None:
            writer.write(connection, information["received_timestamp"], data)

        qos = QoSProfile(depth=READER_DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        subscription = node.create_subscription(Odometry, topic, write, qos, raw=True)
        yield
        with subscription.handle:  # messages that arrived after the last spin
            while (message := subscription.handle.take_message(Odometry, True)) is not None:
                write(*message)
        node.destroy_subscription(subscription)
