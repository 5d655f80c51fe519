# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Replay a bag over topics: publishers as recorded, paced by the stamps, everything acknowledged."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
import itertools
from pathlib import Path
import time
from typing import TypeVar

from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosbags.interfaces import Connection
from rosgraph_msgs.msg import Clock

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors import SENSORS

from ..bags.files import BagReader, open_bag
from ..choices import WAIT
from .follow import Follower, Nodes, is_stamped, stamp_of
from .session import Stop, message_class, parameter_of, publisher_qos, session, wait_for_names

Item = TypeVar("Item")

BATCH = 500
BATCHES_AHEAD = 100


def read_ahead(messages: Iterable[Item]) -> Generator[Item, None, None]:
    """Yield the items of an iterable, read by a thread up to BATCH * BATCHES_AHEAD items ahead.

    Decoding a chunk of a bag then delays no message. Exceptions of the iterable are raised here.
    """
    iterator = iter(messages)

    def read() -> tuple[list[Item], Exception | None]:
        batch: list[Item] = []
        try:
            batch.extend(itertools.islice(iterator, BATCH))
        except Exception as error:
            return batch, error  # `extend` keeps the items before it
        return batch, None

    reader = ThreadPoolExecutor(1)
    try:
        ahead = deque(reader.submit(read) for _ in range(BATCHES_AHEAD))
        while True:
            batch, error = ahead.popleft().result()
            yield from batch
            if error is not None:
                raise error
            if not batch:
                return
            ahead.append(reader.submit(read))
    finally:
        reader.shutdown(cancel_futures=True)


RCLError = rclpy_implementation.RCLError
LARGEST_CATCH_UP = 0.1  # s; a longer delay shifts all later messages: a burst overruns queues
LATCHED_LIMIT = 5.0  # s for the acknowledgement of latched messages
LONGEST_SLEEP = 0.05  # s until a signal is seen
PROGRESS = 10.0  # s between two lines on the progress
ACKNOWLEDGE_LIMIT = 30.0  # s; longer than the 20 s after which DDS forgets a subscription that died


@dataclass
class Played:
    """Counters of a replay.

    Attributes
    ----------
    counts : Counter
        Messages by topic of the bag.
    behind : float
        Largest delay of a message, s.
    stretched : float
        s by which the replay was stretched. After a stall it sends no burst that overruns a queue.
    waited : float
        s of waiting for the followed topic.
    """

    counts: Counter[str] = field(default_factory=Counter)
    behind: float = 0.0
    stretched: float = 0.0
    waited: float = 0.0


def is_latched(publisher: Publisher) -> bool:
    """Return whether a late subscription gets the last messages too."""
    return publisher.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL


def is_tdoa(publisher: Publisher) -> bool:
    """Return whether a publisher has raw TDOAs."""
    return _kind(publisher) == "Tdoa"


def is_sensor(publisher: Publisher) -> bool:
    """Return whether a publisher has measurements of one of the SENSORS, for ekf_node."""
    return publisher.topic_name.endswith(
        tuple(f"/{topic}" for sensor in SENSORS.values() for topic, _ in sensor.topics)
    )


def is_imu(publisher: Publisher) -> bool:
    """Return whether a publisher has inertial samples for ekf_node."""
    return _kind(publisher) == "Imu" and not is_sensor(publisher)


def _kind(publisher: Publisher) -> str:
    """Return the name of the class of the messages."""
    return publisher.msg_type.__name__  # type: ignore[attr-defined]  # rclpy says of the class that it is a message


class Player:
    """Publish recorded messages at their stamps, and /clock if it has a rate."""

    def __init__(
        self,
        node: Node,
        publishers: dict[str, Publisher],
        rate: float,
        clock_rate: float | None,
        stop: Stop,
        tell: Callable[[float, float, float], object] = lambda played, took, waited: None,
    ) -> None:
        """Store the publishers.

        Parameters
        ----------
        publishers : dict
            {topic in the bag: publisher}.
        rate : float
            Times as fast as recorded.
        clock_rate : float or None
            Hz of /clock.
        stop : Stop
            Its truth value becomes True once the process is asked to end.
        tell : callable
            tell(played, took, waited) is called every PROGRESS s, with s of stamps played, s since
            the beginning, and s of `Played.waited` since then.
        """
        self.played = Played()
        self._tell = tell
        self.follower: Follower | None = None
        self._publishers, self._rate, self._stop = publishers, rate, stop
        self._clock = (
            node.create_publisher(Clock, "/clock", QoSProfile(depth=10)) if clock_rate else None
        )
        self._clock_period = 1.0 / clock_rate if clock_rate else 0.0
        self._stamped = {
            topic for topic, publisher in publishers.items() if is_stamped(publisher.msg_type)
        }
        self._tdoas = {topic for topic, publisher in publishers.items() if is_tdoa(publisher)}
        self._sensors = {topic for topic, publisher in publishers.items() if is_sensor(publisher)}
        self._latched = [publisher for publisher in publishers.values() if is_latched(publisher)]
        self._start: int | None = None  # ns, stamp of the first message
        self._began = self._next_tick = self._tell_next = 0.0

    def count(self, what: str) -> int:
        """Return how many "TDOAs" or "IMU samples" were published."""
        kind = {"TDOAs": "Tdoa", "IMU samples": "Imu"}[what]
        return sum(
            n
            for topic, n in self.played.counts.items()
            if _kind(self._publishers[topic]) == kind and topic not in self._sensors
        )

    def play(self, recorded: Iterable[tuple[Connection, int, bytes]]) -> None:
        """Publish an iterable of (connection, time of recording in ns, bytes) from the beginning."""
        self._start, first = None, time.perf_counter()
        waited_before, self._tell_next = self.played.waited, first + PROGRESS
        for connection, stamp, data in recorded:
            if self._start is None:
                self._start, self._began = stamp, time.perf_counter()
                self._next_tick = self._began
            if (now := time.perf_counter()) > self._tell_next:
                self._tell_next = now + PROGRESS
                waited = self.played.waited - waited_before
                self._tell((stamp - self._start) / 1e9, now - first, waited)
            behind = self._sleep_until(self._began + (stamp - self._start) / (1e9 * self._rate))
            if self._stop:
                return
            self._limit_catch_up(behind)
            publisher, topic = self._publishers[connection.topic], connection.topic
            if self._latched and not is_latched(publisher):
                self._began += self._wait_for_latched()
            if self.follower is not None and topic in self._stamped:
                waited = self.follower.wait(stamp_of(data), self._stop)
                self.played.waited += waited
                self._began += waited
            if self._publish(publisher, data):
                self.played.counts[topic] += 1
                if self.follower is not None and topic in self._tdoas:
                    self.follower.add_tdoa(stamp_of(data))
                elif (
                    self.follower is not None
                    and topic in self._sensors
                    and publisher.get_subscription_count()
                ):
                    self.follower.add_sensor(topic, stamp_of(data))

    def _wait_for_latched(self) -> float:
        """Wait for the acknowledgement of latched messages (anchors), and return how long, s.

        This comes before the first message of a stream. The latched publishers were made last, and a
        participant discovers our publishers in the order of creation. So a participant that acknowledges
        them receives all other topics too, including the best-effort ones.
        """
        began = time.perf_counter()
        for publisher in self._latched:
            while time.perf_counter() < began + LATCHED_LIMIT and not self._stop:
                if publisher.wait_for_all_acked(Duration(seconds=LONGEST_SLEEP)):
                    break
        self._latched = []
        return time.perf_counter() - began

    def _sleep_until(self, due: float) -> float:
        """Sleep until `due`, publish the clock meanwhile, and return the delay, s."""
        while True:
            now = time.perf_counter()
            if self._clock is not None and now >= self._next_tick:
                self._tick(min(now, due))
                self._next_tick = max(self._next_tick + self._clock_period, now)
            if now >= due or self._stop:
                return now - due
            wake = due if self._clock is None else min(due, self._next_tick)
            time.sleep(min(max(wake - now, 0.0), LONGEST_SLEEP))

    def _tick(self, now: float) -> None:
        assert self._clock is not None and self._start is not None
        nanoseconds = self._start + int((now - self._began) * 1e9 * self._rate)
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(nanoseconds, 10**9)
        self._clock.publish(message)

    def _limit_catch_up(self, behind: float) -> None:
        """Count a delay, in s. What exceeds LARGEST_CATCH_UP shifts all later messages."""
        self.played.behind = max(self.played.behind, behind)
        if behind > LARGEST_CATCH_UP:
            self._began += behind - LARGEST_CATCH_UP
            self.played.stretched += behind - LARGEST_CATCH_UP

    def _publish(self, publisher: Publisher, data: bytes) -> bool:
        """Publish one message. Returns False if stopped while the queue was full.

        The queue is full while reliable subscriptions have acknowledged nothing of its content.
        """
        until = time.monotonic() + ACKNOWLEDGE_LIMIT
        while True:
            try:
                publisher.publish(data)
                return True
            except RCLError as error:  # full for longer than DDS waits, 0.1 s
                if self._stop:
                    return False
                if time.monotonic() > until:
                    raise InputError(
                        f"{publisher.topic_name}: a subscription has not acknowledged anything for "
                        f"{ACKNOWLEDGE_LIMIT:g} s ({error}); stop it, or let it subscribe "
                        "best effort."
                    ) from error


# In no robot's namespace:
GLOBAL = "/tf", "/tf_static", "/clock", "/diagnostics", "/rosout", "/parameter_events"
# s from the last match to the first message, and from the last message to the end: the other side
# discovers a little later
SETTLE = 0.2
# parameter `anchors_file`: they need no uwb/anchors with it
TAKE_ANCHORS_FILE = frozenset(("bias_node", "ekf_node", "debias_node"))
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
        _wait_for_listeners(node, publishers, options, stop, say)
        wait_for_names(node)
        _leave_out_anchors(node, publishers, say)
        _remark_imu(node, publishers, connections, bag, say)
        connections = [each for each in connections if each.topic in publishers]
        count = sum(connection.msgcount for connection in connections)
        length = (reader.end_time - reader.start_time) / 1e9
        tell = partial(_tell_progress, length, options.follow, say)
        player = Player(node, publishers, options.rate, options.clock_rate, stop, tell)
        nodes = Nodes(node, say) if options.follow else None
        player.follower = (
            Follower(node, options.follow, nodes) if options.follow and nodes else None
        )
        say(f"playing {count} messages, {length:.1f} s at rate {options.rate:g}")
        began = time.perf_counter()
        while not stop:
            with closing(read_ahead(reader.messages(connections))) as recorded:
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


def _leave_out_anchors(
    node: Node, publishers: dict[str, Publisher], say: Callable[[str], object]
) -> None:
    """Drop the publisher of anchors if each node that hears it has anchors of its own."""
    for topic, publisher in [*publishers.items()]:
        if _kind(publisher) != "AnchorArray":
            continue
        ends = node.get_subscriptions_info_by_topic(publisher.topic_name)
        if not ends or not {end.node_name for end in ends} <= TAKE_ANCHORS_FILE:
            continue
        names = sorted({f"{end.node_namespace.rstrip('/')}/{end.node_name}" for end in ends})
        if all(parameter_of(node, name, "anchors_file") for name in names):
            say(f"leaving out {topic}: {', '.join(names)} have anchors_file, which counts")
            node.destroy_publisher(publisher)
            del publishers[topic]


def _remark_imu(
    node: Node,
    publishers: dict[str, Publisher],
    connections: Iterable[Connection],
    bag: str | Path,
    say: Callable[[str], object],
) -> None:
    """Give the remedy if ekf_node uses an IMU and the bag has no inertial samples."""
    space = node.get_namespace()
    if ("ekf_node", space) not in node.get_node_names_and_namespaces() or any(
        connection.msgcount and is_imu(publishers[connection.topic])
        for connection in connections
        if connection.topic in publishers
    ):
        return
    name = f"{space.rstrip('/')}/ekf_node"
    if parameter_of(node, name, "use_imu"):
        say(
            f"{bag} has no inertial samples, and {name} uses an IMU: it will report an error on "
            "/diagnostics. Start it with -p use_imu:=false"
        )


def _tell_progress(
    length: float,
    followed: str | None,
    say: Callable[[str], object],
    played: float,
    took: float,
    waited: float,
) -> None:
    """Say how much of a recording was played, and estimate the rest. All times in s."""
    left = took * (length / played - 1.0) if played > 0.0 else float("nan")
    rest = f", about {left:.0f} s left" if left >= 0.0 else ""
    waiting = f", of which {waited:.0f} s waiting for {followed}" if followed else ""
    say(f"played {played:.1f} of {length:.1f} s in {took:.0f} s{waiting}{rest}")


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
