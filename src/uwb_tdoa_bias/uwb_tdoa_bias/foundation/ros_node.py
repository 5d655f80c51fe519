"""A node whose streams and /clock wait until it takes them."""

from __future__ import annotations

from functools import wraps
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rosgraph_msgs.msg import Clock

from .ros_cdr import decode
from .ros_parameters import ParameterNode
from .ros_topics import unserved, waiting

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence

    from rclpy.publisher import Publisher
    from rclpy.qos import QoSProfile
    from rclpy.subscription import Subscription
    from rclpy.timer import Timer

Events = TypeVar("Events", SubscriptionEventCallbacks, PublisherEventCallbacks)


class Serving(Protocol):
    """Serves nodes, see Spinner. longest_wait : s, the longest that anything has waited since this
    was set to 0.0.
    """

    longest_wait: float

    def replace(self, gone: Iterable[StreamNode], new: Iterable[StreamNode]) -> None:
        """Leave some nodes, and serve others."""


class StreamNode(ParameterNode):
    """A node whose streams and /clock are not served by an executor (see Spinner). members : nodes
    that live and end with it;
    spinner : the Spinner that serves it, once there is one; ready : what it says on the log when it
        begins to be served;
    on_failure(error) : is called with what a callback raises, instead of raising it.
    """

    members: Sequence[StreamNode] = ()
    spinner: Serving | None = None
    ready: str = ""
    on_failure: Callable[[Exception], None] | None = None

    def create_subscription(
        self,
        msg_type: type,
        topic: str,
        callback: Callable[..., None],
        qos_profile: QoSProfile | int,
        **options: Any,
    ) -> Subscription:
        """Of rclpy."""
        callback = callback if callback is unserved else self._contained(callback)
        options["event_callbacks"] = self._quiet(
            topic, options.get("event_callbacks") or SubscriptionEventCallbacks()
        )
        return super().create_subscription(msg_type, topic, callback, qos_profile, **options)

    def create_publisher(
        self, msg_type: type, topic: str, qos_profile: QoSProfile | int, **options: Any
    ) -> Publisher:
        """Of rclpy."""
        options["event_callbacks"] = self._quiet(
            topic, options.get("event_callbacks") or PublisherEventCallbacks()
        )
        return super().create_publisher(msg_type, topic, qos_profile, **options)

    def _quiet(self, topic: str, events: Events) -> Events:
        """The event callbacks of a topic, which warn of peers with another QoS or type at times:
        rclpy writes a line for each peer.
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

    def create_timer(  # type: ignore[override]  # its further arguments are handed on by their names
        self, timer_period_sec: float, callback: Callable[[], None], **options: Any
    ) -> Timer:
        """Of rclpy."""
        return super().create_timer(timer_period_sec, self._contained(callback), **options)

    def say_ready(self) -> None:
        """Say on the log that it is served from now on, and ends in good order."""
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
        """Those that an executor serves."""
        yield from (
            one
            for one in super().subscriptions
            if one.msg_type is not Clock and one.callback is not unserved
        )

    def take_clock(self) -> None:
        """Set the clock of the node to the newest of /clock."""
        for clock in [one for one in super().subscriptions if one.msg_type is Clock]:
            newest = None
            for newest, _ in waiting(clock):
                pass
            if newest is None:
                continue
            try:
                clock.callback(decode(newest, Clock))
            except (ValueError, OverflowError) as error:  # no time at all, or before 1970
                self.warn_at_times("/clock", f"/clock: passed over: {error}")
