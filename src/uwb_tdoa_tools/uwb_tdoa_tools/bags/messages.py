# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Types of ROS 2 messages, and the arrays of a Flight as such messages and back, without a ROS installation.

`valid` returns which numbers of rows (n, k) can be used: (n, k) bool.
Unmeasured values follow the message definitions: an orientation of (0, 0, 0, 0), an
orientation_covariance[0] of -1, covariances of 0 for unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import lru_cache, partial, reduce
from operator import attrgetter
import os
from pathlib import Path
import re
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import (
    Connection,
    ConnectionExtRosbag2,
    MessageDefinition,
    MessageDefinitionFormat,
    Nodetype,
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import DEFINITION_BYTES, InputError
from uwb_tdoa_bias.common.flight import Imu, Tdoas, Truth
from uwb_tdoa_bias.common.safe_yaml import parse_yaml
from uwb_tdoa_bias.common.sensors import SENSORS, Sensor
from uwb_tdoa_bias.common.sensors.sensor import LARGEST_NUMBER
from uwb_tdoa_ekf.results import Odometry, pose_and_twist

RowOfMessage = Callable[[Any], tuple[float, ...] | None]

OUR_PACKAGE = "uwb_tdoa_msgs"
OUR_TYPES = (
    "Tdoa",
    "TdoaCorrected",
    "TdoaResidual",
    "Anchor",
    "AnchorArray",
    "Calibration",
    "EstimatorStatus",
    *(
        of.message.rpartition("/")[2]
        for of in SENSORS.values()
        if of.message.startswith(OUR_PACKAGE)
    ),
)
_FORMATS = {"ros2msg": MessageDefinitionFormat.MSG, "ros2idl": MessageDefinitionFormat.IDL}
# where folders of message packages are besides installed ones: in a wheel, and in the sources
_OURS = Path(__file__).parent, Path(__file__).resolve().parents[3]


@lru_cache(maxsize=1)
def typestore() -> Typestore:
    """Return the types of ROS 2 Jazzy and of uwb_tdoa_msgs; `add_type` adds others."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name in OUR_TYPES:
        add_type(store, f"{OUR_PACKAGE}/msg/{name}")
    return store


def add_type(store: Typestore, msgtype: str) -> None:
    """Add a type like "pkg/msg/Name" and its parts to a store, from installed .msg files."""
    if msgtype in store.fielddefs:
        return
    types = get_types_from_msg(_definition(msgtype), msgtype)
    store.register(types)
    for _, fields in types.values():
        for _, field in fields:
            while field[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
                field = field[1][0]
            if field[0] == Nodetype.NAME:
                add_type(store, field[1])


def recorded_topic(
    topic: str, msgtype: str, encoding: str, definition: str, qos: str
) -> Connection | None:
    """Return a topic of a bag, without id and count; None if the names are none.

    Parameters
    ----------
    topic, msgtype : str
    encoding, definition : str
        "ros2msg" or "ros2idl", and the text that defines the type. May be empty.
    qos : str
        Offered QoS, YAML.
    """
    if not re.fullmatch(r"[/\w]+", topic) or not re.fullmatch(r"\w+/\w+/\w+", msgtype):
        return None
    kind = _FORMATS.get(encoding) if definition else None
    described = MessageDefinition(kind or MessageDefinitionFormat.NONE, definition)
    try:
        offered = parse_qos(parse_yaml(qos, topic))
    except Exception:  # rosbags raises whatever its parsers run into
        offered = []
    return Connection(
        0, topic, msgtype, described, "", 0, ConnectionExtRosbag2("cdr", offered), None
    )


def check_type(path: str | Path, connection: Connection) -> None:
    """Raise InputError unless the type of a topic is known in the recorded version.

    A definition that is missing, or that cannot be read, states no version.
    """
    store, definition = typestore(), connection.msgdef
    add_type(store, connection.msgtype)
    if definition.format != MessageDefinitionFormat.MSG or len(definition.data) > DEFINITION_BYTES:
        return
    try:
        recorded = _hash_of(definition.data, connection.msgtype)
    except Exception:  # rosbags raises whatever its parsers run into
        return
    if recorded != store.hash_rihs01(connection.msgtype):
        raise InputError(
            f"{path}: {connection.topic} was recorded with another version of "
            f"{connection.msgtype}; use the version of "
            "this software that recorded it."
        )


@lru_cache(maxsize=64)
def _hash_of(definition: str, msgtype: str) -> str:
    """Return the hash of a type from its definition in a bag."""
    of_bag = get_typestore(Stores.EMPTY)
    of_bag.register(get_types_from_msg(definition, msgtype))
    return of_bag.hash_rihs01(msgtype)


def _definition(msgtype: str) -> str:
    package, _, name = msgtype.split("/")
    prefixes = [
        Path(prefix) / "share"
        for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
        if prefix
    ]
    for share in [*prefixes, *_OURS]:
        file = share / package / "msg" / f"{name}.msg"
        if file.is_file():
            return file.read_text(encoding="utf-8")
    raise InputError(
        f"{msgtype}: its definition is not installed; build and source the workspace that has "
        f"{package}."
    )


BODY_FRAME, ANTENNA_FRAME = "base_link", "uwb_antenna"


def is_body(frame: str) -> bool:
    """Return whether a frame_id is the body frame of any robot; an empty one counts as body."""
    return frame.rpartition("/")[2] in (BODY_FRAME, "")


def nanoseconds(name: str, t: np.ndarray) -> np.ndarray:
    """Return (n,) int ns of stamps (n,) s.

    Raises InputError, with the name of the stream, for a stamp that ROS cannot hold.
    """
    bad = np.flatnonzero(~((t >= 0) & (t < 2**31)))
    if len(bad):
        raise InputError(
            f"{name}: stamp {bad[0]} is {t[bad[0]]} s; ROS stamps are 0 s to 2^31 s: shift "
            "the clock."
        )
    return np.rint(np.asarray(t, dtype=float) * 1e9).astype(np.int64)


def valid(rows: np.ndarray) -> np.ndarray:
    """Return which numbers of rows (n, k) are finite and in range: (n, k) bool."""
    return np.abs(rows) <= LARGEST_NUMBER  # NaN is not


def messages_of(
    topic: str, kind: str, t: np.ndarray, content: dict[str, Any], frame: str, store: Typestore
) -> Iterator[tuple[int, Any]]:
    """Yield (stamp ns, message) of a type with a header.

    Parameters
    ----------
    topic : for messages of errors.
    t : (n,) s.
    content : {field: values, one for all messages or (n, ...)}; other fields are 0. Fields are numbers,
        arrays, or messages of numbers (Vector3, Quaternion), with a dot before a field of a field.
    frame : frame_id.
    """
    make, columns = _maker(store, kind), []
    for field, each in content.items():
        *way, last = field.split(".")
        parts = _parts(attrgetter(field)(make()))
        values = np.broadcast_to(each, (len(t), *np.shape(each)[1:]))
        columns.append((way, last, parts, values.tolist() if parts or values.ndim == 1 else values))
    for k, stamp in enumerate(nanoseconds(topic, t).tolist()):
        message = make()
        header = message.header
        header.frame_id = frame
        header.stamp.sec, header.stamp.nanosec = divmod(stamp, 10**9)
        for way, last, parts, values in columns:
            holder = reduce(getattr, way, message)
            if parts:
                vector = getattr(holder, last)
                for part, number in zip(parts, values[k], strict=True):
                    setattr(vector, part, number)
            else:
                setattr(holder, last, values[k])
        yield stamp, message


def _maker(store: Typestore, kind: str) -> Callable[[], Any]:
    """Return a function that makes messages of a type with all fields 0."""
    makers: list[Callable[[], Any]] = []
    fields: Any = store.get_msgdef(kind).fields  # nested, as each Nodetype says
    for _, (node, what) in fields:
        if node == Nodetype.NAME:
            makers.append(_maker(store, what))
        elif node == Nodetype.BASE:
            makers.append(str if what[0] == "string" else int)
        else:
            makers.append(partial(np.zeros, what[1]))
    message = store.types[kind]
    if {str, int} >= {*makers}:  # quick: such values need no copy
        return partial(message, *(make() for make in makers))
    return lambda: message(*[make() for make in makers])


def row_of(*fields: str) -> RowOfMessage:
    """Return a function of a message -> its stamp ns, and the numbers of fields.

    Dividing the stamp by 1e9 restores the written float exactly.
    """
    get: Callable[[Any], tuple[Any, ...]] | None = None
    nested = False  # whether a field is an array

    def row(message: Any) -> tuple[float, ...]:
        nonlocal get, nested
        if get is None:
            leaves = [
                f"{field}.{part}".rstrip(".")
                for field in fields
                for part in _parts(attrgetter(field)(message)) or [""]
            ]
            get = attrgetter("header.stamp", *leaves)
            nested = any(map(np.ndim, get(message)[1:]))
        stamp, *numbers = get(message)
        if nested:
            numbers = np.hstack(numbers).tolist()
        return stamp.sec * 10**9 + stamp.nanosec, *numbers

    return row


_inertial_row = row_of("angular_velocity", "linear_acceleration")


def imu_row(message: Any) -> tuple[float, ...] | None:
    """Return stamp ns, rates (3) rad/s and specific force (3) m/s^2 of a sensor_msgs/Imu.

    None if one of both is not measured, as a covariance of -1 states (REP 145).
    """
    if -1.0 in (message.angular_velocity_covariance[0], message.linear_acceleration_covariance[0]):
        return None
    return _inertial_row(message)


def imu_content(imu: Imu) -> dict[str, Any]:
    """Return {field: (n, ...)} of sensor_msgs/Imu, without an orientation."""
    no_orientation = [[-1.0, *[0.0] * 8]]
    return {
        "orientation_covariance": np.repeat(no_orientation, len(imu), axis=0),
        "angular_velocity": imu.gyro,
        "linear_acceleration": imu.accel,
    }


def imu_of(stamps: np.ndarray, rows: np.ndarray) -> Imu:
    """Return the Imu of stamps (n,) s and rows (n, 6) of `imu_row` without the stamp."""
    return Imu(stamps, rows[:, 0:3], rows[:, 3:6])


def valid_of_sensor(sensor: Sensor, rows: np.ndarray) -> np.ndarray:
    """Return which numbers of rows (n, k) of a Sensor a recording may hold: (n, k) bool."""
    return np.column_stack(list(sensor.sound(sensor.split(rows)).values()))


def _parts(value: Any) -> list[str]:
    """Return the names of the fields of a message, in order; [] for a number or an array."""
    every = getattr(value, "__dataclass_fields__", ())
    return [name for name in every if not name.startswith("__")]


def tdoa_content(tdoa: Tdoas) -> dict[str, Any]:
    """Return {field: (n,)} of uwb_tdoa_msgs/Tdoa."""
    return {
        "anchor_a": tdoa.a,
        "anchor_b": tdoa.b,
        "distance_difference": tdoa.d,
        "variance": tdoa.variance,
    }


def tdoas_of(stamps: np.ndarray, rows: np.ndarray) -> Tdoas:
    """Return the Tdoas of stamps (n,) s and rows (n, 4): ids a and b, d_ab m, variance m^2."""
    return Tdoas(
        stamps, rows[:, 0].astype(np.int64), rows[:, 1].astype(np.int64), rows[:, 2], rows[:, 3]
    )


def pose_content(truth: Truth) -> dict[str, Any]:
    """Return {field: (n, ...)} of geometry_msgs/PoseStamped; an unknown quaternion is 0."""
    q_or_zero = np.where(np.isfinite(truth.q), truth.q, 0.0)
    return {"pose.position": truth.p, "pose.orientation": q_or_zero}


def truth_of(stamps: np.ndarray, rows: np.ndarray) -> Truth:
    """Return the Truth of stamps (n,) s and rows (n, 7): position m, quaternion x y z w.

    A quaternion of zeros is unknown.
    """
    q = rows[:, 3:7]
    return Truth(stamps, rows[:, 0:3], np.where((q == 0).all(axis=1, keepdims=True), np.nan, q))


def anchors_message(anchors: Anchors, stamp: int, store: Typestore) -> tuple[int, Any]:
    """Return (stamp ns, uwb_tdoa_msgs/AnchorArray)."""
    Anchor = store.types["uwb_tdoa_msgs/msg/Anchor"]
    q_or_zero = np.where(np.isfinite(anchors.orientations), anchors.orientations, 0.0)
    array = [
        Anchor(number, pose_of(store, p, q))
        for number, p, q in zip(
            anchors.ids.tolist(), anchors.positions.tolist(), q_or_zero.tolist()
        )
    ]
    return stamp, store.types["uwb_tdoa_msgs/msg/AnchorArray"](
        header_of(store, stamp, anchors.frame), array
    )


def anchor_transforms(
    anchors: Anchors, stamp: int, store: Typestore, antenna: Sequence[float] | None = None
) -> tuple[int, Any]:
    """Return (stamp ns, tf2_msgs/TFMessage) with frames anchor_<id> and the antenna.

    The antenna is at (3,) m in the body frame. An unknown orientation becomes the identity, because
    tf cannot express it.
    """
    q_or_identity = np.where(
        np.isfinite(anchors.orientations), anchors.orientations, [0.0, 0.0, 0.0, 1.0]
    )
    frames = [
        (anchors.frame, f"anchor_{number}", p, q)
        for number, p, q in zip(
            anchors.ids.tolist(), anchors.positions.tolist(), q_or_identity.tolist()
        )
    ]
    if antenna:
        frames.append((BODY_FRAME, ANTENNA_FRAME, antenna, (0.0, 0.0, 0.0, 1.0)))
    return _transforms(stamp, frames, store)


def tag_transforms(odometry: Odometry, frame: str, store: Typestore) -> Iterator[tuple[int, Any]]:
    """Yield (stamp ns, tf2_msgs/TFMessage) with the pose of the body in a frame."""
    for stamp, p, q in zip(nanoseconds("odometry", odometry.t), odometry.p, odometry.q):
        yield _transforms(int(stamp), [(frame, BODY_FRAME, p.tolist(), q.tolist())], store)


def _transforms(
    stamp: int,
    frames: Sequence[tuple[str, str, Sequence[float], Sequence[float]]],
    store: Typestore,
) -> tuple[int, Any]:
    """Return (stamp ns, tf2_msgs/TFMessage) of frames: (parent, child, position m, quaternion x y z w)."""
    types = store.types
    transforms = [
        types["geometry_msgs/msg/TransformStamped"](
            header_of(store, stamp, parent),
            child,
            types["geometry_msgs/msg/Transform"](
                types["geometry_msgs/msg/Vector3"](*p), types["geometry_msgs/msg/Quaternion"](*q)
            ),
        )
        for parent, child, p, q in frames
    ]
    return stamp, types["tf2_msgs/msg/TFMessage"](transforms)


def odometry_content(odometry: Odometry) -> dict[str, Any]:
    """Return {field: (n, ...)} of nav_msgs/Odometry; the twist is in the body frame, rates are unknown."""
    unknown = np.full((len(odometry), 3), np.nan)
    pose, twist = map(np.array, pose_and_twist(odometry, unknown, unknown))
    return {
        "child_frame_id": np.full(len(odometry), BODY_FRAME),
        "pose.pose.position": pose[:, :3],
        "pose.pose.orientation": pose[:, 3:7],
        "pose.covariance": pose[:, 7:],
        "twist.twist.linear": twist[:, :3],
        "twist.twist.angular": twist[:, 3:6],
        "twist.covariance": twist[:, 6:],
    }


# stamp, position, velocity in the child frame, quaternion, pose covariance (36) of nav_msgs/Odometry
odometry_row = row_of(
    "pose.pose.position", "twist.twist.linear", "pose.pose.orientation", "pose.covariance"
)


def header_of(store: Typestore, stamp: int, frame: str) -> Any:
    """Return a std_msgs/Header with a stamp in ns."""
    time = store.types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
    return store.types["std_msgs/msg/Header"](time, frame)


def pose_of(
    store: Typestore, p: Sequence[float] | np.ndarray, q: Sequence[float] = (0.0, 0.0, 0.0, 1.0)
) -> Any:
    """Return a geometry_msgs/Pose of p (3,) m and q x y z w."""
    types = store.types
    return types["geometry_msgs/msg/Pose"](
        types["geometry_msgs/msg/Point"](*p), types["geometry_msgs/msg/Quaternion"](*q)
    )


def _qos(durability: QosDurability, depth: int) -> Qos:
    """Return a reliable QoS.

    A reliable publisher serves reliable and best-effort subscriptions, and loses nothing.
    """
    endless = QosTime(9223372036, 854775807)
    return Qos(
        QosHistory.KEEP_LAST,
        depth,
        QosReliability.RELIABLE,
        durability,
        endless,
        endless,
        QosLiveliness.AUTOMATIC,
        endless,
        False,
    )


STREAM_QOS = _qos(QosDurability.VOLATILE, 1000)
LATCHED_QOS = _qos(QosDurability.TRANSIENT_LOCAL, 1)


class StreamKind(NamedTuple):
    """How a stream of a Flight is read from a bag, and written.

    Attributes
    ----------
    topic, message : our topic and its type.
    row : convert a message to numbers, see `row_of`.
    make : convert stamps s and rows to the stream.
    content : convert a stream to the fields of messages, see `messages_of`.
    valid : check which numbers of the rows are valid.
    """

    topic: str
    message: str
    row: RowOfMessage
    make: Callable[[np.ndarray, np.ndarray], Any]
    content: Callable[[Any], dict[str, Any]]
    valid: Callable[[np.ndarray], np.ndarray] = valid

    def messages(self, stream: Any, frame: str, store: Typestore) -> Iterator[tuple[int, Any]]:
        """Yield (stamp ns, message) of a stream in a frame."""
        content = self.content(stream)
        return messages_of(self.topic, self.message, stream.t, content, frame, store)


def of_sensor(sensor: Sensor) -> StreamKind:
    """Return the StreamKind of a Sensor."""
    return StreamKind(
        sensor.topics[0][0],
        sensor.message,
        row_of(*sensor.fields),
        lambda stamps, rows: sensor.read(stamps, sensor.split(rows)),
        sensor.content,
        partial(valid_of_sensor, sensor),
    )


STREAMS = {
    "tdoa": StreamKind(
        "uwb/tdoa",
        "uwb_tdoa_msgs/msg/Tdoa",
        row_of("anchor_a", "anchor_b", "distance_difference", "variance"),
        tdoas_of,
        tdoa_content,
    ),
    "imu": StreamKind(
        "imu/data",
        "sensor_msgs/msg/Imu",
        imu_row,
        imu_of,
        imu_content,
    ),
    **{name: of_sensor(sensor) for name, sensor in SENSORS.items()},
    "pose": StreamKind(
        "ground_truth/pose",
        "geometry_msgs/msg/PoseStamped",
        row_of("pose.position", "pose.orientation"),
        truth_of,
        pose_content,
    ),
}


def topics_of(name: str) -> tuple[tuple[str, str], ...]:
    """Return ((topic, type of its messages), ...) of a stream of a Flight, by our names."""
    return (
        SENSORS[name].topics if name in SENSORS else ((STREAMS[name].topic, STREAMS[name].message),)
    )


class Names:
    """Absolute names of our topics in a bag."""

    def __init__(self, namespace: str = "", topics: dict[str, str] | None = None) -> None:
        """Keep namespace and topics, see `read_bag`."""
        self._namespace, self._topics = namespace.strip("/"), topics or {}

    def __call__(self, topic: str) -> str:
        """Return the absolute name of a topic of this project, e.g. "uwb/tdoa"."""
        name = self._topics.get(topic, topic)
        absolute = name.startswith("/") or not self._namespace
        return f"/{name.strip('/')}" if absolute else f"/{self._namespace}/{name.strip('/')}"
