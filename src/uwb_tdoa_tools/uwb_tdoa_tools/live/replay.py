"""Replaying a bag over topics: publishers as recorded, somebody to listen, and everything
acknowledged.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, field
import itertools
import time
from typing import TYPE_CHECKING

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy

from uwb_tdoa_bias.foundation.errors import InputError

from ..bags.files import messages, open_bag
from .follow import Follower
from .followed_nodes import Nodes
from .player import ACKNOWLEDGE_LIMIT, LONGEST_SLEEP, Played, Player, is_tdoa
from .read_ahead import read_ahead
from .session import message_class, publisher_qos, session

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from rclpy.node import Node
    from rclpy.publisher import Publisher

    from ..bags.files import BagReader
    from .session import Stop

GLOBAL = (
    "/tf",
    "/tf_static",
    "/clock",
    "/diagnostics",
    "/rosout",
    "/parameter_events",
)  # in no robot's namespace
# s from the last match to the first message, and from the last message to the end: others are a
# little later than we are
SETTLE = 0.2
DISCOVERY = 2.0  # s without anybody new after which who listens by now is enough


@dataclass(frozen=True)
class ReplayOptions:
    """How to replay.

    rate : times as fast as recorded; loop : start again at the end; clock_rate : Hz of /clock, None
        for none;
    wait : s until somebody must subscribe; wait_topics : to all of these; follow : topic that is
        kept in step with, or
    None (the TDOAs of the bag are of the wait_topics then); ros_arguments : command line with
    --ros-args; packages : of message types, beside those that are known, that may be imported.
    """

    rate: float = 1.0
    loop: bool = False
    clock_rate: float | None = None
    wait: float = 10.0
    wait_topics: Sequence[str] = ()
    follow: str | None = None
    ros_arguments: Sequence[str] = ()
    packages: Sequence[str] = ()


@dataclass(frozen=True)
class Replayed:
    """played : Played; took : s; acknowledged : whether every subscription has everything;
    stopped_by : number of the signal that ended it early, or None; wrong : {what went wrong with
    what was followed: count}, empty if nothing did or nothing was followed.
    """

    played: Played = field(default_factory=Played)
    took: float = 0.0
    acknowledged: bool = True
    stopped_by: int | None = None
    wrong: dict[str, int] = field(default_factory=dict)


def replay(
    bag: str | Path, options: ReplayOptions = ReplayOptions(), say: Callable[[str], object] = print
) -> Replayed:
    """Replay a bag.

    Returns Replayed. Raises InputError. say(sentence) : called with what happens.
    """
    with open_bag(bag) as reader, session("replay", list(options.ros_arguments)) as (node, stop):
        publishers = _publishers(node, bag, reader, say, options.packages)
        connections = [
            connection for connection in reader.connections if connection.topic in publishers
        ]
        count = sum(connection.msgcount for connection in connections)
        if not count:
            raise InputError(f"{bag}: has no message to replay.")
        player = Player(node, publishers, options.rate, options.clock_rate, stop)
        _wait_for_listeners(node, publishers, options, stop, say)
        nodes = Nodes(node) if options.follow else None
        player.follower = (
            Follower(node, options.follow, nodes.lag) if options.follow and nodes else None
        )
        length = (reader.end_time - reader.start_time) / 1e9
        say(f"playing {count} messages, {length:.1f} s at rate {options.rate:g}")
        began = time.perf_counter()
        while not stop:
            with closing(read_ahead(messages(bag, reader, connections))) as recorded:
                player.play(recorded)
            if not options.loop:
                break
        took = time.perf_counter() - began
        acknowledged = _wait_acknowledged(publishers.values(), stop)
        wrong = nodes.wrong(player, stop) if nodes else {}
        return Replayed(player.played, took, acknowledged, stop.signal, wrong)


def _publishers(
    node: Node,
    bag: str | Path,
    reader: BagReader,
    say: Callable[[str], object],
    packages: Sequence[str],
) -> dict[str, Publisher]:
    """{topic in the bag: publisher} of all topics whose type is installed, those that are latched
    last. What belongs to one robot is published in the namespace of the node (--ros-args -r
    __ns:=/tag1).
    """
    made = []
    by_topic = itertools.groupby(
        sorted(reader.connections, key=lambda c: c.topic), key=lambda c: c.topic
    )
    for topic, group in by_topic:
        connections = list(group)
        cls = message_class(connections[0].msgtype, packages)
        if cls is None:
            say(
                f"leaving out {topic}: its type {connections[0].msgtype} is not installed, or "
                "of a package that is not known (--package)"
            )
            continue
        recorded = [
            qos
            for connection in connections
            for qos in connection.ext.offered_qos_profiles  # type: ignore[union-attr]  # a bag of ROS 2
        ]
        made.append(
            (
                topic,
                cls,
                publisher_qos(recorded, sum(connection.msgcount for connection in connections)),
            )
        )
    if not made:
        raise InputError(
            f"{bag}: has no topic of an installed type; build and source the workspace first."
        )
    made.sort(key=lambda entry: entry[2].durability == DurabilityPolicy.TRANSIENT_LOCAL)
    return {
        topic: node.create_publisher(cls, topic if topic in GLOBAL else topic.lstrip("/"), qos)
        for topic, cls, qos in made
    }


def _wait_for_listeners(
    node: Node,
    publishers: dict[str, Publisher],
    options: ReplayOptions,
    stop: Stop,
    say: Callable[[str], object],
) -> None:
    """Return when somebody subscribes to each wanted topic: those that options name, or else all of
    the bag, as far as they have any subscriber once nobody new has come for DISCOVERY s; and when
    somebody publishes what is followed. InputError if after `options.wait` s nobody subscribes to
    one that must have a subscriber, or to any.
    """
    needed = [f"/{topic.lstrip('/')}" for topic in options.wait_topics]
    wanted = needed or list(publishers)
    if options.follow and not needed:
        needed = [topic for topic, publisher in publishers.items() if is_tdoa(publisher)]
    if missing := [topic for topic in wanted if topic not in publishers]:
        raise InputError(
            f"--wait-topics: {missing[0]} is not in the bag; it has {', '.join(publishers)}."
        )
    names = ", ".join(publishers[topic].topic_name for topic in wanted)
    say(f"waiting up to {options.wait:g} s for subscriptions to {names}")
    began = changed = time.monotonic()
    missing = wanted
    heard: tuple[tuple[int, ...], ...] = ()
    while not stop:
        now = time.monotonic()
        counts = tuple(publishers[topic].get_subscription_count() for topic in wanted)
        known = tuple(node.count_subscribers(publishers[topic].topic_name) for topic in wanted)
        followed = not options.follow or node.count_publishers(
            node.resolve_topic_name(options.follow)
        )
        missing = [topic for topic, count in zip(wanted, counts) if not count]
        if (counts, known) != heard:
            heard, changed = (counts, known), now
        settled = now > changed + DISCOVERY
        enough = not missing or (
            settled and len(missing) < len(wanted) and not set(missing) & set(needed)
        )
        matched = all(count >= there for count, there in zip(counts, known))
        if (enough and followed and matched) or now > began + options.wait:
            break
        time.sleep(0.01)
    without = [publishers[topic].topic_name for topic in missing]
    unheard = [publishers[topic].topic_name for topic in missing if topic in needed]
    if not stop and (unheard or len(missing) == len(wanted)):
        what = unheard[0] if unheard else "any topic of the bag"
        raise InputError(
            f"nobody subscribes to {what} within {options.wait:g} s; start the nodes first, "
            "or wait longer "
            "(--wait-matched)."
        )
    if missing:
        say(f"nobody subscribes to {', '.join(without)}")
    time.sleep(SETTLE)


def _wait_acknowledged(publishers: Iterable[Publisher], stop: Stop) -> bool:
    """Whether every subscription has everything; waits at most ACKNOWLEDGE_LIMIT, in slices that
    see a signal.
    """
    until = time.monotonic() + ACKNOWLEDGE_LIMIT
    for publisher in publishers:
        while not publisher.wait_for_all_acked(Duration(seconds=LONGEST_SLEEP)):
            if stop or time.monotonic() > until:
                return False
    time.sleep(
        SETTLE
        # who listens by best effort acknowledges nothing, and may read the last messages from the
        # memory of this process
    )
    return True
