"""What everything that talks ROS shares: QoS, stamps, anchors, parameters, diagnostics, and the life of a node."""

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
from geometry_msgs.msg import Point, Pose, Quaternion
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.clock import Clock, ClockType
from rclpy.exceptions import InvalidParameterTypeException, ParameterUninitializedException
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.impl.implementation_singleton import rclpy_implementation as implementation
from rclpy.qos import DurabilityPolicy, QoSPolicyKind, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args
from uwb_tdoa_msgs.msg import Anchor, AnchorArray

from .anchors import Anchors
from .errors import InputError
from .executable import interrupt

try:  # not in rclpy before 7.1.4; takes a third of the CPU time
    from rclpy.experimental import EventsExecutor
except ImportError:
    EventsExecutor = SingleThreadedExecutor

# Streams are sensor data: best effort. Deep, because a node that was not scheduled for a moment must find all of it:
# 10 s of a 1 kHz IMU, or 2.5 s of it replayed four times as fast. Takes memory only where it is used.
STREAM_QOS = QoSProfile(depth=10_000, reliability=ReliabilityPolicy.BEST_EFFORT)
ANCHORS_QOS = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
TF_QOS = QoSProfile(depth=100)  # what tf2 listens with
LONGEST_WAIT = 0.2  # s, until a node that receives nothing sees a signal
DIAGNOSTICS_QOS = QoSProfile(depth=10)


OVERRIDES = QoSOverridingOptions([QoSPolicyKind.RELIABILITY, QoSPolicyKind.DEPTH])  # written into the given profile


def publish_stream(node, kind, topic):
    """Publisher of a stream; QoS by parameter: qos_overrides.<topic>.publisher.reliability and .depth."""
    return node.create_publisher(kind, topic, copy(STREAM_QOS), qos_overriding_options=OVERRIDES)


def subscribe_stream(node, kind, topic, callback):
    """Subscription of a stream; QoS by parameter: qos_overrides.<topic>.subscription.reliability and .depth."""
    return node.create_subscription(kind, topic, callback, copy(STREAM_QOS), qos_overriding_options=OVERRIDES)


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

    def stamp(self, t):
        """builtin_interfaces/Time of float s: what `seconds` was given, to the nanosecond."""
        second, nanosecond = divmod(round(t * 1e9), 10**9)
        return Time(sec=self._second + second, nanosec=nanosecond)


def orientation_of(q):
    """Tuple x y z w of a geometry_msgs/Quaternion; NaN for (0, 0, 0, 0), which says: not known."""
    values = (q.x, q.y, q.z, q.w)
    return values if any(values) else (np.nan,) * 4


def anchors_to_message(anchors):
    """AnchorArray of Anchors, with a stamp of 0: anchors do not age."""
    message = AnchorArray()
    message.header.frame_id = anchors.frame
    known = np.where(np.isfinite(anchors.orientations), anchors.orientations, 0.0)
    for i, (x, y, z), q in zip(anchors.ids.tolist(), anchors.positions.tolist(), known.tolist()):
        orientation = Quaternion(x=q[0], y=q[1], z=q[2], w=q[3])
        message.anchors.append(Anchor(id=i, pose=Pose(position=Point(x=x, y=y, z=z), orientation=orientation)))
    return message


def same_anchors(one, other):
    """True if two Anchors are equal in everything."""
    return (
        one.frame == other.frame
        and np.array_equal(one.ids, other.ids)
        and np.array_equal(one.positions, other.positions)
        and np.array_equal(one.orientations, other.orientations, equal_nan=True)
    )


class AnchorsInput:
    """Subscribes to uwb/anchors. anchors : Anchors or None; refused : why the last message was of no use, or None."""

    def __init__(self, node, on_change):
        """on_change(anchors) is called with the first Anchors, and with others that differ."""
        self.anchors = self.refused = None
        self._node, self._on_change = node, on_change
        node.create_subscription(AnchorArray, "uwb/anchors", self._on_message, ANCHORS_QOS)

    def _on_message(self, message):
        try:
            anchors, self.refused = Anchors.from_message(message), None
        except InputError as error:
            self.refused = str(error)
            return
        if self.anchors is not None:
            if same_anchors(anchors, self.anchors):
                return
            self._node.get_logger().warning("the anchors have changed: starting over")
        self.anchors = anchors
        self._on_change(anchors)


def parameter(node, name, default, description):
    """Declare a parameter that is read once, at the start, and return its value; raises InputError."""
    try:
        descriptor = ParameterDescriptor(description=description, read_only=True)
        return node.declare_parameter(name, default, descriptor).value
    except (InvalidParameterTypeException, ParameterUninitializedException) as error:
        kind = {float: "a number with a decimal point, e.g. 1.0", int: "a whole number", bool: "true or false"}
        reason = str(error).rsplit(":", 1)[0]
        raise InputError(f"{name}: {reason}; give {kind.get(type(default), 'text')}.") from error


class Diagnostics:
    """Publishes one status on /diagnostics each second of the wall clock, and logs it whenever its text changes.

    report() -> (level, text, {key: value}), with level one of DiagnosticStatus.OK, WARN, ERROR.
    """

    def __init__(self, node, report):
        self._node, self._report, self._said = node, report, None
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", DIAGNOSTICS_QOS)
        node.create_timer(1.0, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME))

    def publish(self):
        """Publish now."""
        level, text, values = self._report()
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

    node_class() makes the node, in an initialised rclpy, and has the executable's NAME; description : for --help.
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
    node = executor = None
    try:
        _init(parser, arguments)
        node = node_class()
        executor = EventsExecutor()
        executor.add_node(node)
        gc.collect()
        gc.freeze()  # what numba holds is never garbage, and searching it takes a tenth of a second
        interruptible = False
        if stop.done():
            raise KeyboardInterrupt
        while not stop.done() and rclpy.ok():  # a signal is seen after a callback, or after the time
            executor.spin_until_future_complete(stop, timeout_sec=LONGEST_WAIT)
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
            executor.remove_node(node)
            executor.shutdown()
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()
    return 0


def _init(parser, arguments):
    try:
        parser.parse_args(remove_ros_args(arguments)[1:])
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except (implementation.RCLError, implementation.RCLInvalidROSArgsError, implementation.UnknownROSArgsError) as error:
        raise InputError(f"--ros-args: {error}.") from error
