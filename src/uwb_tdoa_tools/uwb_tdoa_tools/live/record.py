"""Recording topics to a bag."""

from __future__ import annotations

from dataclasses import dataclass
import time
from typing import TYPE_CHECKING

from tqdm import tqdm

from uwb_tdoa_bias.foundation.errors import Failure, InputError

from ..bags.files import new_bag
from ..bags.message_types import add_type, typestore
from .session import message_class, recorded_qos, session, subscription_qos

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from rclpy.node import Node
    from rclpy.qos import QoSProfile
    from rclpy.subscription import Subscription
    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Writer

REMEDY = "build and source the workspace that has it, and name the package with --package"
DISCOVERY_PERIOD = 0.1  # s between two looks for new topics
POLL_PERIOD = (
    0.005  # s between two looks for messages; the subscriptions hold what comes in between
)


@dataclass(frozen=True)
class Recorded:
    """counts : {topic: messages}; missing : topics, asked for by name, that brought none; error :
    what ended the recording, or None.
    """

    counts: dict[str, int]
    missing: list[str]
    error: Exception | None


def record(
    topics: Sequence[str],
    output: str | Path,
    storage: str = "mcap",
    ros_arguments: Sequence[str] = (),
    say: Callable[[str], object] = print,
    packages: Sequence[str] = (),
) -> Recorded:
    """Record topics, or all that are not hidden if the list is empty, until SIGINT or SIGTERM.
    Returns Recorded.

    output : path of the bag, which appears when the recording ends; say(sentence) : called with
        what happens; packages : of message types,
        beside those that are known, that may be imported.
    Raises InputError, and Failure if no message came at all: then there is no bag.
    """
    with session("record", list(ros_arguments)) as (node, stop), new_bag(output, storage) as writer:
        wanted = {node.resolve_topic_name(topic) for topic in topics} if topics else None
        names = ", ".join(sorted(wanted)) if wanted else None
        recorder = Recorder(node, writer, wanted, say, packages)
        say(f"waiting for {names or 'all topics'}")
        error = None
        try:
            with tqdm(unit=" messages", disable=None) as progress:
                recorder.run(lambda: bool(stop), progress.update)
                progress.update(recorder.take())
        except Exception as caught:  # what was recorded is worth keeping whatever happened
            error = caught
        if not any(recorder.counts.values()) and error is None:
            raise Failure(f"no message came on {names or 'any topic'}; there is no bag")
    return Recorded(recorder.counts, sorted(recorder.missing()), error)


class Recorder:
    """Subscriptions, and the connections of the bag that they write to.

    wanted : set of absolute topic names, or None for all; packages : see `record`. counts : {topic:
        messages recorded so far}.
    """

    def __init__(
        self,
        node: Node,
        writer: Writer,
        wanted: set[str] | None,
        say: Callable[[str], object],
        packages: Sequence[str] = (),
    ) -> None:
        self.counts: dict[str, int] = {}
        self._packages = packages
        self._node, self._writer, self._wanted, self._say = node, writer, wanted, say
        self._pairs: list[tuple[Subscription, Connection]] = []
        self._refused: set[str] = set()

    def discover(self) -> None:
        """Subscribe to wanted topics that have a publisher by now."""
        for topic, types in self._node.get_topic_names_and_types():
            if topic in self.counts or topic in self._refused or not self._is_wanted(topic):
                continue
            publishers = self._node.get_publishers_info_by_topic(topic)
            if publishers:
                msgtype = next(
                    filter(self._class, types), types[0]
                )  # others may tell other types of it
                self._subscribe(
                    topic,
                    msgtype,
                    [each.qos_profile for each in publishers if each.topic_type == msgtype],
                )

    def run(
        self, enough: Callable[[], object], taken: Callable[[int], object] = lambda count: None
    ) -> None:
        """Discover topics and take messages until enough(). taken(count) : called with how many
        came.
        """
        look_again = 0.0
        while not enough():
            if time.monotonic() >= look_again:
                self.discover()
                look_again = time.monotonic() + DISCOVERY_PERIOD
            taken(self.take())
            time.sleep(POLL_PERIOD)

    def take(self) -> int:
        """Move all messages that have arrived to the bag; returns how many."""
        taken = 0
        for subscription, connection in self._pairs:
            with subscription.handle:
                while (
                    message := subscription.handle.take_message(subscription.msg_type, True)
                ) is not None:
                    data, information = message
                    stamp = information["received_timestamp"] or time.time_ns()
                    self._writer.write(connection, stamp, data)
                    self.counts[connection.topic] += 1
                    taken += 1
        return taken

    def missing(self) -> set[str]:
        """Topics that were asked for by name and brought nothing."""
        return {topic for topic in self._wanted or () if not self.counts.get(topic)}

    def _is_wanted(self, topic: str) -> bool:
        if self._wanted is not None:
            return topic in self._wanted
        return not any(part.startswith("_") for part in topic.split("/"))

    def _class(self, msgtype: str) -> type | None:
        return message_class(msgtype, self._packages)

    def _subscribe(self, topic: str, msgtype: str, offered: list[QoSProfile]) -> None:
        cls = self._class(msgtype)
        try:
            if cls is None:
                raise InputError(
                    f"{msgtype} is not installed, or of a package that is not known; {REMEDY}."
                )
            add_type(typestore(), msgtype)
        except InputError as error:
            if self._wanted is not None:
                raise
            self._say(f"leaving out {topic}: {error}")
            self._refused.add(topic)
            return
        connection = self._writer.add_connection(
            topic,
            msgtype,
            typestore=typestore(),
            offered_qos_profiles=[recorded_qos(qos) for qos in offered],
        )
        qos = subscription_qos(offered)
        # Never spun, so the callback never runs: messages are taken from the subscription as bytes,
        # many at a time.
        subscription = self._node.create_subscription(cls, topic, lambda _: None, qos, raw=True)
        self._pairs.append((subscription, connection))
        self.counts[topic] = 0
        self._say(f"recording {topic} ({msgtype}, {qos.reliability.name.lower()})")
