"""What everything that talks ROS shares: QoS, stamps, diagnostics, and the life of a node."""

from __future__ import annotations

import argparse
from copy import copy
from functools import wraps
import gc
import math
import re
import signal
import sys
import time
from typing import Any, TYPE_CHECKING

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock as SteadyClock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation as implementation
from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args
from rosgraph_msgs.msg import Clock

from .errors import InputError
from .executable import interrupt
from .ros_parameters import ParameterNode
from .ros_spinning import Spinner
from .ros_cdr import Unreadable, decode, name_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence
    from types import FrameType
    from geometry_msgs.msg import Quaternion
    from rclpy.clock import ROSClock
    from rclpy.event_handler import QoSMessageLostInfo
    from rclpy.node import Node
    from rclpy.publisher import Publisher
    from rclpy.subscription import Subscription
    from rclpy.timer import Timer
    from rclpy.topic_endpoint_info import TopicEndpointInfo
    from .ros_cdr import CdrCodec

# What comes in is sensor data: best effort, which hears every publisher. Deep, because a node that was not scheduled for a
# moment must find all of it: 10 s of a 1 kHz IMU, or 2.5 s of it replayed four times as fast. Takes memory only where it
# is used. What goes out is reliable, which every subscriber hears: RViz and most others ask for it.
STREAM_QOS = QoSProfile(depth=10_000, reliability=ReliabilityPolicy.BEST_EFFORT)
OUTPUT_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
LARGEST_LOSS = 0.01  # share of the messages of a second
BEHIND = 0.5  # s that something may wait until this process serves it
AGAIN = 30.0  # s after which the log says what it has said before
# Of what is measured: with a sign, a decimal point or a unit. The id of an anchor has none of these.
NUMBER = re.compile(r"[-+]\d+(\.\d+)?|\d+\.\d+|\d+(?=\s*(%|s\b|ms\b|m\b|Hz|messages|samples|TDOAs|times))")
REPORT_PERIOD, LOOKS = 1.0, 5  # s from one report to the next, and looks in between at what is to be told at once
PAUSED, SLOWEST_CLOCK = 0.5, 2.0  # s without a new time on /clock; s from one time to the next of a clock that runs
DIAGNOSTICS_QOS = QoSProfile(depth=10)
OVERRIDES = QoSOverridingOptions([QoSPolicyKind.RELIABILITY, QoSPolicyKind.DEPTH])  # written into the given profile

Report = tuple[bytes, str, dict[str, Any]]  # level of a DiagnosticStatus, text, values


def publish_stream(node: Node, kind: type, topic: str) -> Publisher:
    """Publisher of a stream; QoS by parameter: qos_overrides.<topic>.publisher.reliability and .depth."""
    return node.create_publisher(kind, topic, copy(OUTPUT_QOS), qos_overriding_options=OVERRIDES)


class StreamNode(ParameterNode):
    """A node whose streams and /clock are not served by an executor (see Spinner). members : nodes that live and end with it;
    spinner : the Spinner that serves it, once there is one; ready : what it says on the log when it begins to be served;
    on_failure(error) : is called with what a callback raises, instead of raising it."""

    members: Sequence[StreamNode] = ()
    spinner: Spinner | None = None
    ready: str = ""
    on_failure: Callable[[Exception], None] | None = None

    def create_subscription(
        self, msg_type: type, topic: str, callback: Callable[..., None], qos_profile: QoSProfile | int, **options: Any
    ) -> Subscription:
        """Of rclpy."""
        callback = callback if callback is unserved else self._contained(callback)
        return super().create_subscription(msg_type, topic, callback, qos_profile, **options)

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
        yield from (one for one in super().subscriptions if one.msg_type is not Clock and one.callback is not unserved)

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


def unserved(_: Any) -> None:
    """Callback of a subscription that no executor serves."""


def waiting(subscription: Subscription) -> Iterator[tuple[bytes, dict[str, Any]]]:
    """Generator of what waits at a subscription that no executor serves: (bytes, information) of each message, which is taken."""
    kind, take = subscription.msg_type, subscription.handle.take_message
    while (taken := take(kind, True)) is not None:
        yield taken


class Refusals:
    """Messages of a topic that could not be read. count : of them; reason : of the last; topic : its name."""

    def __init__(self, node: StreamNode, topic: str, kind: type) -> None:
        self.count, self.reason = 0, ""
        self.topic, self._node, self._kind, self._before = topic, node, kind, 0

    def add(self, error: Unreadable) -> None:
        """Count one."""
        self.count, self.reason = self.count + 1, str(error)
        self._node.warn_at_times(f"unreadable {self.topic}", f"{self.topic}: a message cannot be read and is not used: {error}")

    def trouble(self) -> str | None:
        """The sentence for those since this was asked last, or None."""
        new, self._before = self.count - self._before, self.count
        if not new:
            return None
        others = self._others()
        remedy = f"{others} publishes another version of {name_of(self._kind)}: build it anew" if others else "check who publishes it"
        return f"{new} messages on {self.topic} cannot be read ({self.reason}): {remedy}"

    def _others(self) -> str:
        """Who publishes another definition of the type than ours, as text."""
        name = self._node.resolve_topic_name(self.topic)
        own = {_hash(end) for end in self._node.get_subscriptions_info_by_topic(name) if end.node_name == self._node.get_name()}
        ends = [end for end in self._node.get_publishers_info_by_topic(name) if _hash(end) not in own]
        return ", ".join(sorted({f"{end.node_namespace.rstrip('/')}/{end.node_name}" for end in ends}))


def _hash(end: TopicEndpointInfo) -> str:
    return str(end.topic_type_hash)


class Input:
    """Subscription of messages that come one at a time, not in streams: callback(message), by an executor, or in `take_all` if it is
    not served. What cannot be read is refused.

    refusals : Refusals; options : of Node.create_subscription.
    """

    def __init__(
        self, node: StreamNode, kind: type, topic: str, callback: Callable[[Any], None], qos: int | QoSProfile,
        read: Callable[[bytes], Any] | None = None, served: bool = True, **options: Any,
    ) -> None:  # fmt: skip
        """read(bytes) : what is given to the callback; default the message; raises Unreadable."""
        self.refusals = Refusals(node, topic, kind)
        self._read, self._callback = read or (lambda data: decode(data, kind)), callback
        self.subscription = node.create_subscription(kind, topic, self._take if served else unserved, qos, raw=True, **options)

    def take_all(self) -> None:
        """Take what waits."""
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
    """Subscription of a stream, of which what arrives waits in the middleware until it is fetched. QoS by parameter:
    qos_overrides.<topic>.subscription.reliability and .depth.

    lost : messages that were sent and that DDS did not deliver, as far as it knows; refusals : Refusals.
    """

    def __init__(self, node: StreamNode, kind: type, topic: str) -> None:
        self.lost, self._before = 0, 0
        self.refusals = Refusals(node, topic, kind)
        self._node, self._topic = node, topic
        events = SubscriptionEventCallbacks(message_lost=self._on_lost)
        self._subscription = node.create_subscription(
            kind, topic, unserved, copy(STREAM_QOS), event_callbacks=events, qos_overriding_options=OVERRIDES, raw=True
        )  # fmt: skip

    def fetch(self, wire: CdrCodec) -> list[tuple[str, np.ndarray, np.ndarray]]:
        """What has arrived, by a CdrCodec: [(frame, rows (n,), arrivals (n,) s since 1970)], each of successive messages of one
        frame."""
        messages, stamps = [], []
        for data, information in waiting(self._subscription):
            messages.append(data)
            stamps.append(information["received_timestamp"] or time.time_ns())
        if not messages:
            return []
        arrivals = 1e-9 * np.array(stamps)
        return [(frame, rows, arrivals[some]) for frame, rows, some in wire.read(messages, self.refusals.add)]

    def _on_lost(self, status: QoSMessageLostInfo) -> None:
        self.lost += status.total_count_change

    def get_publisher_count(self) -> int:
        """How many publish it."""
        return self._subscription.get_publisher_count()

    def trouble(self, received: int) -> str | None:
        """What is wrong with the stream as ROS sees it, or None. received : messages since this was asked last."""
        lost, self._before = self.lost - self._before, self.lost
        refused = self.refusals.trouble()
        if refused:
            return refused
        if self.get_publisher_count() > 1:
            return several_publishers(self._node, self._topic)
        if lost > LARGEST_LOSS * (received + lost):
            return (
                f"{lost} of {received + lost} messages on {self._topic} were lost on their way to this node: check the load "
                f"of machine and network, or set qos_overrides.{self._subscription.topic_name}.subscription.reliability"
            )
        return None


def several_publishers(node: StreamNode, topic: str) -> str | None:
    """The sentence for a topic on which more than one publishes, or None."""
    ends = node.get_publishers_info_by_topic(node.resolve_topic_name(topic))
    if len(ends) < 2:
        return None
    names = ", ".join(sorted(f"{end.node_namespace.rstrip('/')}/{end.node_name}" for end in ends))
    return f"{len(ends)} publish on {topic} ({names}): stop all but one, or give each tag a namespace"


class Epoch:
    """Stamps as float seconds, exact to the nanosecond: counted from the whole second of the first stamp.

    Seconds since 1970 in a float64 are only good to 2e-7 s. Exact for 48 days before and after the first stamp.
    """

    def __init__(self) -> None:
        self._second: int = None  # type: ignore[assignment]  # of the first stamp, once there is one

    def seconds(self, stamp: Time) -> float:
        """Float s of a builtin_interfaces/Time."""
        if self._second is None:
            self._second = stamp.sec
        return (stamp.sec - self._second) + 1e-9 * stamp.nanosec

    def seconds_of(self, sec: np.ndarray, nanosec: np.ndarray) -> np.ndarray:
        """Float s, (n,), of the two parts of stamps, (n,) each."""
        if self._second is None:
            self._second = int(sec[0])
        return (sec.astype(np.int64) - self._second) + 1e-9 * nanosec

    def parts(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What `seconds_of` was given, to the nanosecond, of t (n,) s."""
        second, nanosecond = np.divmod(np.round(t * 1e9).astype(np.int64), 10**9)
        return self._second + second, nanosecond

    @property
    def begin(self) -> int:
        """Stamp, s, of what `seconds` gives as 0."""
        return self._second or 0

    def stamp(self, t: float) -> Time:
        """builtin_interfaces/Time of float s: what `seconds` was given, to the nanosecond."""
        second, nanosecond = divmod(round(t * 1e9), 10**9)
        return Time(sec=self._second + second, nanosec=nanosecond)


def orientation_of(q: Quaternion) -> tuple[float, float, float, float]:
    """Tuple x y z w of a geometry_msgs/Quaternion; NaN for (0, 0, 0, 0), which says: not known."""
    values = (q.x, q.y, q.z, q.w)
    return values if any(values) else (np.nan, np.nan, np.nan, np.nan)


class Diagnostics:
    """Publishes one status on /diagnostics each second of the wall clock, and at once when simulated time stops or goes on; logs it
    when it says something else than before (see Saying).

    report() -> (level, text, {key: value}), with level one of DiagnosticStatus.OK, WARN, ERROR; look() : called LOOKS times a
    second.
    """

    def __init__(self, node: StreamNode, report: Callable[[], Report], look: Callable[[], None] = lambda: None) -> None:
        self._node, self._report, self._look, self._saying = node, report, look, Saying()
        self._clock, self._looks = SimulatedClock(node), 0
        self._clock_status: tuple[bytes, str] | None = None
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", DIAGNOSTICS_QOS)
        node.create_timer(REPORT_PERIOD / LOOKS, self._on_timer, clock=SteadyClock(clock_type=ClockType.STEADY_TIME))

    def _on_timer(self) -> None:
        before, self._clock_status = self._clock_status, self._clock.status()
        self._looks += 1
        if self._looks % LOOKS == 0 or before != self._clock_status:
            self.publish()
        self._look()

    @property
    def paused(self) -> bool:
        """Whether simulated time stands still."""
        return self._clock_status is not None

    def publish(self) -> None:
        """Publish now."""
        level, text, values = self._report()
        spinner = self._node.spinner
        if spinner is not None:
            late = spinner.longest_wait
            spinner.longest_wait = 0.0  # of the process: the first of its nodes that asks says it
            values |= {"longest wait of a request": f"{late:.3f} s"}
            if late > BEHIND and level == DiagnosticStatus.OK:
                level, text = DiagnosticStatus.WARN, f"this node answers up to {late:.1f} s late: check the load of this machine"
        values |= {"frozen": "yes" if self._node.frozen else "no", "refused because frozen": self._node.refused}
        refused = self._node.refused_lately()
        if refused and level == DiagnosticStatus.OK:
            level, text = DiagnosticStatus.WARN, refused
        level, text = self._clock_status or (level, text)
        if self._saying.anew(text, time.monotonic()):
            logger = self._node.get_logger()
            if level == DiagnosticStatus.OK:
                logger.info(text)
            else:  # a statement of its own: rclpy allows one severity per line
                logger.warning(text)
        name = self._node.get_fully_qualified_name()
        entries = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        status = DiagnosticStatus(level=level, name=name, message=text, hardware_id=name, values=entries)
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)


class Saying:
    """What is worth a line of the log: a sentence of another kind than the last one. Sentences that differ in measured numbers alone,
    not in the anchors that they name, are of one kind, and each kind is said once in AGAIN seconds."""

    def __init__(self) -> None:
        self._last: str | None = None
        self._when: dict[str, float] = {}

    def anew(self, text: str, now: float) -> bool:
        """Whether to say a text now, s; then it counts as said."""
        kind = NUMBER.sub("#", text)
        if kind == self._last or now - self._when.get(kind, -math.inf) < AGAIN:
            return False
        self._when = {one: when for one, when in self._when.items() if now - when < AGAIN} | {kind: now}
        self._last = kind
        return True


class SimulatedClock:
    """Whether simulated time goes on; of the clock of a node, asked a few times a second."""

    def __init__(self, node: Node, now: Callable[[], float] = time.monotonic) -> None:
        self._node, self._now = node, now
        self._time: int | None = None  # the last one, ns
        self._since, self._period = now(), 0.0  # since when, s from one to the next lately

    def status(self) -> tuple[bytes, str] | None:
        """(level, text) while nothing else can be said, because time stands still; None otherwise."""
        clock: ROSClock = self._node.get_clock()  # type: ignore[assignment]  # a node has such a clock
        now = self._now()
        if not clock.ros_time_is_active:
            self._time = None
            return None
        time_of_it = clock.now().nanoseconds
        if time_of_it == 0:
            remedy = "play the bag with --clock, or set use_sim_time to false"
            return DiagnosticStatus.WARN, f"use_sim_time is set, and nobody publishes /clock: {remedy}"
        if time_of_it != self._time:
            took = now - self._since
            if self._time is not None and took < SLOWEST_CLOCK:
                self._period = max(took, 0.5 * self._period)
            self._time, self._since = time_of_it, now
        stands = now - self._since > max(PAUSED, 2.0 * self._period)
        return (DiagnosticStatus.OK, "paused: /clock stands still") if stands else None


class Rate:
    """How often something happened per second of the wall clock, since it was last asked."""

    def __init__(self) -> None:
        self._count, self._since = 0, time.monotonic()

    def of(self, count: int) -> float:
        """Hz, from a running total."""
        now = time.monotonic()
        rate = (count - self._count) / max(now - self._since, 1e-3)
        self._count, self._since = count, now
        return rate


def run(node_class: type[StreamNode], description: str | None, argv: Sequence[str] | None = None) -> int:
    """Live as a node until SIGINT or SIGTERM. Returns the exit code: 0, 2 for bad usage or an InputError, or 128 and the
    number of a signal that came before the node was ready.

    node_class(arguments) makes the StreamNode, in an initialised rclpy, of the arguments of the process; it has the executable's
    NAME, and may have `members` and `turns`, ros_streams.RoundRobin. description : for --help.
    """
    name = node_class.NAME
    arguments = [name, *(sys.argv[1:] if argv is None else argv)]
    parser = argparse.ArgumentParser(
        prog=name, description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    interruptible = True
    stop: Future = Future()  # of the number of a signal

    # rclpy's own handler would end the context while a callback still publishes
    def on_signal(number: int, frame: FrameType | None) -> None:
        if not stop.done():
            stop.set_result(number)
        if interruptible:
            interrupt(number, frame)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    nodes: list[StreamNode] = []
    spinner: Spinner | None = None
    try:
        _init(parser, arguments)
        node = node_class(arguments)
        nodes = [node, *node.members]
        spinner = Spinner(nodes, getattr(node, "turns", None))
        gc.collect()
        gc.freeze()  # what numba holds is never garbage, and searching it takes a tenth of a second
        gc.enable()
        interruptible = False
        if stop.done():
            raise KeyboardInterrupt
        for each in reversed(nodes):  # from here on a signal ends it in good order
            each.say_ready()
        spinner.spin(stop)
    except SystemExit as ended:  # argparse has said it already
        return ended.code or 0  # type: ignore[return-value]  # argparse ends with a number
    except InputError as error:
        print(f"{name}: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 128 + stop.result()
    except ExternalShutdownException:
        pass
    finally:
        interruptible = False
        if spinner is not None:
            spinner.close()
        for each in nodes:
            each.destroy_node()
        rclpy.try_shutdown()
    return 0


def _init(parser: argparse.ArgumentParser, arguments: list[str]) -> None:
    try:
        parser.parse_args(remove_ros_args(arguments)[1:])
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except (implementation.RCLError, implementation.RCLInvalidROSArgsError, implementation.UnknownROSArgsError) as error:
        raise InputError(f"--ros-args: {error}.") from error
