# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Publish recorded messages in the time between their stamps."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
import queue
import threading
import time
from typing import TYPE_CHECKING, TypeVar

from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors import SENSORS

from .follow import is_stamped, stamp_of

if TYPE_CHECKING:
    from collections.abc import Generator, Iterable

    from rclpy.node import Node
    from rclpy.publisher import Publisher
    from rosbags.interfaces import Connection

    from .follow import Follower
    from .session import Stop


Item = TypeVar("Item")

BATCH = 500
BATCHES_AHEAD = 100


def read_ahead(messages: Iterable[Item]) -> Generator[Item, None, None]:
    """Yield the items of an iterable, read by a thread up to 50,000 items ahead.

    Decoding a chunk of a bag then delays no message. Exceptions of the iterable are raised here.
    """
    batches: queue.Queue[list[Item] | BaseException | None] = queue.Queue(BATCHES_AHEAD)
    closed = threading.Event()

    def put(item: list[Item] | BaseException | None) -> None:
        while not closed.is_set():
            try:
                return batches.put(item, timeout=0.1)
            except queue.Full:
                pass

    def read() -> None:
        batch: list[Item] = []
        try:
            for message in messages:
                batch.append(message)
                if len(batch) == BATCH:
                    put(batch)
                    batch = []
                if closed.is_set():
                    return
            put(batch)
            put(None)
        except BaseException as error:
            put(batch)
            put(error)

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    try:
        while (batch := batches.get()) is not None:
            if isinstance(batch, BaseException):
                raise batch
            yield from batch
    finally:
        closed.set()
        thread.join()


RCLError = rclpy_implementation.RCLError
LARGEST_CATCH_UP = 0.1  # s; a longer delay shifts all later messages: a burst overruns queues
LATCHED_LIMIT = 5.0  # s for the acknowledgement of latched messages
LONGEST_SLEEP = 0.05  # s until a signal is seen
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
            True once the process was asked to end.
        """
        self.played = Played()
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
        self._began = self._next_tick = 0.0

    def count(self, what: str) -> int:
        """Return how many "TDOAs" or "IMU samples" were published."""
        kind = {"TDOAs": "Tdoa", "IMU samples": "Imu"}[what]
        return sum(
            n
            for topic, n in self.played.counts.items()
            if _kind(self._publishers[topic]) == kind and topic not in self._sensors
        )

    def play(self, recorded: Iterable[tuple[Connection, int, bytes]]) -> None:
        """Publish an iterable of (connection, stamp ns, bytes) from the beginning."""
        self._start = None
        for connection, stamp, data in recorded:
            if self._start is None:
                self._start, self._began = stamp, time.perf_counter()
                self._next_tick = self._began
            behind = self._sleep_until(self._began + (stamp - self._start) / (1e9 * self._rate))
            if self._stop:
                return
            self._count_delay(behind)
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

    def _count_delay(self, behind: float) -> None:
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
