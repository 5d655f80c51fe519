"""What everything that talks ROS shares: QoS, stamps, diagnostics, and the life of a node."""

import argparse
from copy import copy
import gc
import signal
import sys
import time

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as implementation
from rclpy.node import Node
from rclpy.qos import QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from .errors import InputError
from .executable import interrupt

try:  # not in rclpy before 7.1.4; takes a third of the CPU time
    from rclpy.experimental import EventsExecutor

    SERVED = 0.02  # s, from one time that an executor does everything that is to do to the next, beside turns
except ImportError:
    EventsExecutor, SERVED = SingleThreadedExecutor, 0.0  # does one thing at a time

# What comes in is sensor data: best effort, which hears every publisher. Deep, because a node that was not scheduled for a
# moment must find all of it: 10 s of a 1 kHz IMU, or 2.5 s of it replayed four times as fast. Takes memory only where it
# is used. What goes out is reliable, which every subscriber hears: RViz and most others ask for it.
STREAM_QOS = QoSProfile(depth=10_000, reliability=ReliabilityPolicy.BEST_EFFORT)
OUTPUT_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
LARGEST_LOSS = 0.01  # share of the messages of a second
LONGEST_WAIT = 0.2  # s, until a node that receives nothing sees a signal
DIAGNOSTICS_QOS = QoSProfile(depth=10)
OVERRIDES = QoSOverridingOptions([QoSPolicyKind.RELIABILITY, QoSPolicyKind.DEPTH])  # written into the given profile


def publish_stream(node, kind, topic):
    """Publisher of a stream; QoS by parameter: qos_overrides.<topic>.publisher.reliability and .depth."""
    return node.create_publisher(kind, topic, copy(OUTPUT_QOS), qos_overriding_options=OVERRIDES)


class StreamNode(Node):
    """A node that may have subscriptions which no executor serves. members : nodes that live and end with it."""

    members = ()

    def __init__(self, *arguments, **options):
        self._unserved = []
        super().__init__(*arguments, **options)

    @property
    def subscriptions(self):
        """Those that an executor serves."""
        yield from (one for one in super().subscriptions if one not in self._unserved)

    def leave_to_itself(self, subscription):
        """Have no executor serve a subscription."""
        self._unserved.append(subscription)


class StreamInput:
    """Subscription of a stream. QoS by parameter: qos_overrides.<topic>.subscription.reliability and .depth.

    lost : messages that were sent and that DDS did not deliver, as far as it knows.
    """

    def __init__(self, node, kind, topic, callback=None):
        """callback(message); None: the node, a StreamNode, fetches them as bytes."""
        self.lost, self._before = 0, 0
        self._node, self._topic = node, topic
        events = SubscriptionEventCallbacks(message_lost=self._on_lost)
        self._subscription = node.create_subscription(
            kind, topic, callback or _unused, copy(STREAM_QOS), event_callbacks=events, qos_overriding_options=OVERRIDES,
            raw=callback is None,
        )  # fmt: skip
        if callback is None:
            node.leave_to_itself(self._subscription)

    def fetch(self, wire):
        """What has arrived, by a Wire: [(frame, rows (n,), arrivals (n,) s since 1970)], each of successive messages of one
        frame."""
        kind, handle, messages, arrivals = self._subscription.msg_type, self._subscription.handle, [], []
        with handle:
            while (taken := handle.take_message(kind, True)) is not None:
                messages.append(taken[0])
                arrivals.append(taken[1]["received_timestamp"] or time.time_ns())
        if not messages:
            return []
        arrivals, first, out = 1e-9 * np.array(arrivals), 0, []
        for frame, rows in wire.read(messages):
            out.append((frame, rows, arrivals[first : first + len(rows)]))
            first += len(rows)
        return out

    def _on_lost(self, status):
        self.lost += status.total_count_change

    def get_publisher_count(self):
        """How many publish it."""
        return self._subscription.get_publisher_count()

    def trouble(self, received):
        """What is wrong with the stream as ROS sees it, or None. received : messages since this was asked last."""
        lost, self._before = self.lost - self._before, self.lost
        if self.get_publisher_count() > 1:
            return several_publishers(self._node, self._topic)
        if lost > LARGEST_LOSS * (received + lost):
            return (
                f"{lost} of {received + lost} messages on {self._topic} were lost on their way to this node: check the load "
                f"of machine and network, or set qos_overrides.{self._subscription.topic_name}.subscription.reliability"
            )
        return None


def _unused(_):
    """Callback of a subscription that no executor serves."""


def several_publishers(node, topic):
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

    def __init__(self):
        self._second = None

    def seconds(self, stamp):
        """Float s of a builtin_interfaces/Time."""
        if self._second is None:
            self._second = stamp.sec
        return (stamp.sec - self._second) + 1e-9 * stamp.nanosec

    def seconds_of(self, sec, nanosec):
        """Float s, (n,), of the two parts of stamps, (n,) each."""
        if self._second is None:
            self._second = int(sec[0])
        return (sec.astype(np.int64) - self._second) + 1e-9 * nanosec

    def parts(self, t):
        """What `seconds_of` was given, to the nanosecond, of t (n,) s."""
        second, nanosecond = np.divmod(np.round(t * 1e9).astype(np.int64), 10**9)
        return self._second + second, nanosecond

    @property
    def begin(self):
        """Stamp, s, of what `seconds` gives as 0."""
        return self._second or 0

    def stamp(self, t):
        """builtin_interfaces/Time of float s: what `seconds` was given, to the nanosecond."""
        second, nanosecond = divmod(round(t * 1e9), 10**9)
        return Time(sec=self._second + second, nanosec=nanosecond)


def orientation_of(q):
    """Tuple x y z w of a geometry_msgs/Quaternion; NaN for (0, 0, 0, 0), which says: not known."""
    values = (q.x, q.y, q.z, q.w)
    return values if any(values) else (np.nan,) * 4


class Diagnostics:
    """Publishes one status on /diagnostics each second of the wall clock, and logs it whenever its text changes.

    report() -> (level, text, {key: value}), with level one of DiagnosticStatus.OK, WARN, ERROR.
    """

    def __init__(self, node, report):
        self._node, self._report, self._said = node, report, None
        self._clock = SimulatedClock(node)
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", DIAGNOSTICS_QOS)
        node.create_timer(1.0, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def publish(self):
        """Publish now."""
        level, text, values = self._report()
        level, text = self._clock.judge() or (level, text)
        if text != self._said:
            logger = self._node.get_logger()
            if level == DiagnosticStatus.OK:
                logger.info(text)
            else:  # a statement of its own: rclpy allows one severity per line
                logger.warning(text)
            self._said = text
        name = self._node.get_fully_qualified_name()
        values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        status = DiagnosticStatus(level=level, name=name, message=text, hardware_id=name, values=values)
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)


class SimulatedClock:
    """Whether simulated time goes on; of the clock of a node, asked once a second."""

    def __init__(self, node):
        self._node, self._before = node, None

    def judge(self):
        """(level, text) while nothing else can be said, because time stands still; None otherwise."""
        clock = self._node.get_clock()
        if not clock.ros_time_is_active:
            return None
        before, self._before = self._before, clock.now().nanoseconds
        if self._before == 0:
            remedy = "play the bag with --clock, or set use_sim_time to false"
            return DiagnosticStatus.WARN, f"use_sim_time is set, and nobody publishes /clock: {remedy}"
        return (DiagnosticStatus.OK, "paused: /clock stands still") if self._before == before else None


class Rate:
    """How often something happened per second of the wall clock, since it was last asked."""

    def __init__(self):
        self._count, self._since = 0, time.monotonic()

    def of(self, count):
        """Hz, from a running total."""
        now = time.monotonic()
        rate = (count - self._count) / max(now - self._since, 1e-3)
        self._count, self._since = count, now
        return rate


def run(node_class, description, argv=None):
    """Live as a node until SIGINT or SIGTERM. Returns the exit code: 0, 2 for bad usage or an InputError, or 128 and the
    number of a signal that came before the node was ready.

    node_class(arguments) makes the node, in an initialised rclpy, of the arguments of the process; it has the executable's
    NAME, and may have `members` and `turns`, ros_streams.Turns. description : for --help.
    """
    name = node_class.NAME
    arguments = [name, *(sys.argv[1:] if argv is None else argv)]
    parser = argparse.ArgumentParser(
        prog=name, description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    interruptible, stop = True, Future()

    def on_signal(number, frame):  # rclpy's own handler would end the context while a callback still publishes
        if not stop.done():
            stop.set_result(number)
        if interruptible:
            interrupt(number, frame)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    nodes, executor = [], None
    try:
        _init(parser, arguments)
        node = node_class(arguments)
        executor, nodes = EventsExecutor(), [node, *getattr(node, "members", ())]
        for each in nodes:
            executor.add_node(each)
        gc.collect()
        gc.freeze()  # what numba holds is never garbage, and searching it takes a tenth of a second
        gc.enable()
        interruptible = False
        if stop.done():
            raise KeyboardInterrupt
        _spin(executor, getattr(node, "turns", None), stop)
    except SystemExit as ended:  # argparse has said it already
        return ended.code or 0
    except InputError as error:
        print(f"{name}: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 128 + stop.result()
    except ExternalShutdownException:
        pass
    finally:
        interruptible = False
        if executor is not None:
            for each in nodes:
                executor.remove_node(each)
            executor.shutdown()
        for each in nodes:
            each.destroy_node()
        rclpy.try_shutdown()
    return 0


def _spin(executor, turns, stop):
    """Live until the future `stop` is done. Turns are taken beside the executor: a timer of it costs four times as much."""
    served = -np.inf
    while not stop.done() and rclpy.ok():
        if turns is None:  # a signal is seen after a callback, or after the time
            executor.spin_until_future_complete(stop, timeout_sec=LONGEST_WAIT)
            continue
        if time.monotonic() >= served + SERVED:
            executor.spin_once(timeout_sec=0.0)
            served = time.monotonic()
        time.sleep(turns.take())


def _init(parser, arguments):
    try:
        parser.parse_args(remove_ros_args(arguments)[1:])
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except (implementation.RCLError, implementation.RCLInvalidROSArgsError, implementation.UnknownROSArgsError) as error:
        raise InputError(f"--ros-args: {error}.") from error
