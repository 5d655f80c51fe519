# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Events sent to bias_node and ekf_node in real time, and what these publish meanwhile."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import reduce
import json
import math
import os
from pathlib import Path
import signal
import struct
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, Quaternion, TransformStamped
from nav_msgs.msg import Odometry
import numpy as np
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message, serialize_message
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage

from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_bias.ros.anchors import ANCHORS_QOS, TF_STATIC_QOS, anchors_to_message
from uwb_tdoa_bias.ros.cdr import message_class
from uwb_tdoa_bias.ros.node import unserved, waiting
from uwb_tdoa_msgs.msg import AnchorArray, EstimatorStatus, Tdoa
from uwb_tdoa_tools.live.session import (
    DiagnosticsListener,
    LiveError,
    Processes,
    own_domain,
    session,
    wait,
)

from .events import Event

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.publisher import Publisher

PACKAGES = {"bias_node": "uwb_tdoa_bias", "ekf_node": "uwb_tdoa_ekf"}
# s: the very first start compiles the filter; from ready nodes to the first message
READY, LEAD = (180.0, 0.5)
FETCH = 0.02  # s between two checks for received messages
# of a message that begins with a header, behind the bytes that say how it is encoded
STAMP, HEADER = (struct.Struct("<iI"), 4)
RELIABLE = QoSProfile(depth=1000)
KEPT = 3  # runs for which a domain stays reserved after its own
_taken: deque[ExitStack] = deque()  # their reservations
POSE_STD, YAW_STD = 0.3, 0.1  # m, rad: what a pose on initialpose states
KINDS: dict[str, tuple[type, str, QoSProfile]] = {  # of what is sent
    "imu": (Imu, "imu/data", RELIABLE),
    "tdoa": (Tdoa, "uwb/tdoa", RELIABLE),
    "anchors": (AnchorArray, "uwb/anchors", ANCHORS_QOS),
    "frames": (TFMessage, "/tf_static", TF_STATIC_QOS),
    "initialpose": (PoseWithCovarianceStamped, "initialpose", RELIABLE),
} | {name: (message_class(of.message), of.topics[0][0], RELIABLE) for name, of in SENSORS.items()}
HEARD: dict[str, tuple[type, QoSProfile]] = {
    "odometry": (Odometry, RELIABLE),
    "status": (EstimatorStatus, ANCHORS_QOS),
    "/diagnostics": (DiagnosticArray, RELIABLE),
}


@dataclass
class Heard:
    """What nodes published, on the clock of the events.

    odometry : (arrival s, Odometry)
    status : (arrival s, EstimatorStatus)
    diagnostics : (arrival s, node, level, text)
    begin : origin of the clock, s since 1970
    late : s, largest delay of a sent event
    stop : {node: s that it took to end, inf if it did not end well}
    failed : why the nodes did not start, or ""
    """

    odometry: list[tuple[float, Any]] = field(default_factory=list)
    status: list[tuple[float, Any]] = field(default_factory=list)
    diagnostics: list[tuple[float, str, int, str]] = field(default_factory=list)
    begin: float = 0.0
    late: float = 0.0
    stop: dict[str, float] = field(default_factory=dict)
    failed: str = ""

    def add(self, topic: str, arrival: float, message: Any) -> None:
        """Store a message of a topic in `HEARD`."""
        if topic == "/diagnostics":
            self.diagnostics += [
                (arrival, of.name.strip("/"), ord(of.level), of.message) for of in message.status
            ]
        else:
            getattr(self, topic).append((arrival, message))


def played(
    events: list[Event], seconds: float, parameters: dict[str, dict[str, Any]], folder: str | Path
) -> Heard:
    """Start both nodes in a domain of their own, send them the events, listen for `seconds`, and
    end them.

    parameters : {node: {name: value}}; folder : where their output goes. Returns Heard.
    """
    with (
        _fresh_domain(),
        session("faults", []) as (node, stop),
        Processes(folder, stop) as processes,
    ):
        stage = _Stage(node, processes, parameters, {event.stream for event in events})
        try:
            stage.wait()
            calls = [(event.at, stage.call(event)) for event in events if event.at < seconds]
            return stage.play([*calls, (seconds, lambda begin: None)])
        except LiveError as error:
            return Heard(failed=str(error))
        finally:
            stage.close()


@contextmanager
def _fresh_domain() -> Iterator[None]:
    """As `own_domain`, which others may have only some runs later: for seconds DDS lists nodes that
    were killed.
    """
    while len(_taken) > KEPT:
        _taken.popleft().close()
    _taken.append(ExitStack())
    _taken[-1].enter_context(own_domain())
    yield


class _Stage:
    """Nodes as processes, and who publishes to them, asks them and hears them."""

    def __init__(
        self,
        node: Node,
        processes: Processes,
        parameters: dict[str, dict[str, Any]],
        streams: set[str],
    ) -> None:
        """Start the nodes. streams : names of the streams that they get."""
        self._node, self._processes, self._parameters = node, processes, parameters
        self._titles: dict[str, str] = {}
        self._busy: list[subprocess.Popen[bytes]] = []
        self._diagnostics = DiagnosticsListener(node)
        for name in PACKAGES:
            self._start(name)
        self._publishers: dict[tuple[str, int], Publisher] = {}
        for name in streams & {*KINDS}:
            self._publisher(name)
        self._reset = node.create_client(Trigger, "ekf_node/reset")
        self._set = node.create_client(SetParameters, "ekf_node/set_parameters")
        self._heard = {
            topic: node.create_subscription(kind, topic, unserved, qos, raw=True)
            for topic, (kind, qos) in HEARD.items()
        }
        self._doing: dict[str, Callable[[dict[str, Any]], object]] = {
            "kill": self._kill,
            "start": lambda values: self._start(values["node"], again=True),
            "busy": self._be_busy,
            "reset": lambda _: self._reset.call_async(Trigger.Request()),
            "parameter": self._set_parameter,
        }

    def wait(self) -> None:
        """Return when the nodes hear everything; raises LiveError."""
        newest, ends = self._diagnostics.newest, list(self._publishers.values())
        wait(
            READY,
            "the nodes",
            self._processes,
            self._node,
            lambda: (
                newest("ekf_node").get("publishers of uwb/tdoa_corrected") == "1"
                and newest("bias_node").get("publishers of uwb/tdoa") == "1"
                and all(end.get_subscription_count() for end in ends)
                and self._reset.service_is_ready()
                and self._set.service_is_ready()
            ),
        )

    def call(self, event: Event) -> Callable[[float], object]:
        """call(begin) sends the event; begin : s since 1970 of 0 on its clock."""
        if event.stream in self._doing:
            return lambda _: self._doing[event.stream](event.values)
        data, name, sender = serialize_message(message_of(event)), event.stream, event.sender
        if name == "frames":  # it has stamps of transforms, which do not age
            return lambda _: self._publisher(name).publish(data)
        head, rest = data[:HEADER], data[HEADER + STAMP.size :]

        def send(begin: float) -> None:
            stamp = STAMP.pack(*divmod(round(1e9 * (begin + event.t)), 10**9))
            self._publisher(name, sender).publish(head + stamp + rest)

        return send

    def play(self, calls: list[tuple[float, Callable[[float], object]]]) -> Heard:
        """Make each call at its time, s. Returns the messages received until the last call."""
        for end in self._heard.values():
            list(waiting(end))  # older than the flight
        raw: list[tuple[int, str, bytes]] = []
        begin, due, late = time.time() + LEAD + max(0.0, -calls[0][0]), 0.0, 0.0
        for at, call in calls:
            while (left := begin + at - time.time()) > 0.0 or time.time() > due:
                if time.time() > due:
                    raw += [
                        (information["received_timestamp"] or time.time_ns(), topic, data)
                        for topic, end in self._heard.items()
                        for data, information in waiting(end)
                    ]
                    due = time.time() + FETCH
                time.sleep(min(max(left, 0.0), FETCH))
            late = max(late, time.time() - begin - at)
            call(begin)
        heard = Heard(begin=begin, late=late, stop=self._end())
        for arrived, topic, data in raw:
            heard.add(topic, 1e-9 * arrived - begin, deserialize_message(data, HEARD[topic][0]))
        return heard

    def close(self) -> None:
        """End the busy processes and destroy the node.

        Until it is garbage-collected, the next user of the domain would receive from it.
        """
        for process in self._busy:
            process.kill()
            process.wait()
        self._node.destroy_node()

    def _publisher(self, name: str, sender: int = 0) -> Publisher:
        if (name, sender) not in self._publishers:
            self._publishers[name, sender] = self._node.create_publisher(*KINDS[name])
        return self._publishers[name, sender]

    def _start(self, name: str, again: bool = False) -> None:
        words = (
            f"{key}:={json.dumps(value)}" for key, value in self._parameters.get(name, {}).items()
        )
        arguments = [part for word in words for part in ("-p", word)]
        self._titles[name] = f"{name} again" if again else name
        self._processes.start(
            PACKAGES[name],
            name,
            *(["--ros-args", *arguments] if arguments else []),
            title=self._titles[name],
        )

    def _kill(self, values: dict[str, Any]) -> None:
        os.killpg(self._processes.pid(self._titles.pop(values["node"])), signal.SIGKILL)

    def _be_busy(self, values: dict[str, Any]) -> None:
        loop = (
            f"import time; end = time.time() + {values['seconds']}\nwhile time.time() < end: pass"
        )
        self._busy += [
            subprocess.Popen([sys.executable, "-c", loop]) for _ in range(os.cpu_count() or 1)
        ]

    def _set_parameter(self, values: dict[str, Any]) -> None:
        value = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=values["value"])
        self._set.call_async(
            SetParameters.Request(parameters=[Parameter(name=values["name"], value=value)])
        )

    def _end(self) -> dict[str, float]:
        """{node: s that it took to end, inf if it did not end well}."""
        took = {}
        for name, title in self._titles.items():
            began = time.monotonic()
            try:
                self._processes.stop(title)
                took[name] = time.monotonic() - began
            except LiveError:
                took[name] = math.inf
        return took


def message_of(event: Event) -> Any:
    """The message of an Event, without a stamp."""
    values, name = event.values, event.stream
    if name == "anchors":
        return anchors_to_message(values["anchors"])
    if name == "frames":
        return TFMessage(transforms=[_transform(*each) for each in values["transforms"]])
    message = KINDS[name][0]()
    message.header.frame_id = event.frame
    if name == "imu":
        _set_vector(message.angular_velocity, values["gyro"])
        _set_vector(message.linear_acceleration, values["accel"])
    elif name == "tdoa":
        message.anchor_a, message.anchor_b = int(values["a"]), int(values["b"])
        message.distance_difference, message.variance = (
            float(values["d"]),
            float(values["variance"]),
        )
    elif name == "initialpose":
        message.header.frame_id = ""
        _set_vector(message.pose.pose.position, values["p"])
        message.pose.pose.orientation = Quaternion(
            z=math.sin(values["yaw"] / 2.0), w=math.cos(values["yaw"] / 2.0)
        )
        message.pose.covariance = np.diag([POSE_STD**2] * 3 + [YAW_STD**2] * 3).ravel()
    else:
        sensor = SENSORS[name]
        one = sensor.stream(
            np.zeros(1), **{field: np.array([value]) for field, value in values.items()}
        )
        for path, content in sensor.content(one).items():
            *way, last = path.split(".")
            holder, value = (
                reduce(getattr, way, message),
                np.broadcast_to(content, (1, *np.shape(content)[1:]))[0],
            )
            if np.ndim(value) and len(value) == 3:
                _set_vector(getattr(holder, last), value)
            else:
                setattr(holder, last, value if np.ndim(value) else value.item())
    return message


def _set_vector(vector: Any, values: Any) -> None:
    vector.x, vector.y, vector.z = (float(value) for value in values)


def _transform(frame: str, p: list[float], turn: list[float]) -> TransformStamped:
    """Of a frame in the body: its place, m, and rotation vector, rad."""
    transform = TransformStamped(child_frame_id=frame)
    _set_vector(transform.transform.translation, p)
    transform.header.frame_id = "base_link"
    x, y, z, w = Rotation.from_rotvec(turn).as_quat().tolist()
    transform.transform.rotation = Quaternion(x=x, y=y, z=z, w=w)
    return transform
