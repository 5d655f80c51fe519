# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A node whose streams and /clock no executor serves."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import wraps
from typing import Any, Protocol, TypeVar

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rosgraph_msgs.msg import Clock

from .cdr import Message, decode
from .parameters import ParameterNode
from .topics import unserved, waiting

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
        options["event_callbacks"] = self._with_few_warnings(
            topic, options.get("event_callbacks") or SubscriptionEventCallbacks()
        )
        return super().create_subscription(msg_type, topic, callback, qos_profile, **options)

    def create_publisher(
        self, msg_type: type, topic: str, qos_profile: QoSProfile | int, **options: Any
    ) -> Publisher:
        """Make a publisher as rclpy does."""
        options["event_callbacks"] = self._with_few_warnings(
            topic, options.get("event_callbacks") or PublisherEventCallbacks()
        )
        return super().create_publisher(msg_type, topic, qos_profile, **options)

    def _with_few_warnings(self, topic: str, events: Events) -> Events:
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
