# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Replay a bag over topics: publishers as recorded, paced by the stamps, everything acknowledged."""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, field
import itertools
import time
from typing import TYPE_CHECKING

from rclpy.duration import Duration
from rclpy.qos import DurabilityPolicy

from uwb_tdoa_bias.common.errors import InputError

from ..bags.files import messages, open_bag
from ..choices import WAIT
from .follow import Follower, Nodes
from .player import ACKNOWLEDGE_LIMIT, LONGEST_SLEEP, Played, Player, is_tdoa, read_ahead
from .session import message_class, publisher_qos, session

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from rclpy.node import Node
    from rclpy.publisher import Publisher

    from ..bags.files import BagReader
    from .session import Stop


# In no robot's namespace:
GLOBAL = "/tf", "/tf_static", "/clock", "/diagnostics", "/rosout", "/parameter_events"
# s from the last match to the first message, and from the last message to the end: the other side
# discovers a little later
SETTLE = 0.2
DISCOVERY = 2.0  # s without a new subscription after which the present ones suffice


@dataclass(frozen=True)
class ReplayOptions:
    """Options of a replay.

    Attributes
    ----------
    rate : float
        Times as fast as recorded.
    loop : bool
        Start again at the end.
    clock_rate : float or None
        Hz of /clock.
    wait : float
        s until a subscription must exist.
    wait_topics : sequence of str
        Topics that each need a subscription.
    follow : str or None
        Topic to keep in step with. The TDOAs of the bag then need a subscription.
    ros_arguments : sequence of str
        Command line with --ros-args.
    packages : sequence of str
        Further packages of message types to import.
    """

    rate: float = 1.0
    loop: bool = False
    clock_rate: float | None = None
    wait: float = WAIT
    wait_topics: Sequence[str] = ()
    follow: str | None = None
    ros_arguments: Sequence[str] = ()
    packages: Sequence[str] = ()


@dataclass(frozen=True)
class Replayed:
    """Result of a replay.

    Attributes
    ----------
    played : Played
        Counters.
    took : float
        Duration, s.
    acknowledged : bool
        Whether every subscription has every message.
    stopped_by : int or None
        Number of the signal that ended the replay early.
    wrong : dict
        {fault of the followed nodes: count}.
    """

    played: Played = field(default_factory=Played)
    took: float = 0.0
    acknowledged: bool = True
    stopped_by: int | None = None
    wrong: dict[str, int] = field(default_factory=dict)


def replay(
    bag: str | Path, options: ReplayOptions = ReplayOptions(), say: Callable[[str], object] = print
) -> Replayed:
    """Replay a bag over ROS topics.

    Parameters
    ----------
    bag : path
        The bag.
    options : ReplayOptions
        How to replay it.
    say : callable
        Called with sentences about the progress.

    Returns
    -------
    Replayed

    Raises
    ------
    InputError
        If the bag has no message, or nobody subscribes in time.
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
        wrong = nodes.faults(player.count, stop) if nodes else {}
        return Replayed(player.played, took, acknowledged, stop.signal, wrong)


def _publishers(
    node: Node,
    bag: str | Path,
    reader: BagReader,
    say: Callable[[str], object],
    packages: Sequence[str],
) -> dict[str, Publisher]:
    """Return {topic in the bag: publisher} of each topic of an installed type, latched ones last.

    Topics of one robot are published in the namespace of the node (--ros-args -r __ns:=/tag1).
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
    """Wait until each wanted topic has a subscription, and the followed topic a publisher.

    Wanted are the topics that the options name. Else all topics of the bag are wanted, and those
    with a subscription suffice once no further one has come for DISCOVERY s.

    Raises
    ------
    InputError
        If after `options.wait` s a required topic, or every topic, has no subscription.
    """
    needed = [f"/{topic.lstrip('/')}" for topic in options.wait_topics]
    wanted = needed or list(publishers)
    if options.follow and not needed:
        needed = [topic for topic, publisher in publishers.items() if is_tdoa(publisher)]
    missing = [topic for topic in wanted if topic not in publishers]
    if missing:
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
        enough = not missing or (
            now > changed + DISCOVERY
            and len(missing) < len(wanted)
            and not set(missing) & set(needed)
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
    """Return whether every subscription has every message, after at most ACKNOWLEDGE_LIMIT."""
    until = time.monotonic() + ACKNOWLEDGE_LIMIT
    for publisher in publishers:
        while not publisher.wait_for_all_acked(Duration(seconds=LONGEST_SLEEP)):
            if stop or time.monotonic() > until:
                return False
    # Best-effort subscriptions acknowledge nothing, and may read from the memory of this process.
    time.sleep(SETTLE)
    return True
