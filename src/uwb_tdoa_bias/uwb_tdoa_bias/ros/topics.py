# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Topics of a node: single messages, and streams of which a node takes all that arrived at once.

The messages of a stream wait in the middleware, as bytes. `Streams.take` reads them, and hands on
rows and stamps in s.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import copy
import time
from typing import Any, TypeVar, overload

from builtin_interfaces.msg import Time
import numpy as np
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.topic_endpoint_info import TopicEndpointInfo

from ..common.stamps import LARGEST_STEP_BACK
from .cdr import CdrCodec, CdrTemplate, Message, Unreadable, decode, name_of
from .node import ParameterNode, unserved, waiting

# frame, stamps, rows and arrivals
Take = Callable[[str, np.ndarray, np.ndarray, np.ndarray], None]
Content = TypeVar("Content")  # what is read of a message
Part = tuple[str, np.ndarray, np.ndarray]  # frame, rows and arrivals of successive messages


class Epoch:
    """Stamps as float seconds, counted from the whole second of the first stamp.

    They are exact to 1 ns within 48 days of the first stamp. Seconds since 1970 in a float64 would be
    exact to 2e-7 s only. The float is the one nearest to the stamp, as in `bags`. The sum of seconds
    and 1e-9 times nanoseconds is sometimes its neighbor: on a grid of stamps, a sample then falls on
    the other side of a period.
    """

    def __init__(self) -> None:
        self._second: int = None  # type: ignore[assignment]  # s since 1970, of the first stamp; None before it

    def seconds(self, stamp: Time) -> float:
        """Return float s of a builtin_interfaces/Time."""
        if self._second is None:
            self._second = stamp.sec
        return ((stamp.sec - self._second) * 10**9 + stamp.nanosec) / 1e9

    def seconds_of(self, sec: np.ndarray, nanosec: np.ndarray) -> np.ndarray:
        """Return float s, (n,), of the two parts of stamps, (n,) each."""
        if self._second is None:
            self._second = int(sec[0])
        return ((sec.astype(np.int64) - self._second) * 10**9 + nanosec) / 1e9

    def parts(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return seconds and nanoseconds of t (n,) s, to 1 ns; the inverse of `seconds_of`."""
        second, nanosecond = np.divmod(np.round(t * 1e9).astype(np.int64), 10**9)
        return self._second + second, nanosecond

    @property
    def begin(self) -> int:
        """Stamp of the origin of `seconds`, s since 1970."""
        return self._second or 0

    def stamp(self, t: float) -> Time:
        """Return the builtin_interfaces/Time of t s; the inverse of `seconds`, exact to 1 ns."""
        second, nanosecond = divmod(round(t * 1e9), 10**9)
        return Time(sec=self._second + second, nanosec=nanosecond)


# Inputs are best effort: such subscriptions receive from every publisher. They are deep, since a
# node that was not scheduled for a moment must find all messages: 10 s of a 1 kHz IMU, or 2.5 s of
# it replayed at 4x speed. Memory is taken only where it is used. Outputs are reliable, since every
# subscriber receives them; RViz and most others request it.
STREAM_QOS = QoSProfile(depth=10_000, reliability=ReliabilityPolicy.BEST_EFFORT)
OUTPUT_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
LARGEST_LOSS = 0.01  # largest lost share of messages per second
LONGEST_WAIT = 0.02  # s; longest time that `wait_for` delays the streams
ROUNDING = 1e-6  # s; two computations of a stamp since 1970 differ by less
# rclpy writes these into the given profile.
OVERRIDES = QoSOverridingOptions([QoSPolicyKind.RELIABILITY, QoSPolicyKind.DEPTH])


def publish_stream(node: Node, kind: type, topic: str) -> Publisher:
    """Return a publisher of a stream.

    QoS by parameter: qos_overrides.<topic>.publisher.reliability and .depth.
    """
    return node.create_publisher(kind, topic, copy(OUTPUT_QOS), qos_overriding_options=OVERRIDES)


class Refusals:
    """Unreadable messages of a topic.

    Attributes
    ----------
    count : their number
    reason : of the last one
    topic : its name
    """

    def __init__(self, node: ParameterNode, topic: str, kind: type) -> None:
        self.count, self.reason = 0, ""
        self.topic, self._node, self._kind, self._before = topic, node, kind, 0

    def add(self, error: Unreadable) -> None:
        """Count one unreadable message."""
        self.count, self.reason = self.count + 1, str(error)
        self._node.warn_at_times(
            f"unreadable {self.topic}",
            f"{self.topic}: a message cannot be read and is not used: {error}",
        )

    def trouble(self) -> str | None:
        """Return the sentence on unreadable messages since the last call, or None."""
        new, self._before = self.count - self._before, self.count
        if not new:
            return None
        others = self._others()
        remedy = (
            f"{others} publishes another version of {name_of(self._kind)}: build it anew"
            if others
            else "check who publishes it"
        )
        return f"{new} messages on {self.topic} cannot be read ({self.reason}): {remedy}"

    def _others(self) -> str:
        """Return the names of publishers with another definition of the type, as text."""
        name = self._node.resolve_topic_name(self.topic)
        own = {
            str(end.topic_type_hash)
            for end in self._node.get_subscriptions_info_by_topic(name)
            if end.node_name == self._node.get_name()
        }
        ends = self._node.get_publishers_info_by_topic(name)
        return _names(end for end in ends if str(end.topic_type_hash) not in own)


def publishers_of(node: Node, topic: str) -> str:
    """Return the names of the nodes that publish on a topic, in words; "" without any."""
    return _names(node.get_publishers_info_by_topic(node.resolve_topic_name(topic)))


def _names(ends: Iterable[TopicEndpointInfo]) -> str:
    return ", ".join(sorted({f"{end.node_namespace.rstrip('/')}/{end.node_name}" for end in ends}))


class Input:
    """Subscription of single messages, not of a stream.

    callback(message) is called by an executor, or by `take_all` if the subscription is not served.
    Unreadable messages are refused.

    Attributes
    ----------
    refusals : Refusals
    options : of Node.create_subscription
    """

    @overload
    def __init__(
        self,
        node: ParameterNode,
        kind: type[Message],
        topic: str,
        callback: Callable[[Message], None],
        qos: int | QoSProfile,
        read: None = None,
        served: bool = True,
        **options: Any,
    ) -> None: ...

    @overload
    def __init__(
        self,
        node: ParameterNode,
        kind: type,
        topic: str,
        callback: Callable[[Content], None],
        qos: int | QoSProfile,
        read: Callable[[bytes], Content],
        served: bool = True,
        **options: Any,
    ) -> None: ...

    def __init__(
        self,
        node: ParameterNode,
        kind: type,
        topic: str,
        callback: Callable[[Any], None],
        qos: int | QoSProfile,
        read: Callable[[bytes], Any] | None = None,
        served: bool = True,
        **options: Any,
    ) -> None:
        """Subscribe to the topic.

        read : callable of bytes -> argument of the callback, default: the message; raises Unreadable
        """
        self.refusals = Refusals(node, topic, kind)
        self._read, self._callback = read or (lambda data: decode(data, kind)), callback
        self.subscription = node.create_subscription(
            kind, topic, self._take if served else unserved, qos, raw=True, **options
        )

    def take_all(self) -> None:
        """Read all waiting messages."""
        for data, _ in waiting(self.subscription):
            self._take(data)

    def _take(self, data: bytes) -> None:
        try:
            message = self._read(data)
        except Unreadable as error:
            self.refusals.add(error)
        else:
            self._callback(message)


class StreamInput:
    """Subscription of a stream; messages wait in the middleware until `fetch`.

    QoS by parameter: qos_overrides.<topic>.subscription.reliability and .depth.

    Attributes
    ----------
    lost : messages that are missing in the sequence numbers of the only publisher
    refusals : Refusals
    """

    def __init__(self, node: ParameterNode, kind: type, topic: str) -> None:
        self.lost, self._before = 0, 0
        self._number: int | None = None  # of the last message, by its publisher
        self.refusals = Refusals(node, topic, kind)
        self._node, self._topic = node, topic
        self._subscription = node.create_subscription(
            kind,
            topic,
            unserved,
            copy(STREAM_QOS),
            qos_overriding_options=OVERRIDES,
            raw=True,
        )

    def fetch(self, codec: CdrCodec) -> list[Part]:
        """Return the arrived messages as [(frame, rows (n,), arrivals (n,) s since 1970)].

        Each entry holds successive messages of one frame; codec : CdrCodec
        """
        messages, stamps = self.fetch_serialized()
        if not messages:
            return []
        arrivals = 1e-9 * np.array(stamps)
        return [
            (frame, rows, arrivals[some])
            for frame, rows, some in codec.read(messages, self.refusals.add)
        ]

    def fetch_serialized(self) -> tuple[list[bytes], list[int]]:
        """Return the arrived messages, and their arrivals, ns since 1970."""
        messages, stamps = [], []
        for data, information in waiting(self._subscription):
            messages.append(data)
            stamps.append(information["received_timestamp"] or time.time_ns())
            self._count_lost(information["publication_sequence_number"])
        return messages, stamps

    def _count_lost(self, number: int | None) -> None:
        """Count the messages missing before `number`; None from a middleware without numbers.

        The event of a lost message is not used: rmw_fastrtps can lock itself when it is taken (its pull
        request 890).
        """
        before, self._number = self._number, number
        missing = 0 if before is None or number is None else number - before - 1
        if missing > 0 and self.get_publisher_count() == 1:
            self.lost += missing

    def get_publisher_count(self) -> int:
        """Return the number of publishers of the topic."""
        return self._subscription.get_publisher_count()

    def trouble(self, received: int) -> str | None:
        """Return a sentence on the fault of the stream in ROS, or None.

        received : messages since the last call
        """
        lost, self._before = self.lost - self._before, self.lost
        refused = self.refusals.trouble()
        if refused:
            return refused
        if self.get_publisher_count() > 1:
            return several_publishers(self._node, self._topic)
        if lost > LARGEST_LOSS * (received + lost):
            return (
                f"{lost} of {received + lost} messages on {self._topic} were lost on their "
                "way to this node: check the load "
                "of machine and network, or set "
                f"qos_overrides.{self._subscription.topic_name}.subscription.reliability"
            )
        return None


class InMemoryReceiver:
    """Replaces the subscription of a stream that another node of this process hands over."""

    lost = 0

    def __init__(self, node: ParameterNode, kind: type, topic: str) -> None:
        self.refusals = Refusals(node, topic, kind)  # stays empty
        self._node, self._topic = node, topic
        self._parts: list[Part] = []

    def hand(self, frame: str, rows: np.ndarray) -> None:
        """Append rows (n,) with the fields of a CdrCodec, all of one frame."""
        self._parts.append((frame, rows, np.full(len(rows), 1e-9 * time.time_ns())))

    def __len__(self) -> int:
        """Return the number of waiting parts."""
        return len(self._parts)

    def fetch(self, codec: CdrCodec) -> list[Part]:
        """Return [(frame, rows, arrivals, s since 1970)] since the last call."""
        parts, self._parts = self._parts, []
        return parts

    def get_publisher_count(self) -> int:
        """Return the number of publishers of the topic."""
        return self._node.count_publishers(self._topic)

    def trouble(self, received: int) -> str | None:
        """Return a sentence on the fault of the stream in ROS, or None."""
        return several_publishers(self._node, self._topic)


class Streams:
    """The streams of a node; messages wait until they are taken."""

    def __init__(self, node: ParameterNode, epoch: Epoch, on_taken: Callable[[], None]) -> None:
        """Start without streams; on_taken() is called after messages were delivered."""
        self._node, self._epoch, self._on_taken = node, epoch, on_taken
        self._streams: dict[str, _Stream] = {}  # by topic, in the order of taking
        self._awaited: _Stream | None = None
        self._due: Callable[[], float] = lambda: -np.inf  # of the message, s since 1970
        self._until = -np.inf

    @property
    def inputs(self) -> dict[str, StreamInput | InMemoryReceiver]:
        """Input of each topic, in the order of taking."""
        return {topic: stream.source for topic, stream in self._streams.items()}

    @property
    def refusals(self) -> list[Refusals]:
        """Refusals of each stream."""
        return [end.refusals for end in self.inputs.values()]

    def wait_for(self, topic: str, due: Callable[[], float]) -> None:
        """Let all streams wait for a message of one topic that is stamped due() or later.

        Before it, nothing could be computed with the other messages. The wait ends after LONGEST_WAIT.

        due : callable -> s since 1970
        """
        self._awaited, self._due = self._streams[topic], due

    def add(self, codec: CdrCodec, topic: str, take: Take, handed: bool = False) -> None:
        """Subscribe to a stream.

        Parameters
        ----------
        codec : CdrCodec of its messages
        topic : its name
        take : callable of (frame, t, rows, arrival) for successive messages of one frame: stamps (n,) s,
            rows (n,) of the codec, arrivals (n,) s since 1970
        handed : whether a node of this process hands the messages over in memory
        """
        kind = InMemoryReceiver if handed else StreamInput
        self._streams[topic] = _Stream(codec, take, kind(self._node, codec.kind, topic))

    def take(self, at_once: bool = False) -> bool:
        """Deliver all arrived messages, and return whether any arrived or still wait.

        at_once : do not wait as `wait_for` says
        """
        if self._awaited is not None and not at_once:
            arrived, now = self._awaited.fetch(), time.monotonic()
            if now < self._until and not (
                arrived and self._awaited.newest_waiting > self._due() - ROUNDING
            ):
                return bool(self._awaited.waiting)
            self._until = now + LONGEST_WAIT
        streams = self._streams.values()
        for stream in streams:
            stream.fetch()
        parts = [part for stream in streams if stream.waiting for part in stream.parts(self._epoch)]
        if not parts:
            return False
        if any(stream.fell for stream in streams):  # then the order of arrival matters
            parts = sorted(
                (piece for part in parts for piece in _pieces(part)), key=lambda piece: piece[-1][0]
            )
        for take, *part in parts:
            take(*part)
        self._on_taken()
        return True


class _Stream:
    """Arrived messages of one stream.

    source : its input; waiting : parts; fell : whether stamps of the last taken messages fell back
    """

    def __init__(self, codec: CdrCodec, take: Take, source: StreamInput | InMemoryReceiver) -> None:
        self.waiting: list[Part] = []
        self.fell = False
        self.source = source
        self._codec, self._take, self._newest = codec, take, -np.inf

    def fetch(self) -> bool:
        """Fetch messages, and return whether any arrived since the last call."""
        parts = self.source.fetch(self._codec)
        self.waiting += parts
        return bool(parts)

    @property
    def newest_waiting(self) -> float:
        """Stamp of the last fetched message, s since 1970; -inf if none waits."""
        if not self.waiting:
            return -np.inf
        rows = self.waiting[-1][1]
        return rows["sec"][-1] + 1e-9 * rows["nanosec"][-1]

    def parts(self, epoch: Epoch) -> list[tuple[Any, ...]]:
        """Return the fetched messages as [(take, frame, stamps, rows, arrivals)]."""
        self.fell, parts = False, []
        for frame, rows, arrivals in self.waiting:
            t = epoch.seconds_of(rows["sec"], rows["nanosec"])
            parts.append((self._take, frame, t, rows, arrivals))
            newest = self._newest
            for stamp in t.tolist():
                self.fell = self.fell or stamp < newest - LARGEST_STEP_BACK
                newest = max(newest, stamp)
            self._newest = stamp
        self.waiting = []
        return parts


def _pieces(part: tuple[Any, ...]) -> list[tuple[Any, ...]]:
    """Return the messages of a part one by one."""
    take, frame, *columns = part
    return [
        (take, frame, *(column[k : k + 1] for column in columns)) for k in range(len(columns[0]))
    ]


class StreamOutput:
    """Publisher of a stream of messages made by templates."""

    def __init__(self, node: Node, kind: type, topic: str) -> None:
        self.publisher = publish_stream(node, kind, topic)
        self._receiver: InMemoryReceiver | None = None

    def deliver_to(self, receiver: InMemoryReceiver) -> None:
        """Set an InMemoryReceiver that also gets all rows."""
        self._receiver = receiver

    def publish(self, frame: str, template: CdrTemplate, rows: np.ndarray) -> None:
        """Publish rows (n,) of a CdrTemplate, all of one frame."""
        if self._receiver is not None:
            self._receiver.hand(frame, rows)
        if self.publisher.get_subscription_count():  # late subscribers cannot request them
            for message in template.messages(rows):
                self.publisher.publish(message)


def several_publishers(node: ParameterNode, topic: str) -> str | None:
    """Return the sentence on a topic with several publishers, or None."""
    ends = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    if len(ends) < 2:
        return None
    return (
        f"{len(ends)} publish on {topic} ({_names(ends)}): stop all but one, or give each tag a "
        "namespace"
    )
