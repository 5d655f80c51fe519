# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Record topics of running nodes to a bag, and list who publishes and hears them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
import time

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from rosbags.interfaces import Connection
from rosbags.rosbag2 import Writer

from uwb_tdoa_bias.common.errors import InputError

from ..bags.files import new_bag
from ..bags.messages import add_type, typestore
from .session import message_class, recorded_qos, session, subscription_qos, taken


@dataclass(frozen=True)
class End:
    """A publisher or a subscription of a topic.

    Attributes
    ----------
    topic, node : str
        Absolute names.
    kind : str
        Type of the messages.
    publishes : bool
        True for a publisher.
    reliable, latched : bool
        QoS; false means best effort and volatile.
    """

    topic: str
    node: str
    kind: str
    publishes: bool
    reliable: bool
    latched: bool

    @property
    def qos(self) -> str:
        """Describe the QoS in words."""
        return (
            f"{'reliable' if self.reliable else 'best effort'}, "
            f"{'transient local' if self.latched else 'volatile'}"
        )

    def gets(self, publisher: End) -> bool:
        """Return whether this subscription receives from a publisher of its topic.

        A subscription may not request more than is offered (DDS).
        """
        return publisher.reliable >= self.reliable and publisher.latched >= self.latched


REMEDY = "build and source the workspace that has it"
DISCOVERY_PERIOD = 0.1  # s between two looks for new topics
POLL_PERIOD = 0.005  # s between two reads of the subscriptions, which queue messages meanwhile


@contextmanager
def recorded_odometry(node: Node, path: str | Path) -> Iterator[None]:
    """Record the topic /odometry while the block lasts. The caller must spin the node.

    The bag appears at `path` when the block ends without an exception.

    Raises
    ------
    InputError
        If `path` exists.
    """
    with new_bag(path) as writer:
        recorder = Recorder(node, writer, {"/odometry"}, lambda sentence: None)
        timer = node.create_timer(DISCOVERY_PERIOD, recorder.discover)
        yield
        node.destroy_timer(timer)
        recorder.take()


class Recorder:
    """Write the messages of wanted topics to a bag.

    Attributes
    ----------
    counts : dict
        {topic: messages recorded so far}.
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
        """Subscribe to wanted topics that have a publisher now."""
        for topic, types in self._node.get_topic_names_and_types():
            if topic in self.counts or topic not in self._wanted:
                continue
            publishers = self._node.get_publishers_info_by_topic(topic)
            if publishers:
                # A topic may be announced with several types: the first installed one is taken.
                msgtype = next(filter(message_class, types), types[0])
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
        """Write all messages that have arrived to the bag."""
        for subscription, connection in self._pairs:
            for data, information in taken(subscription):
                self._write(connection, data, information)

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
        # In a node that spins, the callback writes. Else `take` moves many messages at a time.
        write = partial(self._write, connection)
        subscription = self._node.create_subscription(cls, topic, write, qos, raw=True)
        self._pairs.append((subscription, connection))
        self.counts[topic] = 0
        self._say(f"recording {topic} ({msgtype}, {qos.reliability.name.lower()})")


FIRST_LIMIT = 20.0  # s until there must be a message on the first topic


def listen(
    topics: Sequence[str], bag: str | Path, seconds: float, say: Callable[[str], object] = print
) -> tuple[dict[str, str], list[End]]:
    """Record topics to a new bag for some seconds, or until SIGINT.

    The time starts with the first message on the first topic.

    Parameters
    ----------
    topics : sequence of str
        Absolute names.
    bag : path
        The bag to write.
    seconds : float
        Duration, s.
    say : callable
        Called with sentences about the progress.

    Returns
    -------
    kinds : dict
        {topic: type} of all topics in the system.
    ends : list of End
        Publishers and subscriptions of `topics`, without our own.

    Raises
    ------
    InputError
        If no message arrives on the first topic.
    """
    with session("check", []) as (node, stop), new_bag(bag) as writer:
        recorder = Recorder(node, writer, set(topics), say)
        say(f"waiting for {topics[0]}")
        heard = partial(recorder.counts.get, topics[0], 0)
        until = time.monotonic() + FIRST_LIMIT
        recorder.run(lambda: stop or heard() or time.monotonic() > until)
        kinds = {topic: types[0] for topic, types in node.get_topic_names_and_types()}
        if not heard():
            raise InputError(
                f"no message on {topics[0]} within {FIRST_LIMIT:g} s; {_remedy(topics[0], kinds)}."
            )
        say(
            f"listening for {seconds:g} s; carry the tag through the room, turn, lift and "
            "lower it (Ctrl-C ends it earlier)"
        )
        until = time.monotonic() + seconds
        recorder.run(lambda: stop or time.monotonic() > until)
        kinds = {topic: types[0] for topic, types in node.get_topic_names_and_types()}
        ends = [
            end
            for topic in topics
            for end in _ends(node, topic)
            if end.node != node.get_fully_qualified_name()
        ]
    return kinds, ends


def _ends(node: Node, topic: str) -> Iterator[End]:
    for publishes, infos in (
        (True, node.get_publishers_info_by_topic(topic)),
        (False, node.get_subscriptions_info_by_topic(topic)),
    ):
        for info in infos:
            qos = info.qos_profile
            yield End(
                topic,
                f"{info.node_namespace.rstrip('/')}/{info.node_name}",
                info.topic_type,
                publishes,
                qos.reliability == ReliabilityPolicy.RELIABLE,
                qos.durability == DurabilityPolicy.TRANSIENT_LOCAL,
            )


def _remedy(topic: str, kinds: dict[str, str]) -> str:
    """Return the remedy for a topic without a publisher."""
    others = sorted(
        name for name, kind in kinds.items() if kind == "uwb_tdoa_msgs/msg/Tdoa" and name != topic
    )
    if others:
        return "say where they are: " + " or ".join(f"--topic uwb/tdoa={name}" for name in others)
    return "start the tag's driver, in this ROS_DOMAIN_ID"
