"""Record topics of running nodes to a bag."""

from __future__ import annotations

from contextlib import contextmanager
from functools import partial
import time
from typing import TYPE_CHECKING

from uwb_tdoa_bias.foundation.errors import InputError

from ..bags.files import new_bag
from ..bags.message_types import add_type, typestore
from .session import message_class, recorded_qos, subscription_qos

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from rclpy.node import Node
    from rclpy.qos import QoSProfile
    from rclpy.subscription import Subscription
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Writer

REMEDY = "build and source the workspace that has it"
DISCOVERY_PERIOD = 0.1  # s between two looks for new topics
POLL_PERIOD = (
    0.005  # s between two looks for messages; the subscriptions hold what comes in between
)


@contextmanager
def recorded_odometry(node: Node, path: str | Path) -> Iterator[None]:
    """Record the topic /odometry while the block lasts. The caller must spin the node.

    The bag appears at `path` when the block ends without an exception. Raises InputError if a file
    is there.
    """
    with new_bag(path) as writer:
        recorder = Recorder(node, writer, {"/odometry"}, lambda sentence: None)
        timer = node.create_timer(DISCOVERY_PERIOD, recorder.discover)
        yield
        node.destroy_timer(timer)
        recorder.take()


class Recorder:
    """Subscriptions, and the connections of the bag that they write to.

    wanted : set of absolute topic names. counts : {topic: messages recorded so far}.
    """

    def __init__(
        self,
        node: Node,
        writer: Writer,
        wanted: set[str],
        say: Callable[[str], object],
    ) -> None:
        self.counts: dict[str, int] = {}
        self._node, self._writer, self._wanted, self._say = node, writer, wanted, say
        self._pairs: list[tuple[Subscription, Connection]] = []

    def discover(self) -> None:
        """Subscribe to wanted topics that have a publisher by now."""
        for topic, types in self._node.get_topic_names_and_types():
            if topic in self.counts or topic not in self._wanted:
                continue
            publishers = self._node.get_publishers_info_by_topic(topic)
            if publishers:
                msgtype = next(
                    filter(message_class, types), types[0]
                )  # others may tell other types of it
                self._subscribe(
                    topic,
                    msgtype,
                    [each.qos_profile for each in publishers if each.topic_type == msgtype],
                )

    def run(self, enough: Callable[[], object]) -> None:
        """Discover topics and take messages until enough()."""
        look_again = 0.0
        while not enough():
            if time.monotonic() >= look_again:
                self.discover()
                look_again = time.monotonic() + DISCOVERY_PERIOD
            self.take()
            time.sleep(POLL_PERIOD)

    def take(self) -> None:
        """Move all messages that have arrived to the bag."""
        for subscription, connection in self._pairs:
            with subscription.handle:
                while (
                    message := subscription.handle.take_message(subscription.msg_type, True)
                ) is not None:
                    self._write(connection, *message)

    def _write(self, connection: Connection, data: bytes, information: dict[str, int]) -> None:
        stamp = information["received_timestamp"] or time.time_ns()
        self._writer.write(connection, stamp, data)
        self.counts[connection.topic] += 1

    def _subscribe(self, topic: str, msgtype: str, offered: list[QoSProfile]) -> None:
        cls = message_class(msgtype)
        if cls is None:
            raise InputError(
                f"{msgtype} is not installed, or of a package that is not known; {REMEDY}."
            )
        add_type(typestore(), msgtype)
        connection = self._writer.add_connection(
            topic,
            msgtype,
            typestore=typestore(),
            offered_qos_profiles=[recorded_qos(qos) for qos in offered],
        )
        qos = subscription_qos(offered)
        # Of a node that is spun, the callback writes. Else `take` moves many messages at a time.
        write = partial(self._write, connection)
        subscription = self._node.create_subscription(cls, topic, write, qos, raw=True)
        self._pairs.append((subscription, connection))
        self.counts[topic] = 0
        self._say(f"recording {topic} ({msgtype}, {qos.reliability.name.lower()})")
