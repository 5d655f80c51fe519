# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The ROS node of replays and recordings, message classes by name, QoS of bags; recording of topics."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
import signal
import time
from typing import Any

import rclpy
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.task import Future
from rosbags.interfaces import (
    Connection,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import Writer

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.ros.node import refusal

from ..bags.files import new_bag
from ..bags.messages import add_type, typestore

KNOWN = frozenset(  # packages of message types: the usual ones of ROS, and ours
    """actionlib_msgs action_msgs builtin_interfaces diagnostic_msgs geometry_msgs lifecycle_msgs nav_msgs rcl_interfaces rosgraph_msgs
    sensor_msgs shape_msgs statistics_msgs std_msgs stereo_msgs tf2_msgs trajectory_msgs unique_identifier_msgs uwb_tdoa_msgs
    visualization_msgs""".split()
)
AGAIN = 4.0  # s after which a node that has not answered is asked once more
READER_DEPTH = 10_000  # messages that a subscription queues: 10 s of a 1 kHz stream


class Stop:
    """True once the process was asked to end; holds the number of the signal."""

    def __init__(self) -> None:
        self.signal: int | None = None

    def __bool__(self) -> bool:
        return self.signal is not None


@contextmanager
def session(name: str, arguments: Sequence[str]) -> Iterator[tuple[Node, Stop]]:
    """Yield (node, Stop). SIGINT and SIGTERM only set Stop: the block ends in its own order.

    Parameters
    ----------
    arguments : sequence of str
        Command line with the --ros-args for rclpy.

    Raises
    ------
    InputError
        If rclpy refuses the arguments.
    """
    stop = Stop()

    def asked(number: int, _: object) -> None:
        stop.signal = number

    # Set here even where SIGINT was ignored, as it is in a job that a shell script put in the
    # background.
    previous = {number: signal.signal(number, asked) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        try:
            rclpy.init(args=[name, *arguments], signal_handler_options=SignalHandlerOptions.NO)
        except (rclpy_implementation.RCLError, rclpy_implementation.UnknownROSArgsError) as error:
            raise InputError(refusal(error)) from error
        try:
            # Without parameters and /rosout: a recording of all topics shall not hold our own.
            node = rclpy.create_node(name, start_parameter_services=False, enable_rosout=False)
            yield node, stop
        finally:
            rclpy.try_shutdown()
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)


def message_class(msgtype: str, packages: Sequence[str] = ()) -> type | None:
    """Return the class of a type like "pkg/msg/Name", or None.

    None if the package is not installed, or is neither in KNOWN nor in `packages`. Publishers and bags
    choose the name of the type, and importing a package runs its code.
    """
    package, _, name = msgtype.partition("/msg/")
    if package not in KNOWN and package not in packages or not name.isidentifier():
        return None
    try:
        return getattr(import_module(f"{package}.msg"), name, None)
    except ImportError:
        return None


def taken(subscription: Subscription) -> Iterator[tuple[bytes, dict[str, int]]]:
    """Yield (bytes, information) of the messages that have arrived at a subscription."""
    with subscription.handle:
        while (
            message := subscription.handle.take_message(subscription.msg_type, True)
        ) is not None:
            yield message


def publisher_qos(recorded: Sequence[Qos], messages: int) -> QoSProfile:
    """Return the QoSProfile to replay a topic with.

    Durability is as recorded. Reliability is always reliable, which serves best-effort subscriptions
    too. A stream keeps all messages that are not acknowledged: a slow reliable subscription delays the
    replay and loses nothing. On a transient-local topic, a late subscription gets as many messages as
    the recorded publishers kept.

    Parameters
    ----------
    recorded : sequence of rosbags Qos
        QoS of each recorded publisher.
    messages : int
        Number of recorded messages.
    """
    if any(qos.durability == QosDurability.TRANSIENT_LOCAL for qos in recorded):
        # Discovery does not transmit the depth: then 0 was recorded.
        kept = sum(qos.depth for qos in recorded)
        return QoSProfile(
            depth=kept or max(1, min(messages, READER_DEPTH)),
            reliability=ReliabilityPolicy.RELIABLE,
            durability=DurabilityPolicy.TRANSIENT_LOCAL,
        )
    return QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)


def subscription_qos(offered: Sequence[QoSProfile]) -> QoSProfile:
    """Return the QoSProfile that receives the most from publishers with the offered QoSProfiles."""
    reliable = all(qos.reliability == ReliabilityPolicy.RELIABLE for qos in offered)
    latched = all(qos.durability == DurabilityPolicy.TRANSIENT_LOCAL for qos in offered)
    return QoSProfile(
        depth=READER_DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def recorded_qos(qos: QoSProfile) -> Qos:
    """Return the rosbags Qos of a QoSProfile.

    Both number the policies as rmw does.
    """

    def time(duration: Duration) -> QosTime:
        return QosTime(*divmod(duration.nanoseconds, 10**9))

    return Qos(
        QosHistory(int(qos.history)),
        qos.depth,
        QosReliability(int(qos.reliability)),
        QosDurability(int(qos.durability)),
        time(qos.deadline),
        time(qos.lifespan),
        QosLiveliness(int(qos.liveliness)),
        time(qos.liveliness_lease_duration),
        qos.avoid_ros_namespace_conventions,
    )


# Ask running nodes for their parameters.


SPIN = 0.05  # s
ANSWER_LIMIT = 10.0  # s for a node's parameters
UNKNOWN = "_NODE_NAME_UNKNOWN_"  # what rmw calls a node whose name has not come yet


def wait_for_names(node: Node) -> None:
    """Wait until the node of each publisher and subscription has a name: DDS sends names later."""
    until = time.monotonic() + ANSWER_LIMIT
    while time.monotonic() < until:
        ends = [node.get_publishers_info_by_topic, node.get_subscriptions_info_by_topic]
        topics = [topic for topic, _ in node.get_topic_names_and_types()]
        if not any(
            end.node_name == UNKNOWN for find in ends for topic in topics for end in find(topic)
        ):
            return
        time.sleep(SPIN)


def parameter_of(node: Node, name: str, parameter: str) -> Any:
    """Return the value of a parameter, or None without an answer within ANSWER_LIMIT.

    It asks again AGAIN s after the last time: the middleware drops an answer to a client that it has
    not met yet ("failed to send response (timeout)").

    Parameters
    ----------
    node : Node
        Our node, which nothing else serves meanwhile.
    name : str
        Absolute name of the node that has the parameter.
    parameter : str
        Its name.
    """
    client = AsyncParameterClient(node, name)
    if not client.wait_for_services(ANSWER_LIMIT):
        return None
    asked, due, until = list[Future](), 0.0, time.monotonic() + ANSWER_LIMIT
    while (now := time.monotonic()) < until and not any(future.done() for future in asked):
        if now > due:
            asked.append(client.get_parameters([parameter]))
            due = now + AGAIN
        rclpy.spin_once(node, timeout_sec=SPIN)
    answers = [future.result() for future in asked if future.done()]
    if not answers or answers[0] is None or not answers[0].values:
        return None
    return parameter_value_to_python(answers[0].values[0])


@dataclass(frozen=True)
class End:
    """A publisher or a subscription of a topic.

    Attributes
    ----------
    topic, node : str
        Absolute names.
    kind : str
        Type of the messages.
    publishes : bool
        True for a publisher.
    reliable, latched : bool
        QoS; false means best effort and volatile.
    """

    topic: str
    node: str
    kind: str
    publishes: bool
    reliable: bool
    latched: bool

    @property
    def qos(self) -> str:
        """Describe the QoS in words."""
        return (
            f"{'reliable' if self.reliable else 'best effort'}, "
            f"{'transient local' if self.latched else 'volatile'}"
        )

    def gets(self, publisher: End) -> bool:
        """Return whether this subscription receives from a publisher of its topic.

        A subscription may not request more than is offered (DDS).
        """
        return publisher.reliable >= self.reliable and publisher.latched >= self.latched


REMEDY = "build and source the workspace that has it"
DISCOVERY_PERIOD = 0.1  # s between two looks for new topics
POLL_PERIOD = 0.005  # s between two reads of the subscriptions, which queue messages meanwhile


@contextmanager
def recorded_odometry(node: Node, path: str | Path) -> Iterator[None]:
    """Record the topic /odometry while the block lasts. The caller must spin the node.

    The bag appears at `path` when the block ends without an exception.

    Raises
    ------
    InputError
        If `path` exists.
    """
    with new_bag(path) as writer:
        recorder = Recorder(node, writer, {"/odometry"}, lambda sentence: None)
        timer = node.create_timer(DISCOVERY_PERIOD, recorder.discover)
        yield
        node.destroy_timer(timer)
        recorder.take()


class Recorder:
    """Write the messages of wanted topics to a bag.

    Attributes
    ----------
    counts : dict
        {topic: messages recorded so far}.
    """

    def __init__(
        self,
        node: Node,
        writer: Writer,
        wanted: set[str],
        say: Callable[[str], object],
    ) -> None:
        self.counts: dict[str, int] = {}
        self._node, self._writer, self._wanted, self._say = node, writer, wanted, say
        self._pairs: list[tuple[Subscription, Connection]] = []

    def discover(self) -> None:
        """Subscribe to wanted topics that have a publisher now."""
        for topic, types in self._node.get_topic_names_and_types():
            if topic in self.counts or topic not in self._wanted:
                continue
            publishers = self._node.get_publishers_info_by_topic(topic)
            if publishers:
                # A topic may be announced with several types: the first installed one is taken.
                msgtype = next(filter(message_class, types), types[0])
                self._subscribe(
                    topic,
                    msgtype,
                    [each.qos_profile for each in publishers if each.topic_type == msgtype],
                )

    def run(self, enough: Callable[[], object]) -> None:
        """Discover topics and take messages until enough()."""
        look_again = 0.0
        while not enough():
            if time.monotonic() >= look_again:
                self.discover()
                look_again = time.monotonic() + DISCOVERY_PERIOD
            self.take()
            time.sleep(POLL_PERIOD)

    def take(self) -> None:
        """Write all messages that have arrived to the bag."""
        for subscription, connection in self._pairs:
            for data, information in taken(subscription):
                self._write(connection, data, information)

    def _write(self, connection: Connection, data: bytes, information: dict[str, int]) -> None:
        stamp = information["received_timestamp"] or time.time_ns()
        self._writer.write(connection, stamp, data)
        self.counts[connection.topic] += 1

    def _subscribe(self, topic: str, msgtype: str, offered: list[QoSProfile]) -> None:
        cls = message_class(msgtype)
        if cls is None:
            raise InputError(
                f"{msgtype} is not installed, or of a package that is not known; {REMEDY}."
            )
        add_type(typestore(), msgtype)
        connection = self._writer.add_connection(
            topic,
            msgtype,
            typestore=typestore(),
            offered_qos_profiles=[recorded_qos(qos) for qos in offered],
        )
        qos = subscription_qos(offered)
        # In a node that spins, the callback writes. Else `take` moves many messages at a time.
        write = partial(self._write, connection)
        subscription = self._node.create_subscription(cls, topic, write, qos, raw=True)
        self._pairs.append((subscription, connection))
        self.counts[topic] = 0
        self._say(f"recording {topic} ({msgtype}, {qos.reliability.name.lower()})")


FIRST_LIMIT = 20.0  # s until there must be a message on the first topic


def listen(
    topics: Sequence[str], bag: str | Path, seconds: float, say: Callable[[str], object] = print
) -> tuple[dict[str, str], list[End]]:
    """Record topics to a new bag for some seconds, or until SIGINT.

    The time starts with the first message on the first topic.

    Parameters
    ----------
    topics : sequence of str
        Absolute names.
    bag : path
        The bag to write.
    seconds : float
        Duration, s.
    say : callable
        Called with sentences about the progress.

    Returns
    -------
    kinds : dict
        {topic: type} of all topics in the system.
    ends : list of End
        Publishers and subscriptions of `topics`, without our own.

    Raises
    ------
    InputError
        If no message arrives on the first topic.
    """
    with session("check", []) as (node, stop), new_bag(bag) as writer:
        recorder = Recorder(node, writer, set(topics), say)
        say(f"waiting for {topics[0]}")
        heard = partial(recorder.counts.get, topics[0], 0)
        until = time.monotonic() + FIRST_LIMIT
        recorder.run(lambda: stop or heard() or time.monotonic() > until)
        kinds = {topic: types[0] for topic, types in node.get_topic_names_and_types()}
        if not heard():
            raise InputError(
                f"no message on {topics[0]} within {FIRST_LIMIT:g} s; {_remedy(topics[0], kinds)}."
            )
        say(
            f"listening for {seconds:g} s; carry the tag through the room, turn, lift and "
            "lower it (Ctrl-C ends it earlier)"
        )
        until = time.monotonic() + seconds
        recorder.run(lambda: stop or time.monotonic() > until)
        kinds = {topic: types[0] for topic, types in node.get_topic_names_and_types()}
        ends = [
            end
            for topic in topics
            for end in _ends(node, topic)
            if end.node != node.get_fully_qualified_name()
        ]
    return kinds, ends


def _ends(node: Node, topic: str) -> Iterator[End]:
    for publishes, infos in (
        (True, node.get_publishers_info_by_topic(topic)),
        (False, node.get_subscriptions_info_by_topic(topic)),
    ):
        for info in infos:
            qos = info.qos_profile
            yield End(
                topic,
                f"{info.node_namespace.rstrip('/')}/{info.node_name}",
                info.topic_type,
                publishes,
                qos.reliability == ReliabilityPolicy.RELIABLE,
                qos.durability == DurabilityPolicy.TRANSIENT_LOCAL,
            )


def _remedy(topic: str, kinds: dict[str, str]) -> str:
    """Return the remedy for a topic without a publisher."""
    others = sorted(
        name for name, kind in kinds.items() if kind == "uwb_tdoa_msgs/msg/Tdoa" and name != topic
    )
    if others:
        return "say where they are: " + " or ".join(f"--topic uwb/tdoa={name}" for name in others)
    return "start the tag's driver, in this ROS_DOMAIN_ID"
