# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Executables as processes in a private ROS domain, and the ROS node that plays to them and records.

Message classes by name, QoS of bags, recording of topics, and the /diagnostics of nodes. `run_live`
runs a bag through both nodes, and records their output.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from functools import partial
from importlib import import_module
import json
import os
from pathlib import Path
import random
import re
import shutil
import signal
import subprocess
import time
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from diagnostic_msgs.msg import DiagnosticArray
from domain_coordinator import domain_id
import rclpy
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
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

from uwb_tdoa_bias.common.errors import Failure, InputError
from uwb_tdoa_bias.common.files import refuse_output
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_bias.ros.node import refusal, waiting
from uwb_tdoa_ekf.results import VERDICTS

from ..bags.files import new_bag, open_bag
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
            for data, information in waiting(subscription):
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


STOP_LIMIT, PATIENCE = 10.0, 60.0  # s from SIGINT to SIGKILL; the latter if it must end well
LOOK = 10.0  # s between two looks at what is waited for, and between two lines about it
READY = re.compile(r"\]: ready\b")  # in the log of a node
TAIL = 8192  # bytes of a log that are looked at
BUSY = 0.2  # share of the time beyond which a process computes; nodes that wait take 0.02


class LiveError(Failure):
    """A process failed or made no progress. The message names it and the file of its output."""


@contextmanager
def variables(values: dict[str, str]) -> Iterator[None]:
    """Set environment variables for the block and the processes that it starts."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def own_domain() -> Iterator[None]:
    """Use a free ROS domain on this machine only, for the block and the processes that it starts.

    The domain is drawn at random: in the first free one DDS may still list nodes that ended just now.
    """
    with (
        domain_id(lambda: random.randint(1, 100)) as number,
        variables({"ROS_DOMAIN_ID": str(number), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}),
    ):
        yield


def wait(
    limit: float | None,
    what: str,
    processes: Processes,
    node: Node,
    condition: Callable[[], object],
    say: Callable[[str], object] = lambda text: None,
    goes_on: Callable[[], object] = lambda: None,
) -> None:
    """Serve the node until condition().

    Parameters
    ----------
    limit : float or None
        s without progress. Progress is a change of `goes_on()`, or a starting process that computes,
        as a node that compiles does.
    what : str
        The awaited event, in words.
    say : callable
        Called every few seconds with the event and the state of the processes.

    Raises
    ------
    LiveError
        If a process ended that should run, or after `limit`.
    """
    looked = moved = time.monotonic()
    worked, sign = processes.busy_times(), goes_on()
    while not condition():
        processes.check()
        now = time.monotonic()
        if now - looked > LOOK:
            working, before, work = now - looked, worked, processes.busy_times()
            busy = any(work[title] - before.get(title, 0.0) > BUSY * working for title in work)
            looked, worked = now, work
            say(f"waiting for {what}: {processes.describe()}")
            if busy or goes_on() != sign:
                moved, sign = now, goes_on()
        if limit is not None and now - moved > limit:
            raise LiveError(
                f"waited {limit:g} s for {what}, and nothing went on ({processes.describe()}); "
                f"their output is in {processes.folder}/*.log."
            )
        rclpy.spin_once(node, timeout_sec=0.05)
    processes.check()


class DiagnosticsListener:
    """Hold the newest status of each node on /diagnostics, and whether it still changes."""

    def __init__(self, node: Node) -> None:
        self._newest: dict[str, dict[str, str]] = {}
        self._repeated: dict[str, int] = {}
        self._subscription = node.create_subscription(
            DiagnosticArray, "/diagnostics", self._take, 10
        )

    def _take(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = status.name.strip("/")
            values = {pair.key: pair.value for pair in status.values}
            before, counts = self._newest.get(name, {}), _counts(values)
            same = bool(before) and all(before.get(key) == value for key, value in counts.items())
            self._repeated[name] = self._repeated.get(name, 0) + 1 if same else 0
            self._newest[name] = values

    def poll(self) -> None:
        """Take the messages that have arrived, of a node that is not spun."""
        for data, _ in waiting(self._subscription):
            self._take(deserialize_message(data, DiagnosticArray))

    def repeated(self, name: str) -> int:
        """Return how often a node has reported unchanged counters since `forget`."""
        return self._repeated.get(name, 0)

    def newest(self, name: str) -> dict[str, str]:
        """Return {key: text} of a node; empty before its first status."""
        return self._newest.get(name, {})

    def forget(self) -> None:
        """Start again to count repetitions of a status.

        Messages that wait to be read are dropped. They are older than this call: a node that was not spun
        would seem settled before anything happened.
        """
        for _ in waiting(self._subscription):
            pass
        self._repeated.clear()

    def counts(self) -> dict[str, dict[str, str]]:
        """Return all counters of the nodes, for comparison with earlier ones."""
        return {name: _counts(values) for name, values in self._newest.items()}

    def is_settled(self) -> bool:
        """Return whether each node has published the same counters twice: no message is on the way."""
        return len(self._repeated) == len(self._newest) and all(self._repeated.values())


def _counts(values: dict[str, str]) -> dict[str, str]:
    return {key: value for key, value in values.items() if value.isdigit()}


class Processes(AbstractContextManager["Processes"]):
    """Run executables of our packages, each in a separate process group, with its output in a file.

    The context manager ends each process that it started.
    """

    def __init__(self, folder: str | Path, stop: Stop) -> None:
        self.folder = Path(folder)
        self._stop = stop
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._may_end: dict[str, Sequence[int]] = {}

    def __exit__(self, *_: object) -> None:
        for title in list(self._running)[::-1]:
            self._end(title, STOP_LIMIT)

    def start(
        self,
        package: str,
        name: str,
        *arguments: object,
        title: str | None = None,
        may_end_with: Sequence[int] = (),
    ) -> subprocess.Popen[bytes]:
        """Start an executable and return its Popen.

        Parameters
        ----------
        title : str or None
            Name of the process, default the name of the executable; its output goes to `file(title)`.
        may_end_with : sequence of int
            Exit codes that are no failure.
        """
        try:
            program = Path(get_package_prefix(package)) / "lib" / package / name
        except PackageNotFoundError as error:
            raise LiveError(
                f"{package} is not installed; build and source the workspace."
            ) from error
        title = title or name
        refuse_output(self.file(title))
        with open(self.file(title), "wb") as log:
            self._running[title] = subprocess.Popen(
                [str(part) for part in (program, *arguments)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        self._may_end[title] = may_end_with
        return self._running[title]

    def pid(self, title: str) -> int:
        """Return the process id of a running executable."""
        return self._running[title].pid

    def file(self, title: str) -> Path:
        """Return the file with the output of a process."""
        return self.folder / f"{title.replace('/', '.')}.log"

    def check(self) -> None:
        """Raise LiveError if a process ended that should run, and KeyboardInterrupt after a signal."""
        if self._stop:
            raise KeyboardInterrupt
        for title, process in self._running.items():
            code = process.poll()
            if code is not None and code not in self._may_end[title]:
                raise self._failure(title, code)

    def busy_times(self) -> dict[str, float]:
        """Return {title: s of processor time, or of waiting for a core} of the starting processes."""
        return {
            title: _busy_time(process.pid)
            for title, process in self._running.items()
            if not READY.search(self._log_tail(title))
        }

    def describe(self) -> str:
        """Describe the last output of each starting process; of all if none is starting."""
        titles = [
            title for title in self._running if not READY.search(self._log_tail(title))
        ] or list(self._running)
        return "; ".join(
            f"{title}: {_last_line(self._log_tail(title)) or 'starting'}" for title in titles
        )

    def stop(self, title: str) -> None:
        """Interrupt a process and wait for it. Raises LiveError if its exit code is not 0."""
        code = self._end(title, PATIENCE)
        if code != 0:
            raise self._failure(title, code)

    def _end(self, title: str, limit: float) -> int:
        process = self._running.pop(title)
        for number, patience in ((signal.SIGINT, limit), (signal.SIGKILL, None)):
            if process.poll() is None:
                os.killpg(process.pid, number)
                try:
                    process.wait(patience)
                except subprocess.TimeoutExpired:
                    continue
        return process.returncode

    def _log_tail(self, title: str) -> str:
        """Return the end of the output."""
        with open(self.file(title), "rb") as log:
            log.seek(max(0, os.fstat(log.fileno()).st_size - TAIL))
            return log.read().decode(errors="replace").strip()

    def _failure(self, title: str, code: int) -> LiveError:
        last = " ".join(self._log_tail(title).splitlines()[-1:])
        return LiveError(
            f"{title} ended with code {code} ({last}); all of its output is in {self.file(title)}."
        )


def _last_line(log: str) -> str:
    """Return the last line of a log, without level, time and name."""
    return re.sub(r"^(\[[^]]*\] ?)+: ", "", (log.splitlines() or [""])[-1])


def _busy_time(pid: int) -> float:
    """Return the s that the threads of a process ran or were ready to run.

    On a loaded machine, a process that computes is ready nearly all the time.
    """
    total = 0
    for file in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        try:
            ran, waited, _ = file.read_text().split()
        except (OSError, ValueError):  # that thread has ended
            continue
        total += int(ran) + int(waited)
    return 1e-9 * total


INPUTS = ("/uwb/anchors", "/uwb/tdoa", "/imu/data")
# Matches that must exist before the first message: topic -> (publishers, subscriptions)
MATCHED = {
    "/imu/data": (0, 1),
    "/uwb/tdoa": (0, 1),
    "/uwb/anchors": (0, 2),
    "/uwb/tdoa_corrected": (1, 1),
    "/odometry": (1, 2),
}
# A replay can wait, a robot cannot: here no link may lose a message, and the replay waits for a
# stream that falls behind.
# s of stamps; hold: see config/bias_node.yaml
HOLD_BACK = {"bias_node": {"hold": 9.975}, "ekf_node": {"lag": 10.0}}
RELIABLE = {
    "bias_node": (
        "/uwb/tdoa.subscription",
        "/odometry.subscription",
        "/uwb/tdoa_corrected.publisher",
    ),
    "ekf_node": (
        "/imu/data.subscription",
        "/uwb/tdoa_corrected.subscription",
        *(f"/{of.topics[0][0]}.subscription" for of in SENSORS.values()),
        "/odometry.publisher",
    ),
}
DEPTH = 1_000_000  # messages that may wait in a subscription
READY_LIMIT = 60.0  # s without progress; the first start compiles the filter, which is progress
MATCH_LIMIT = 300.0  # s; a slow machine takes long to find the nodes
SETTLE_LIMIT = (
    60.0  # s for the diagnostics of the nodes to settle, without a change of the counters
)


@dataclass(frozen=True)
class LiveRun:
    """Result of `run_live`.

    Attributes
    ----------
    recorded : Path
        Bag with `odometry`.
    bias, ekf : dict
        {key: text}, the last diagnostics of each node.
    """

    recorded: Path
    bias: dict[str, str]
    ekf: dict[str, str]


def run_live(
    bag: str | Path,
    folder: str | Path,
    rate: float = 1.0,
    bias_parameters: dict[str, Any] | None = None,
    ekf_parameters: dict[str, Any] | None = None,
    say: Callable[[str], object] = print,
) -> LiveRun:
    """Replay a bag through bias_node and ekf_node, and record their odometry.

    The nodes run in a ROS domain without other users, on this machine only.

    Parameters
    ----------
    bag : path
        The bag to replay.
    folder : path
        Where `recorded_bag` and the output of the processes (`*.log`) go.
    rate : float
        Times as fast as recorded.
    bias_parameters, ekf_parameters : dict or None
        {name: value} for the nodes.
    say : callable
        Called with sentences about the progress.

    Returns
    -------
    LiveRun

    Raises
    ------
    LiveError
        If a process fails or makes no progress.
    KeyboardInterrupt
        After a signal.
    """
    with open_bag(bag) as reader:
        present = {connection.topic for connection in reader.connections}
        total = sum(
            connection.msgcount
            for connection in reader.connections
            if connection.topic == "/uwb/tdoa"
        )
    inputs = [topic for topic in INPUTS if topic in present]
    recorded = Path(folder) / "recorded_bag"
    if recorded.exists():
        shutil.rmtree(recorded)
    with (
        own_domain(),
        session("demo", []) as (node, stop),
        recorded_odometry(node, recorded),
        Processes(folder, stop) as processes,
    ):
        diagnostics = DiagnosticsListener(node)
        processes.start("uwb_tdoa_bias", "bias_node", *_parameters("bias_node", bias_parameters))
        processes.start("uwb_tdoa_ekf", "ekf_node", *_parameters("ekf_node", ekf_parameters))
        say("starting the nodes")
        wait(
            READY_LIMIT,
            "the nodes to find each other",
            processes,
            node,
            lambda: _is_ready(node, diagnostics),
            say,
        )
        say(f"replaying {bag} at rate {rate:g}")
        options = (
            "--rate",
            rate,
            "--follow",
            "odometry",
            "--wait-matched",
            MATCH_LIMIT,
            "--wait-topics",
            *inputs,
        )
        replay = processes.start("uwb_tdoa_tools", "replay", bag, *options, may_end_with=(0, 1))
        wait(
            None,
            "the end of the replay",
            processes,
            node,
            lambda: replay.poll() is not None,
            lambda _: say(_played(diagnostics, total)),
        )
        diagnostics.forget()
        wait(
            SETTLE_LIMIT,
            "the nodes to finish",
            processes,
            node,
            diagnostics.is_settled,
            say,
            diagnostics.counts,
        )
        for name in ("ekf_node", "bias_node"):
            processes.stop(name)
    return LiveRun(recorded, diagnostics.newest("bias_node"), diagnostics.newest("ekf_node"))


def accounts(
    bias: dict[str, str], ekf: dict[str, str], flight: Flight, recorded: int
) -> dict[str, int]:
    """Count the messages of a replayed Flight by outcome, from the last diagnostics of both nodes.

    Parameters
    ----------
    recorded : int
        Number of recorded odometries.

    Returns
    -------
    dict
        {verdict: TDOAs, "waiting": TDOAs, "lost": TDOAs, "early": TDOAs corrected before their pose
        was there, "imu_late": samples, "imu_lost": samples, "sensors_late": values of the other
        sensors, "odometry_lost": messages}.
    """
    counts = {name: int(ekf[name]) for name in (*VERDICTS.values(), "waiting")}
    counts["waiting"] += int(bias["waiting"])  # for poses, which end with the first of the streams
    counts["lost"] = len(flight.tdoa) - sum(counts.values())
    samples = 0 if flight.imu is None else len(flight.imu)
    return counts | {
        "early": int(bias["released before their pose"]),
        "imu_late": int(ekf["imu_late"]),
        "imu_lost": samples - int(ekf["IMU samples received"]),
        "sensors_late": sum(int(ekf.get(f"{name}_late", 0)) for name in SENSORS),
        "odometry_lost": int(ekf["odometry published"]) - recorded,
    }


def _parameters(name: str, values: dict[str, Any] | None) -> list[str]:
    """Return command-line arguments for the parameters of a node. JSON is also YAML."""
    values = HOLD_BACK[name] | (values or {})
    for end in RELIABLE[name]:
        values |= {
            f"qos_overrides.{end}.reliability": "reliable",
            f"qos_overrides.{end}.depth": DEPTH,
        }
    return [
        "--ros-args",
        *(part for key, value in values.items() for part in ("-p", f"{key}:={json.dumps(value)}")),
    ]


def _played(diagnostics: DiagnosticsListener, total: int) -> str:
    """State in words how many TDOAs of the bag bias_node has received."""
    received = int(diagnostics.newest("bias_node").get("received", 0))
    return f"{100.0 * received / max(total, 1):.0f} % of the flight is through"


def _is_ready(node: Node, diagnostics: DiagnosticsListener) -> bool:
    found = diagnostics.newest("ekf_node").get("publishers of uwb/tdoa_corrected", "0") != "0"
    return (
        found
        and bool(diagnostics.newest("bias_node"))
        and all(
            node.count_publishers(topic) >= publishers
            and node.count_subscribers(topic) >= subscriptions
            for topic, (publishers, subscriptions) in MATCHED.items()
        )
    )
