# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A node whose streams and /clock wait until it takes all arrived messages together."""

from __future__ import annotations

from functools import wraps
import time
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rosgraph_msgs.msg import Clock

from ..common.stamps import LARGEST_STEP_BACK
from .cdr import decode
from .parameters import ParameterNode
from .topics import Refusals, StreamInput, publish_stream, several_publishers, unserved, waiting

if TYPE_CHECKING:
    from collections.abc import Callable, Collection

    from .cdr import CdrCodec, CdrTemplate, Message
    from .topics import Epoch

    # frame, stamps, rows and arrivals
    Take = Callable[[str, np.ndarray, np.ndarray, np.ndarray], None]
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from rclpy.publisher import Publisher
    from rclpy.qos import QoSProfile
    from rclpy.subscription import Subscription
    from rclpy.timer import Timer


PERIOD = 0.001  # s, smallest rest after a turn
LONGEST_WAIT = 0.02  # s; longest time that `wait_for` delays the streams
ROUNDING = 1e-6  # s; two computations of a stamp since 1970 differ by less
# s. After a turn the process rests as long as the turn took, at most so long: then a busy process
# takes more messages per turn.
LONGEST_REST = 0.01
Part = tuple[str, np.ndarray, np.ndarray]  # frame, rows and arrivals of successive messages


class Taking(Protocol):
    """Takes arrived messages; `take` returns whether any arrived or still wait."""

    def take(self) -> bool: ...


class StreamPoller:
    """Lets nodes take their arrived messages, one node after the other.

    ros.run calls the `turns` of a node, which is a StreamPoller.
    """

    PERIOD = PERIOD

    def __init__(self, streams: Collection[Taking]) -> None:
        """Set the streams: Streams, or other objects with take()."""
        self._streams = streams

    def take(self) -> float | None:
        """Run one turn, and return the rest after it, s; None if nothing arrived."""
        began = time.monotonic()
        if not any([streams.take() for streams in self._streams]):
            return None
        return min(max(time.monotonic() - began, PERIOD), LONGEST_REST)


class Streams:
    """The streams of a StreamNode; messages wait until they are taken."""

    def __init__(self, node: StreamNode, epoch: Epoch, on_taken: Callable[[], None]) -> None:
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


class StreamOutput:
    """Publisher of a stream of messages made by templates."""

    def __init__(self, node: StreamNode, kind: type, topic: str) -> None:
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


class InMemoryReceiver:
    """Replaces the subscription of a stream that another node of this process hands over."""

    lost = 0

    def __init__(self, node: StreamNode, kind: type, topic: str) -> None:
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


Events = TypeVar("Events", SubscriptionEventCallbacks, PublisherEventCallbacks)


class Serving(Protocol):
    """Serves nodes, see Spinner.

    longest_wait : s, longest wait of any request since this was set to 0.0
    """

    longest_wait: float

    def replace(self, gone: Iterable[StreamNode], new: Iterable[StreamNode]) -> None:
        """Stop serving some nodes, and serve others."""


class StreamNode(ParameterNode):
    """A node whose streams and /clock no executor serves (see Spinner).

    Attributes
    ----------
    members : nodes that start and end with it
    spinner : the Spinner that serves it, once there is one
    ready : the log line at the start of service
    on_failure : callable of an exception; called with exceptions of callbacks, instead of raising them
    """

    members: Sequence[StreamNode] = ()
    spinner: Serving | None = None
    ready: str = ""
    on_failure: Callable[[Exception], None] | None = None

    def create_subscription(
        self,
        msg_type: type[Message],
        topic: str,
        callback: Callable[[Message], None],
        qos_profile: QoSProfile | int,
        **options: Any,
    ) -> Subscription:
        """Subscribe as rclpy does."""
        callback = callback if callback is unserved else self._contained(callback)
        options["event_callbacks"] = self._quiet(
            topic, options.get("event_callbacks") or SubscriptionEventCallbacks()
        )
        return super().create_subscription(msg_type, topic, callback, qos_profile, **options)

    def create_publisher(
        self, msg_type: type, topic: str, qos_profile: QoSProfile | int, **options: Any
    ) -> Publisher:
        """Make a publisher as rclpy does."""
        options["event_callbacks"] = self._quiet(
            topic, options.get("event_callbacks") or PublisherEventCallbacks()
        )
        return super().create_publisher(msg_type, topic, qos_profile, **options)

    def _quiet(self, topic: str, events: Events) -> Events:
        """Return event callbacks that limit the warnings on peers with another QoS or type.

        rclpy would write one line per peer.
        """
        for event in ("incompatible_qos", "incompatible_type"):
            if getattr(events, event) is None:
                text = (
                    f"{topic}: a peer has an {event.replace('_', ' ')}, so its messages, or ours, "
                    "do not arrive; correct the peer"
                )
                setattr(events, event, self._warning(f"{topic} {event}", text))
        return events

    def _warning(self, kind: str, text: str) -> Callable[[Any], None]:
        return lambda _: self.warn_at_times(kind, text)

    def create_timer(  # type: ignore[override]  # options are passed by name
        self, timer_period_sec: float, callback: Callable[[], None], **options: Any
    ) -> Timer:
        """Make a timer as rclpy does."""
        return super().create_timer(timer_period_sec, self._contained(callback), **options)

    def say_ready(self) -> None:
        """Log that the node is served, and that signals now end it in good order."""
        if self.ready:
            self.get_logger().info(self.ready)

    def _contained(self, callback: Callable[..., None]) -> Callable[..., None]:
        @wraps(callback)
        def call(*arguments: Any) -> None:
            try:
                callback(*arguments)
            except Exception as error:
                if self.on_failure is None:
                    raise
                self.on_failure(error)

        return call

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """Subscriptions that an executor serves."""
        yield from (
            one
            for one in super().subscriptions
            if one.msg_type is not Clock and one.callback is not unserved
        )

    def take_clock(self) -> None:
        """Set the clock of the node to the newest time on /clock."""
        for clock in [one for one in super().subscriptions if one.msg_type is Clock]:
            newest = None
            for newest, _ in waiting(clock):
                pass
            if newest is None:
                continue
            try:
                clock.callback(decode(newest, Clock))
            except (ValueError, OverflowError) as error:  # an invalid time, or before 1970
                self.warn_at_times("/clock", f"/clock: passed over: {error}")
