# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Replay a bag over topics as recorded, paced by the stamps, in step with the nodes that it feeds."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
import itertools
import math
from pathlib import Path
import struct
import time
from typing import Any, TypeVar

import rclpy
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rosbags.interfaces import Connection
from rosgraph_msgs.msg import Clock

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_bias.ros.node import waiting

from ..bags.files import BagReader, open_bag
from ..choices import WAIT
from .session import (
    ANSWER_LIMIT,
    LOOK,
    READER_DEPTH,
    SETTLE_LIMIT,
    SPIN,
    DiagnosticsListener,
    Stop,
    message_class,
    parameter_of,
    publisher_qos,
    session,
    subscription_qos,
    wait_for_names,
)

LEAD = 2_000_000_000  # ns of stamps that may be played ahead
# ns; the replay waits for each TDOA that is older than the newest by more than STEP. STEP exceeds
# `reorder` of ekf_node: the filter can have used that TDOA. STEP is below `hold` of bias_node and
# `lag` of ekf_node: neither gives up data that are on the way.
STEP = 80_000_000
# ns; STEP for the time START after the first pose. START_STEP is below `pose_lag` of bias_node,
# which passes TDOAs on until it has a pose.
START_STEP, START = 40_000_000, 1_000_000_000
LOOK_PERIOD = LEAD // 20  # ns of stamps between two looks at a topic that is in step or silent
SENSOR_SILENT = (
    1_000_000_000  # ns until ekf_node stops waiting for a silent sensor: reorder_buffer.SILENT
)
SENSOR_SHARE = (
    0.5  # of `lag`: how long ekf_node holds TDOAs back for a sensor: reorder_buffer.OF_SENSORS
)
LAG = 0.25  # s, default of `lag`
IDLE = 2  # reports of a node with unchanged counters after which it has nothing to do
SILENCE = 5.0  # s without a message after which a topic of other nodes is silent
# s without output or a change of a counter after which the nodes are stuck, on any machine
STUCK = 120.0
POLL_PERIOD = 0.001  # s
RESIDUAL = "uwb/residual"
LEARNED = 20  # TDOAs from which the shift of stamps by bias_node is estimated


class Follower:
    """Watch a topic whose messages have a header, and hold a replay until the topic catches up.

    If uwb/residual has a publisher, each TDOA is followed too (`add_tdoa`).
    """

    def __init__(self, node: Node, topic: str, nodes: Nodes) -> None:
        """Subscribe to the topic.

        Parameters
        ----------
        node : Node
            It does not spin: messages are polled.
        topic : str
            Name, relative to the namespace of the node or absolute.
        nodes : Nodes
            The nodes that are fed.

        Raises
        ------
        InputError
            If the topic has no publisher, or its messages have no header.
        """
        topic = node.resolve_topic_name(topic)
        types = dict(node.get_topic_names_and_types()).get(topic)
        if not types or not node.count_publishers(topic):
            raise InputError(f"--follow: nobody publishes {topic}; start the node that does first.")
        cls = message_class(types[0])
        if not is_stamped(cls):
            raise InputError(
                f"--follow: messages on {topic} are {types[0]}: not installed, or without a header."
            )
        qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._topic = _Topic(node, cls, topic, qos, nodes)
        self._newest: int | None = None  # ns, stamp of the newest message on the topic
        self._last_look: int | None = None  # ns, stamp of the replay at the last look
        self._started = math.inf  # ns, stamp of the first message on the topic
        self._residuals: _Topic | None = None
        self._sensor_wait = round(1e9 * SENSOR_SHARE * nodes.lag)
        publishers = node.get_publishers_info_by_topic(node.resolve_topic_name(RESIDUAL))
        residual = message_class(publishers[0].topic_type) if publishers else None
        if residual is not None:
            qos = subscription_qos([publisher.qos_profile for publisher in publishers])
            qos.depth = 10 * READER_DEPTH
            self._residuals = _Topic(node, residual, RESIDUAL, qos, nodes)
        self._start_over()

    def _start_over(self) -> None:
        """Forget the TDOAs of a recording that ends or restarts."""
        self._begin = -math.inf  # ns; older TDOAs need not leave the filter
        self._played = -math.inf  # ns, newest stamp of a TDOA that was published
        self._out = -math.inf  # ns, newest stamp that left the filter
        if self._residuals is not None:
            self._residuals.silent = False
        self._first: deque[int] = deque()  # first stamps that were published
        self._shift = 0  # ns by which the same stamps are smaller when they leave the filter
        self._learned = 0  # number of stamps from which `_shift` is known
        self._sensors: dict[str, int] = {}  # {topic: ns, newest stamp that was published}
        # Whether START_STEP is too small, because the recorded IMU is behind the TDOAs.
        self._behind = False

    def add_tdoa(self, stamp: int) -> None:
        """Note that a TDOA with this stamp, ns, was published."""
        if stamp < self._played - LEAD:  # the recording restarts
            self._start_over()
        if self._played == -math.inf:
            self._begin = stamp - 1
        self._played = max(self._played, stamp)
        if self._learned < LEARNED:
            self._first.append(stamp)

    def add_sensor(self, topic: str, stamp: int) -> None:
        """Note that a measurement of one of the SENSORS with this stamp, ns, was published."""
        self._sensors[topic] = stamp

    def wait(self, stamp: int, stop: Stop) -> float:
        """Wait until a message may be published, and return how long that took, s.

        The topic must not be more than LEAD behind the message. Each TDOA that is older by STEP than
        the time of the filter must have come back on uwb/residual. That time is the stamp of the newest TDOA, or
        less while the filter waits for a sensor.

        Parameters
        ----------
        stamp : int
            Stamp of the message, ns.
        stop : Stop
            True once the wait shall end.
        """
        return self._wait_for_tdoas(self._is_starting(stamp), stop) + self._wait_for_stamps(
            stamp, stop
        )

    def _is_starting(self, stamp: int) -> bool:
        """Return whether bias_node may still lack poses at this stamp, ns."""
        if stamp < self._started - LEAD:  # nothing has come, or the recording restarts
            self._started = math.inf
            self._hear(self._topic.stamps())
        return stamp < self._started + START

    def _hear(self, stamps: list[int]) -> None:
        """Note the stamps, ns, of the messages that have come."""
        if stamps:
            self._newest = stamps[-1]
            self._started = self._newest if self._started == math.inf else self._started

    def _wait_for_stamps(self, stamp: int, stop: Stop) -> float:
        self._newest = stamp if self._newest is None else self._newest
        self._last_look = stamp if self._last_look is None else self._last_look

        def in_step() -> bool:
            assert self._newest is not None
            return stamp - self._newest <= LEAD

        near = self._topic.silent or in_step()
        if near and 0 <= stamp - self._last_look <= LOOK_PERIOD:
            return 0.0
        self._last_look = stamp
        return self._topic.wait(self._hear, in_step, stop)

    def _wait_for_tdoas(self, starting: bool, stop: Stop) -> float:
        step = START_STEP if starting and not self._behind else STEP
        if self._residuals is None or self._is_in_step(step):
            return 0.0
        waited = self._residuals.wait(self._learn, lambda: self._is_in_step(step), stop)
        self._behind = self._behind or self._residuals.silent and step == START_STEP
        return waited

    def _is_in_step(self, step: int) -> bool:
        """Return whether the TDOAs that are older by `step`, ns, than the time of the filter have left it."""
        sensors = [
            stamp for stamp in self._sensors.values() if stamp > self._played - SENSOR_SILENT
        ]
        time_of_filter = max(min((self._played, *sensors)), self._played - self._sensor_wait)
        return time_of_filter - step <= max(self._begin, self._out + self._shift)

    def _learn(self, stamps: list[int]) -> None:
        """Note stamps that left the filter. The first ones show by how much an effect shifts them."""
        self._out = max([self._out, *stamps])
        for stamp in stamps[: len(self._first)]:
            if self._learned < LEARNED:
                self._shift = max(self._shift, self._first.popleft() - stamp)
                self._learned += 1


class _Topic:
    """Poll a topic, and wait for its messages unless the nodes are idle.

    Attributes
    ----------
    silent : bool
        Whether the last wait ended because the nodes had nothing to do.
    """

    def __init__(self, node: Node, cls: Any, topic: str, qos: QoSProfile, nodes: Nodes) -> None:
        self._subscription = node.create_subscription(cls, topic, lambda _: None, qos, raw=True)
        self._nodes = nodes
        self.silent = False

    def stamps(self) -> list[int]:
        """Return the stamps, ns, of the messages that have arrived."""
        found = [stamp_of(data) for data, _ in waiting(self._subscription)]
        self.silent = self.silent and not found
        return found

    def wait(
        self, hear: Callable[[list[int]], object], in_step: Callable[[], bool], stop: Stop
    ) -> float:
        """Call hear(stamps) until in_step(), silence or `stop`. Return how long that took, s."""
        began = time.monotonic()
        self._nodes.watch()
        while not stop:
            if stamps := self.stamps():
                self._nodes.watch()
            hear(stamps)
            if in_step() or self.silent:
                break
            self.silent = self._nodes.are_idle()
            time.sleep(POLL_PERIOD)
        return time.monotonic() - began


def is_stamped(cls: Any) -> bool:
    """Return whether the messages of a class, or None, begin with a header."""
    return (
        cls is not None
        and next(iter(cls.get_fields_and_field_types().values()), None) == "std_msgs/Header"
    )


def stamp_of(data: bytes) -> int:
    """Return the stamp, ns, of a serialized message (CDR) that begins with a header."""
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return seconds * 10**9 + nanoseconds


PATIENCE = {"bias_node": "hold", "ekf_node": "lag"}  # parameters, s of stamps
TROUBLE = {  # {node: {key in its diagnostics: words}}
    "bias_node": {"released before their pose": "TDOAs corrected before their pose was there"},
    "ekf_node": {
        "late": "TDOAs late",
        "imu_late": "IMU samples late",
        **{f"{name}_late": f"{of.plural} late" for name, of in SENSORS.items()},
    },
}
RECEIVED = {  # {node: {key in its diagnostics: what it counts}}
    "bias_node": {"received": "TDOAs"},
    "ekf_node": {"TDOAs received": "TDOAs", "IMU samples received": "IMU samples"},
}


class Nodes:
    """Read the counters of bias_node and ekf_node in our namespace, while a replay feeds them.

    Attributes
    ----------
    lag : float
        Parameter `lag` of ekf_node, s.
    """

    lag = LAG

    def __init__(self, node: Node, say: Callable[[str], object] = print) -> None:
        """Find the nodes and read their counters.

        Parameters
        ----------
        node : Node
            Our node.
        say : callable
            Called with a sentence if the replay waits for long.

        Raises
        ------
        InputError
            If their parameters end a wait too early, or a node publishes no /diagnostics.
        """
        self._node, self._diagnostics, self._say = node, DiagnosticsListener(node), say
        # s, beginning of the watch, last look at the graph, and last change of a counter
        self._watched = self._looked = self._moved = 0.0
        self._counts_before: dict[str, dict[str, str]] = {}
        space = node.get_namespace()
        wait_for_names(node)
        self._names = {
            name: f"{space.rstrip('/')}/{name}" for name in TROUBLE if self._is_there(name)
        }
        if len(self._names) == len(TROUBLE):
            self._check_patience()
        self._before = self._counts(bool)
        for name in self._names:
            if not self._before[name]:
                raise InputError(
                    f"--follow: {self._names[name]} says nothing on /diagnostics for "
                    f"{SETTLE_LIMIT:g} s; start it again."
                )

    def _is_there(self, name: str) -> bool:
        return (name, self._node.get_namespace()) in self._node.get_node_names_and_namespaces()

    def watch(self) -> None:
        """Start to watch whether the nodes have nothing to do."""
        self._diagnostics.forget()
        self._watched = self._looked = self._moved = time.monotonic()

    def are_idle(self) -> bool:
        """Return whether no node has anything to do: each has reported unchanged counters.

        A node that does not report gets no processor time: it has something to do until it leaves
        the graph, or is STUCK. Without our nodes, SILENCE decides.

        Raises
        ------
        InputError
            If the nodes have done nothing for STUCK s.
        """
        self._diagnostics.poll()
        now = time.monotonic()
        if not self._names:
            return now > self._watched + SILENCE
        busy = [
            name
            for name, full in self._names.items()
            if self._diagnostics.repeated(full.strip("/")) < IDLE
        ]
        if busy and now > self._looked + LOOK:
            self._looked, busy = now, [name for name in busy if self._is_there(name)]
            names = " and ".join(busy) or "nodes that have ended"
            counts, self._counts_before = self._counts_before, self._diagnostics.counts()
            if counts != self._counts_before:
                self._moved = now
            if busy and now > self._moved + STUCK:
                raise InputError(
                    f"--follow: {names}: no progress for {STUCK:g} s, stuck or without processor "
                    "time; the machine is too slow: end other programs, and start again."
                )
            self._say(f"waiting for {names}")
        return not busy

    def faults(self, count_played: Callable[[str], int], stop: Stop) -> dict[str, int]:
        """Return {fault since the start: count}, once the diagnostics have settled or on `stop`.

        Parameters
        ----------
        count_played : callable
            Number of messages of a kind ("TDOAs", "IMU samples") that the replay published.
        stop : Stop
            True once the process was asked to end.
        """
        after = self._counts(lambda _: stop or self._diagnostics.is_settled())
        since = {
            name: {
                key: count - self._before[name].get(key, 0) for key, count in after[name].items()
            }
            for name in self._names
        }
        wrong = {}
        for name, counts in since.items():
            for key, what in TROUBLE[name].items():
                wrong[what] = counts.get(key, 0)
            for key, what in RECEIVED[name].items() if len(self._names) == len(TROUBLE) else ():
                on_their_way = (
                    since["bias_node"].get("waiting", 0)
                    if (name, what) == ("ekf_node", "TDOAs")
                    else 0
                )
                lost = count_played(what) - counts.get(key, 0) - on_their_way
                wrong[f"{what} lost"] = max(lost, wrong.get(f"{what} lost", 0))
        return {what: count for what, count in wrong.items() if count > 0}

    def _counts(
        self, is_enough: Callable[[DiagnosticsListener], object]
    ) -> dict[str, dict[str, int]]:
        """Return {node: {key: count}} when each node has published and is_enough(diagnostics) holds."""
        until = time.monotonic() + SETTLE_LIMIT
        self._diagnostics.forget()
        newest = {}
        while self._names and time.monotonic() < until:
            rclpy.spin_once(self._node, timeout_sec=SPIN)
            newest = {
                name: self._diagnostics.newest(full.strip("/"))
                for name, full in self._names.items()
            }
            if all(newest.values()) and is_enough(self._diagnostics):
                break
        return {
            name: {key: int(text) for key, text in values.items() if text.isdigit()}
            for name, values in newest.items()
        }

    def _check_patience(self) -> None:
        """Require: longest wait in the filter < hold < lag. Else a node drops data that are on the way."""
        hold, self.lag = (self._parameter(name, parameter) for name, parameter in PATIENCE.items())
        least = 1e-9 * STEP + SENSOR_SHARE * self.lag
        if not least < hold < self.lag:
            raise InputError(
                f"--follow: bias_node's hold is {hold:g} s and ekf_node's lag {self.lag:g} s; "
                "to be followed they need "
                f"{least:g} s < hold < lag."
            )

    def _parameter(self, name: str, parameter: str) -> float:
        value = parameter_of(self._node, self._names[name], parameter)
        if value is None:
            raise InputError(
                f"--follow: {self._names[name]} does not answer for {ANSWER_LIMIT:g} s; start "
                "it again."
            )
        return float(value)


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
        self._start = 0  # ns, stamp of the first message
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
        first = time.perf_counter()
        waited_before, self._tell_next = self.played.waited, first + PROGRESS
        for number, (connection, stamp, data) in enumerate(recorded):
            if number == 0:
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
        _wait_acknowledged(self._latched, LATCHED_LIMIT, self._stop)
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
        assert self._clock is not None
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

    played: Played
    took: float
    acknowledged: bool
    stopped_by: int | None
    wrong: dict[str, int]


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
        if not any(connection.msgcount for connection in connections):
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
        acknowledged = _wait_acknowledged(publishers.values(), ACKNOWLEDGE_LIMIT, stop)
        # Best-effort subscriptions acknowledge nothing, and may read from the memory of this process.
        time.sleep(SETTLE)
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
    heard: list[tuple[int, int]] = []
    while not stop:
        now = time.monotonic()
        ends = [  # subscriptions of each topic that get its messages, and all
            (publisher.get_subscription_count(), node.count_subscribers(publisher.topic_name))
            for publisher in (publishers[topic] for topic in wanted)
        ]
        followed = not options.follow or node.count_publishers(
            node.resolve_topic_name(options.follow)
        )
        missing = [topic for topic, (count, _) in zip(wanted, ends) if not count]
        if ends != heard:
            heard, changed = ends, now
        enough = not missing or (
            now > changed + DISCOVERY
            and len(missing) < len(wanted)
            and not set(missing) & set(needed)
        )
        matched = all(count >= there for count, there in ends)
        if (enough and followed and matched) or now > began + options.wait:
            break
        time.sleep(0.01)
    unheard = [publishers[topic].topic_name for topic in missing if topic in needed]
    if not stop and (unheard or len(missing) == len(wanted)):
        what = unheard[0] if unheard else "any topic of the bag"
        raise InputError(
            f"nobody subscribes to {what} within {options.wait:g} s; start the nodes first, "
            "or wait longer "
            "(--wait-matched)."
        )
    if missing:
        without = ", ".join(publishers[topic].topic_name for topic in missing)
        say(f"nobody subscribes to {without}")
    time.sleep(SETTLE)


def _leave_out_anchors(
    node: Node, publishers: dict[str, Publisher], say: Callable[[str], object]
) -> None:
    """Drop the publisher of anchors if each node that hears it has anchors of its own."""
    for topic, publisher in [*publishers.items()]:
        ends = node.get_subscriptions_info_by_topic(publisher.topic_name)
        names = sorted({f"{end.node_namespace.rstrip('/')}/{end.node_name}" for end in ends})
        ours = (
            _kind(publisher) == "AnchorArray"
            and {end.node_name for end in ends} <= TAKE_ANCHORS_FILE
        )
        if ends and ours and all(parameter_of(node, name, "anchors_file") for name in names):
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
        connection.msgcount and _kind(publisher) == "Imu" and not is_sensor(publisher)
        for connection in connections
        if (publisher := publishers.get(connection.topic))
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


def _wait_acknowledged(publishers: Iterable[Publisher], limit: float, stop: Stop) -> bool:
    """Return whether every subscription has every message, after at most `limit` s."""
    until = time.monotonic() + limit
    for publisher in publishers:
        while not publisher.wait_for_all_acked(Duration(seconds=LONGEST_SLEEP)):
            if stop or time.monotonic() > until:
                return False
    return True
