"""Publishing recorded messages in the time between their stamps."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
import time
from typing import TYPE_CHECKING

from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.qos import DurabilityPolicy, QoSProfile
from rosgraph_msgs.msg import Clock

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.sensors import SENSORS

from .follow import is_stamped, stamp_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    from rclpy.node import Node
    from rclpy.publisher import Publisher
    from rosbags.interfaces import Connection

    from .follow import Follower
    from .session import Stop

RCLError = rclpy_implementation.RCLError
# s: a longer delay shifts all that follows, instead of a burst that a subscription cannot take
LARGEST_CATCH_UP = 0.1
LATCHED_LIMIT = 5.0  # s that somebody may take to acknowledge what is latched
LONGEST_SLEEP = 0.05  # s: how soon a signal is seen
ACKNOWLEDGE_LIMIT = 30.0  # s; longer than the 20 s after which DDS forgets a subscription that died


@dataclass
class Played:
    """What was published.

    counts : messages by topic in the bag; behind : s, the latest that a message was; stretched : s,
        by how much the
    time of the replay was stretched, so that a stall was not followed by a burst that nobody can
    take; waited : s, for the topic that is followed.
    """

    counts: Counter[str] = field(default_factory=Counter)
    behind: float = 0.0
    stretched: float = 0.0
    waited: float = 0.0


def is_latched(publisher: Publisher) -> bool:
    """Whether who subscribes late gets the last messages too."""
    return publisher.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL


def is_tdoa(publisher: Publisher) -> bool:
    """Whether it publishes raw TDOAs."""
    return _kind(publisher) == "Tdoa"


def is_aid(publisher: Publisher) -> bool:
    """Whether it publishes what one of the SENSORS measures, for ekf_node."""
    return publisher.topic_name.endswith(
        tuple(f"/{topic}" for sensor in SENSORS.values() for topic, _ in sensor.topics)
    )


def _kind(publisher: Publisher) -> str:
    """Name of the class of its messages."""
    return publisher.msg_type.__name__  # type: ignore[attr-defined]  # rclpy says of the class that it is a message


class Player:
    """Publishes to {topic in the bag: publisher}, `rate` times as fast as recorded, with /clock if
    it has a rate, Hz.

    stop : true once the process was asked to end; follower : Follower or None; played : Played.
    """

    def __init__(
        self,
        node: Node,
        publishers: dict[str, Publisher],
        rate: float,
        clock_rate: float | None,
        stop: Stop,
    ) -> None:
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
        self._aids = {topic for topic, publisher in publishers.items() if is_aid(publisher)}
        self._latched = [publisher for publisher in publishers.values() if is_latched(publisher)]
        self._start: int | None = None  # ns, stamp of the first message
        self._began = self._next_tick = 0.0

    def count(self, what: str) -> int:
        """How many "TDOAs" or "IMU samples" have been played."""
        kind = {"TDOAs": "Tdoa", "IMU samples": "Imu"}[what]
        return sum(
            n for topic, n in self.played.counts.items() if _kind(self._publishers[topic]) == kind
        )

    def play(self, recorded: Iterable[tuple[Connection, int, bytes]]) -> None:
        """Publish an iterable of (connection, stamp ns, bytes), from the beginning."""
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
                    and topic in self._aids
                    and publisher.get_subscription_count()
                ):
                    self.follower.add_aid(topic, stamp_of(data))

    def _wait_for_latched(self) -> float:
        """Wait, before the first message of a stream, until what is latched (the anchors) has been
        acknowledged. Returns the s that took.

        Their publishers were made last, and a participant hears of our publishers in the order in
        which they were made: who acknowledges a message of theirs listens to all the others too,
        the best-effort ones among them.
        """
        began = time.perf_counter()
        for publisher in self._latched:
            while time.perf_counter() < began + LATCHED_LIMIT and not self._stop:
                if publisher.wait_for_all_acked(Duration(seconds=LONGEST_SLEEP)):
                    break
        self._latched = []
        return time.perf_counter() - began

    def _sleep_until(self, due: float) -> float:
        """Sleep, and publish the clock meanwhile. Returns the s by which it is later than due."""
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
        """Publish, after waiting until reliable subscriptions have acknowledged what the history is
        full of. Returns False if stopped while it waited.
        """
        until = time.monotonic() + ACKNOWLEDGE_LIMIT
        while True:
            try:
                publisher.publish(data)
                return True
            except RCLError as error:  # full for longer than DDS waits by itself, 0.1 s
                if self._stop:
                    return False
                if time.monotonic() > until:
                    raise InputError(
                        f"{publisher.topic_name}: a subscription has not acknowledged anything for "
                        f"{ACKNOWLEDGE_LIMIT:g} s ({error}); stop it, or let it subscribe "
                        "best effort."
                    ) from error
