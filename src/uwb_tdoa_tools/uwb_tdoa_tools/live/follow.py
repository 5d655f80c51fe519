# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Let a replay keep in step with the nodes that it feeds, and report what these have lost."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
import math
import struct
import time
from typing import Any

import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors import SENSORS

from .processes import DiagnosticsListener
from .session import (
    ANSWER_LIMIT,
    READER_DEPTH,
    SPIN,
    Stop,
    message_class,
    parameter_of,
    subscription_qos,
    taken,
    wait_for_names,
)

LEAD = 2_000_000_000  # ns of stamps that may be played ahead
# ns; the replay waits for each TDOA that is older than the newest by more than STEP. STEP exceeds
# `reorder` of ekf_node: the filter can have used that TDOA. STEP is below `hold` of bias_node and
# `lag` of ekf_node: neither gives up data that are on the way.
STEP = 80_000_000
# ns; STEP for the time START after the first pose. START_STEP is below `pose_lag` of bias_node,
# which passes TDOAs on until it has a pose.
START_STEP, START = 40_000_000, 1_000_000_000
LOOK_PERIOD = LEAD // 20  # ns of stamps between two looks at a topic that is in step or silent
SENSOR_SILENT = (
    1_000_000_000  # ns until ekf_node stops waiting for a silent sensor: reorder_buffer.SILENT
)
SENSOR_SHARE = (
    0.5  # of `lag`: how long ekf_node holds TDOAs back for a sensor: reorder_buffer.OF_SENSORS
)
LAG = 0.25  # s, default of `lag`
IDLE = 2  # reports of a node with unchanged counters after which it has nothing to do
SILENCE = 5.0  # s without a message after which a topic of other nodes is silent
LOOK = 10.0  # s between two looks at the nodes that are waited for
POLL_PERIOD = 0.001  # s
RESIDUAL = "uwb/residual"
LEARNED = 20  # TDOAs from which the shift of stamps by bias_node is estimated


class Follower:
    """Watch a topic whose messages have a header, and hold a replay until the topic catches up.

    If uwb/residual has a publisher, each TDOA is followed too (`add_tdoa`).
    """

    def __init__(self, node: Node, topic: str, nodes: Nodes) -> None:
        """Subscribe to the topic.

        Parameters
        ----------
        node : Node
            It does not spin: messages are polled.
        topic : str
            Name, relative to the namespace of the node or absolute.
        nodes : Nodes
            The nodes that are fed.

        Raises
        ------
        InputError
            If the topic has no publisher, or its messages have no header.
        """
        topic = node.resolve_topic_name(topic)
        types = dict(node.get_topic_names_and_types()).get(topic)
        if not types or not node.count_publishers(topic):
            raise InputError(f"--follow: nobody publishes {topic}; start the node that does first.")
        cls = message_class(types[0])
        if not is_stamped(cls):
            raise InputError(
                f"--follow: messages on {topic} are {types[0]}: not installed, or without a header."
            )
        qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._topic = _Topic(node, cls, topic, qos, nodes)
        self._newest: int | None = None  # ns, stamp of the newest message on the topic
        self._last_look: int | None = None  # ns, stamp of the replay at the last look
        self._started: int | None = None  # ns, stamp of the first message on the topic
        self._tdoas = _Tdoas(node, nodes)

    def add_tdoa(self, stamp: int) -> None:
        """Note that a TDOA with this stamp, ns, was published."""
        self._tdoas.add(stamp)

    def add_sensor(self, topic: str, stamp: int) -> None:
        """Note that a measurement of one of the SENSORS with this stamp, ns, was published."""
        self._tdoas.add_sensor(topic, stamp)

    def wait(self, stamp: int, stop: Stop) -> float:
        """Wait until a message may be published, and return how long that took, s.

        The topic must not be more than LEAD behind the message. Each TDOA that is older by STEP than
        the time of the filter must have come back on uwb/residual. That time is the stamp of the newest TDOA, or
        less while the filter waits for a sensor.

        Parameters
        ----------
        stamp : int
            Stamp of the message, ns.
        stop : Stop
            True once the wait shall end.
        """
        return self._tdoas.wait(self._is_starting(stamp), stop) + self._wait_for_stamps(stamp, stop)

    def _is_starting(self, stamp: int) -> bool:
        """Return whether bias_node may still lack poses at this stamp, ns."""
        if self._started is not None and stamp < self._started - LEAD:  # the recording restarts
            self._started = None
        if self._started is None:
            self._hear(self._topic.stamps())
        return self._started is None or stamp < self._started + START

    def _hear(self, stamps: list[int]) -> None:
        """Note the stamps, ns, of the messages that have come."""
        if stamps:
            self._newest = stamps[-1]
            self._started = self._newest if self._started is None else self._started

    def _wait_for_stamps(self, stamp: int, stop: Stop) -> float:
        self._newest = stamp if self._newest is None else self._newest
        self._last_look = stamp if self._last_look is None else self._last_look

        def in_step() -> bool:
            assert self._newest is not None
            return stamp - self._newest <= LEAD

        near = self._topic.silent or in_step()
        if near and 0 <= stamp - self._last_look <= LOOK_PERIOD:
            return 0.0
        self._last_look = stamp
        return self._topic.wait(self._hear, in_step, stop)


class _Topic:
    """Poll a topic, and wait for its messages unless the nodes are idle.

    Attributes
    ----------
    silent : bool
        Whether the last wait ended because the nodes had nothing to do.
    """

    def __init__(self, node: Node, cls: Any, topic: str, qos: QoSProfile, nodes: Nodes) -> None:
        self._subscription = node.create_subscription(cls, topic, lambda _: None, qos, raw=True)
        self._nodes = nodes
        self.silent = False

    def stamps(self) -> list[int]:
        """Return the stamps, ns, of the messages that have arrived."""
        found = [stamp_of(data) for data, _ in taken(self._subscription)]
        self.silent = self.silent and not found
        return found

    def wait(
        self, hear: Callable[[list[int]], object], in_step: Callable[[], bool], stop: Stop
    ) -> float:
        """Call hear(stamps) until in_step(), silence or `stop`. Return how long that took, s."""
        began = time.monotonic()
        self._nodes.watch()
        while not stop:
            if stamps := self.stamps():
                self._nodes.watch()
            hear(stamps)
            if in_step() or self.silent:
                break
            self.silent = self._nodes.are_idle()
            time.sleep(POLL_PERIOD)
        return time.monotonic() - began


class _Tdoas:
    """Count how far the published TDOAs have left the filter, in the order of their stamps."""

    def __init__(self, node: Node, nodes: Nodes) -> None:
        self._topic: _Topic | None = None
        self._sensor_wait = round(1e9 * SENSOR_SHARE * nodes.lag)
        publishers = node.get_publishers_info_by_topic(node.resolve_topic_name(RESIDUAL))
        cls = message_class(publishers[0].topic_type) if publishers else None
        if cls is not None:
            qos = subscription_qos([publisher.qos_profile for publisher in publishers])
            qos.depth = 10 * READER_DEPTH
            self._topic = _Topic(node, cls, RESIDUAL, qos, nodes)
        self._start_over()

    def _start_over(self) -> None:
        self._begin = -math.inf  # ns; older TDOAs need not leave the filter
        self._newest: int | None = None  # ns, newest stamp that was published
        self._out = -math.inf  # ns, newest stamp that left the filter
        if self._topic is not None:
            self._topic.silent = False
        self._first: deque[int] = deque()  # first stamps that were published
        self._shift = 0  # ns by which the same stamps are smaller when they leave the filter
        self._learned = 0  # number of stamps from which `_shift` is known
        self._sensors: dict[str, int] = {}  # {topic: ns, newest stamp that was published}
        # Whether START_STEP is too small, because the recorded IMU is behind the TDOAs.
        self._behind = False

    def add(self, stamp: int) -> None:
        if self._newest is not None and stamp < self._newest - LEAD:  # the recording restarts
            self._start_over()
        if self._newest is None:
            self._begin, self._newest = stamp - 1, stamp
        self._newest = max(self._newest, stamp)
        if self._learned < LEARNED:
            self._first.append(stamp)

    def add_sensor(self, topic: str, stamp: int) -> None:
        self._sensors[topic] = stamp

    def wait(self, starting: bool, stop: Stop) -> float:
        if self._topic is None or self._newest is None:
            return 0.0
        step = START_STEP if starting and not self._behind else STEP
        if self._is_in_step(step):
            return 0.0
        waited = self._topic.wait(self._learn, lambda: self._is_in_step(step), stop)
        self._behind = self._behind or self._topic.silent and step == START_STEP
        return waited

    def _is_in_step(self, step: int) -> bool:
        assert self._newest is not None
        sensors = [
            stamp for stamp in self._sensors.values() if stamp > self._newest - SENSOR_SILENT
        ]
        time_of_filter = max(min((self._newest, *sensors)), self._newest - self._sensor_wait)
        return time_of_filter - step <= max(self._begin, self._out + self._shift)

    def _learn(self, stamps: list[int]) -> None:
        """Note stamps that left the filter. The first ones show by how much an effect shifts them."""
        self._out = max([self._out, *stamps])
        for stamp in stamps[: len(self._first)]:
            if self._learned < LEARNED:
                self._shift = max(self._shift, self._first.popleft() - stamp)
                self._learned += 1


def is_stamped(cls: Any) -> bool:
    """Return whether the messages of a class, or None, begin with a header."""
    return (
        cls is not None
        and next(iter(cls.get_fields_and_field_types().values()), None) == "std_msgs/Header"
    )


def stamp_of(data: bytes) -> int:
    """Return the stamp, ns, of a serialized message (CDR) that begins with a header."""
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return seconds * 10**9 + nanoseconds


SETTLE_LIMIT = 60.0  # s for the diagnostics of the nodes to settle
PATIENCE = {"bias_node": "hold", "ekf_node": "lag"}  # parameters, s of stamps
TROUBLE = {  # {node: {key in its diagnostics: words}}
    "bias_node": {"released before their pose": "TDOAs corrected before their pose was there"},
    "ekf_node": {
        "late": "TDOAs late",
        "imu_late": "IMU samples late",
        **{f"{name}_late": f"{of.plural} late" for name, of in SENSORS.items()},
    },
}
RECEIVED = {  # {node: {key in its diagnostics: what it counts}}
    "bias_node": {"received": "TDOAs"},
    "ekf_node": {"TDOAs received": "TDOAs", "IMU samples received": "IMU samples"},
}


class Nodes:
    """Read the counters of bias_node and ekf_node in our namespace, while a replay feeds them.

    Attributes
    ----------
    lag : float
        Parameter `lag` of ekf_node, s.
    """

    lag = LAG

    def __init__(self, node: Node, say: Callable[[str], object] = print) -> None:
        """Find the nodes and read their counters.

        Parameters
        ----------
        node : Node
            Our node.
        say : callable
            Called with a sentence if the replay waits for long.

        Raises
        ------
        InputError
            If their parameters end a wait too early, or a node publishes no /diagnostics.
        """
        self._node, self._diagnostics, self._say = node, DiagnosticsListener(node), say
        self._watched = self._looked = 0.0  # s, beginning of the watch, and last look at the graph
        space = node.get_namespace()
        wait_for_names(node)
        self._names = {
            name: f"{space.rstrip('/')}/{name}" for name in TROUBLE if self._is_there(name)
        }
        if len(self._names) == len(TROUBLE):
            self._check_patience()
        self._before = self._counts(bool)
        for name in self._names:
            if not self._before[name]:
                raise InputError(
                    f"--follow: {self._names[name]} says nothing on /diagnostics for "
                    f"{SETTLE_LIMIT:g} s; start it again."
                )

    def _is_there(self, name: str) -> bool:
        return (name, self._node.get_namespace()) in self._node.get_node_names_and_namespaces()

    def watch(self) -> None:
        """Start to watch whether the nodes have nothing to do."""
        self._diagnostics.forget()
        self._watched = self._looked = time.monotonic()

    def are_idle(self) -> bool:
        """Return whether no node has anything to do: each has reported unchanged counters.

        A node that does not report gets no processor time: it has something to do until it leaves
        the graph. Without our nodes, SILENCE decides.
        """
        self._diagnostics.poll()
        now = time.monotonic()
        if not self._names:
            return now > self._watched + SILENCE
        busy = [
            name
            for name, full in self._names.items()
            if self._diagnostics.repeated(full.strip("/")) < IDLE
        ]
        if busy and now > self._looked + LOOK:
            self._looked, busy = now, [name for name in busy if self._is_there(name)]
            self._say(f"waiting for {' and '.join(busy) or 'nodes that have ended'}")
        return not busy

    def faults(self, count_played: Callable[[str], int], stop: Stop) -> dict[str, int]:
        """Return {fault since the start: count}, once the diagnostics have settled or on `stop`.

        Parameters
        ----------
        count_played : callable
            Number of messages of a kind ("TDOAs", "IMU samples") that the replay published.
        stop : Stop
            True once the process was asked to end.
        """
        after = self._counts(lambda _: stop or self._diagnostics.is_settled())
        since = {
            name: {
                key: count - self._before[name].get(key, 0) for key, count in after[name].items()
            }
            for name in self._names
        }
        wrong = {}
        for name, counts in since.items():
            for key, what in TROUBLE[name].items():
                wrong[what] = counts.get(key, 0)
            for key, what in RECEIVED[name].items() if len(self._names) == len(TROUBLE) else ():
                on_their_way = (
                    since["bias_node"].get("waiting", 0)
                    if (name, what) == ("ekf_node", "TDOAs")
                    else 0
                )
                lost = count_played(what) - counts.get(key, 0) - on_their_way
                wrong[f"{what} lost"] = max(lost, wrong.get(f"{what} lost", 0))
        return {what: count for what, count in wrong.items() if count > 0}

    def _counts(
        self, is_enough: Callable[[DiagnosticsListener], object]
    ) -> dict[str, dict[str, int]]:
        """Return {node: {key: count}} when each node has published and is_enough(diagnostics) holds."""
        until = time.monotonic() + SETTLE_LIMIT
        self._diagnostics.forget()
        newest = {}
        while self._names and time.monotonic() < until:
            rclpy.spin_once(self._node, timeout_sec=SPIN)
            newest = {
                name: self._diagnostics.newest(full.strip("/"))
                for name, full in self._names.items()
            }
            if all(newest.values()) and is_enough(self._diagnostics):
                break
        return {
            name: {key: int(text) for key, text in values.items() if text.isdigit()}
            for name, values in newest.items()
        }

    def _check_patience(self) -> None:
        """Require: longest wait in the filter < hold < lag. Else a node drops data that are on the way."""
        hold, self.lag = (self._parameter(name, parameter) for name, parameter in PATIENCE.items())
        least = 1e-9 * STEP + SENSOR_SHARE * self.lag
        if not least < hold < self.lag:
            raise InputError(
                f"--follow: bias_node's hold is {hold:g} s and ekf_node's lag {self.lag:g} s; "
                "to be followed they need "
                f"{least:g} s < hold < lag."
            )

    def _parameter(self, name: str, parameter: str) -> float:
        value = parameter_of(self._node, self._names[name], parameter)
        if value is None:
            raise InputError(
                f"--follow: {self._names[name]} does not answer for {ANSWER_LIMIT:g} s; start "
                "it again."
            )
        return float(value)
