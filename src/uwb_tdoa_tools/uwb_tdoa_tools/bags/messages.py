# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Convert the arrays of a Flight to ROS messages of a rosbags typestore, and back.

`valid`, or `<stream>_valid`, returns which numbers of rows (n, k) can be used: (n, k) bool.
Unmeasured values follow the message definitions: an orientation of (0, 0, 0, 0), an
orientation_covariance[0] of -1, covariances of 0 for unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import reduce
from typing import TYPE_CHECKING, Any

import numpy as np
from rosbags.interfaces import Nodetype

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Imu, Tdoas, Truth
from uwb_tdoa_bias.common.sensors import Sensor, Stream
from uwb_tdoa_bias.common.sensors.sensor import LARGEST_NUMBER
from uwb_tdoa_ekf.results import Odometry, pose_and_twist

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

    from uwb_tdoa_bias.common.anchors import Anchors

    # A message has no type here: rosbags makes the classes while it runs.
    RowOfMessage = Callable[[Any], tuple[float, ...] | None]
    StreamOfRows = Callable[[np.ndarray, np.ndarray], Stream]  # of stamps (n,) s and rows (n, k)
    Validity = Callable[[np.ndarray], np.ndarray]  # of rows (n, k): (n, k) bool

BODY_FRAME, ANTENNA_FRAME = "base_link", "uwb_antenna"


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


def stamp_of(header: Any) -> int:
    """Return the stamp of a header in ns.

    Dividing by 1e9 restores the written float exactly.
    """
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def valid(rows: np.ndarray) -> np.ndarray:
    """Return which numbers of rows (n, k) are finite and in range: (n, k) bool."""
    return np.abs(rows) <= LARGEST_NUMBER  # NaN is not


def imu_messages(imu: Imu, store: Typestore) -> Iterator[tuple[int, Any]]:
    """Yield (stamp ns, sensor_msgs/Imu)."""
    Message, Vector3 = store.types["sensor_msgs/msg/Imu"], store.types["geometry_msgs/msg/Vector3"]
    no_orientation = store.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 0.0)
    unknown, none = np.zeros(9), np.zeros(9)
    none[0] = -1.0
    for stamp, rate, force in zip(
        nanoseconds("imu", imu.t).tolist(), imu.gyro.tolist(), imu.accel.tolist()
    ):
        header = header_of(store, stamp, BODY_FRAME)
        yield (
            stamp,
            Message(
                header, no_orientation, none, Vector3(*rate), unknown, Vector3(*force), unknown
            ),
        )


def imu_row(message: Any) -> tuple[float, ...] | None:
    """Return stamp ns, rates (3) rad/s and specific force (3) m/s^2 of a sensor_msgs/Imu.

    None if one of both is not measured, as a covariance of -1 states (REP 145).
    """
    rate, force = message.angular_velocity, message.linear_acceleration
    if -1.0 in (message.angular_velocity_covariance[0], message.linear_acceleration_covariance[0]):
        return None
    return stamp_of(message.header), rate.x, rate.y, rate.z, force.x, force.y, force.z


def imu_of(stamps: np.ndarray, rows: np.ndarray) -> Imu:
    """Return the Imu of stamps (n,) s and rows (n, 6) of `imu_row` without the stamp."""
    return Imu(stamps, rows[:, 0:3], rows[:, 3:6])


def sensor_messages(
    sensor: Sensor, stream: Stream, store: Typestore, antenna: Sequence[float] | None = None
) -> Iterator[tuple[int, Any]]:
    """Yield (stamp ns, message) of the Stream of a Sensor; other fields are 0.

    `antenna` is its position in the body frame, for ranges, see `transforms_message`.
    """
    frame = ANTENNA_FRAME if antenna and sensor.locates else BODY_FRAME
    content = {
        field: np.broadcast_to(values, (len(stream), *np.shape(values)[1:]))
        for field, values in sensor.content(stream).items()
    }
    for k, stamp in enumerate(nanoseconds(sensor.name, stream.t).tolist()):
        message = _blank(store, sensor.message)
        message.header = header_of(store, stamp, frame)
        for field, values in content.items():
            *way, last = field.split(".")
            _set(reduce(getattr, way, message), last, values[k])
        yield stamp, message


def _blank(store: Typestore, kind: str) -> Any:
    """Return a message of a type with all fields 0."""
    values: dict[str, Any] = {}
    fields: Any = store.get_msgdef(kind).fields  # nested, as each Nodetype says
    for name, (node, what) in fields:
        if node == Nodetype.NAME:
            values[name] = _blank(store, what)
        elif node == Nodetype.BASE:
            values[name] = "" if what[0] == "string" else 0
        else:
            values[name] = np.zeros(what[1])
    return store.types[kind](**values)


def _set(holder: object, name: str, value: np.ndarray) -> None:
    """Write a number, an array, or the numbers of a message (Vector3, Quaternion) to a field."""
    old = getattr(holder, name)
    parts = _parts(old)
    if parts:
        for part, number in zip(parts, value.tolist(), strict=True):
            setattr(old, part, number)
    else:
        setattr(holder, name, np.ascontiguousarray(value) if np.ndim(value) else value.item())


def of_sensor(sensor: Sensor) -> tuple[RowOfMessage, StreamOfRows, Validity]:
    """Return how to read a Sensor: (row of a message, Stream of stamps and rows, valid numbers)."""

    def row(message: Any) -> tuple[float, ...]:
        return stamp_of(message.header), *(
            number
            for field in sensor.fields
            for number in _numbers(reduce(getattr, field.split("."), message))
        )

    def valid_numbers(rows: np.ndarray) -> np.ndarray:
        return np.column_stack(list(sensor.sound(sensor.split(rows)).values()))

    return row, lambda stamps, rows: sensor.read(stamps, sensor.split(rows)), valid_numbers


def _numbers(value: Any) -> list[float]:
    """Return the numbers of a field that is a number, an array, or a message of numbers."""
    parts = _parts(value)
    numbers: list[float] = (
        [getattr(value, part) for part in parts] if parts else np.ravel(value).tolist()
    )
    return numbers


def _parts(value: Any) -> list[str]:
    """Return the names of the fields of a message, in order; [] for a number or an array."""
    every = getattr(value, "__dataclass_fields__", ())
    return [name for name in every if not name.startswith("__")]


def tdoa_messages(
    tdoa: Tdoas, store: Typestore, antenna: Sequence[float] | None = None
) -> Iterator[tuple[int, Any]]:
    """Yield (stamp ns, uwb_tdoa_msgs/Tdoa).

    `antenna` is its position in the body frame, see `transforms_message`.
    """
    Message, frame = store.types["uwb_tdoa_msgs/msg/Tdoa"], ANTENNA_FRAME if antenna else BODY_FRAME
    columns = (nanoseconds("tdoa", tdoa.t), tdoa.a, tdoa.b, tdoa.d, tdoa.variance)
    for stamp, *values in zip(*(column.tolist() for column in columns)):
        yield stamp, Message(header_of(store, stamp, frame), *values)


def tdoa_row(message: Any) -> tuple[float, ...]:
    """Return stamp ns, ids a and b, d_ab m, and variance m^2 of a uwb_tdoa_msgs/Tdoa."""
    return (
        stamp_of(message.header),
        message.anchor_a,
        message.anchor_b,
        message.distance_difference,
        message.variance,
    )


def tdoas_of(stamps: np.ndarray, rows: np.ndarray) -> Tdoas:
    """Return the Tdoas of stamps (n,) s and rows (n, 4) of `tdoa_row` without the stamp."""
    return Tdoas(
        stamps, rows[:, 0].astype(np.int64), rows[:, 1].astype(np.int64), rows[:, 2], rows[:, 3]
    )


def pose_messages(truth: Truth, frame: str, store: Typestore) -> Iterator[tuple[int, Any]]:
    """Yield (stamp ns, geometry_msgs/PoseStamped)."""
    Message = store.types["geometry_msgs/msg/PoseStamped"]
    q_or_zero = np.where(np.isfinite(truth.q), truth.q, 0.0)
    for stamp, p, q in zip(
        nanoseconds("truth", truth.t).tolist(), truth.p.tolist(), q_or_zero.tolist()
    ):
        yield stamp, Message(header_of(store, stamp, frame), pose_of(store, p, q))


def pose_row(message: Any) -> tuple[float, ...]:
    """Return stamp ns, position (3) m, and quaternion x y z w of a geometry_msgs/PoseStamped."""
    return (
        stamp_of(message.header),
        *_point(message.pose.position),
        *_quaternion(message.pose.orientation),
    )


def truth_of(stamps: np.ndarray, rows: np.ndarray) -> Truth:
    """Return the Truth of stamps (n,) s and rows (n, 7) of `pose_row` without the stamp.

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


def transforms_message(
    anchors: Anchors, stamp: int, store: Typestore, antenna: Sequence[float] | None = None
) -> tuple[int, Any]:
    """Return (stamp ns, tf2_msgs/TFMessage) with frames anchor_<id> and the antenna.

    The antenna is at (3,) m in the body frame. An unknown orientation becomes the identity, because
    tf cannot express it.
    """
    types = store.types
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


def odometry_messages(
    odometry: Odometry, frame: str, store: Typestore
) -> Iterator[tuple[int, Any]]:
    """Yield (stamp ns, nav_msgs/Odometry); the twist is in the body frame, rates are unknown."""
    types = store.types
    Message, Vector3 = types["nav_msgs/msg/Odometry"], types["geometry_msgs/msg/Vector3"]
    Pose, Twist = (
        types["geometry_msgs/msg/PoseWithCovariance"],
        types["geometry_msgs/msg/TwistWithCovariance"],
    )
    n = len(odometry)
    unknown = np.full((n, 3), np.nan)
    numbers = pose_and_twist(odometry, unknown, unknown)
    for stamp, of_pose, of_twist in zip(nanoseconds("odometry", odometry.t).tolist(), *numbers):
        twist = types["geometry_msgs/msg/Twist"](Vector3(*of_twist[:3]), Vector3(*of_twist[3:6]))
        pose = Pose(pose_of(store, of_pose[:3], of_pose[3:7]), of_pose[7:])
        yield (
            stamp,
            Message(header_of(store, stamp, frame), BODY_FRAME, pose, Twist(twist, of_twist[6:])),
        )


def odometry_row(message: Any) -> tuple[float, ...]:
    """Return stamp, position, velocity in the child frame, quaternion, pose covariance (36)."""
    return (
        stamp_of(message.header),
        *_point(message.pose.pose.position),
        *_point(message.twist.twist.linear),
        *_quaternion(message.pose.pose.orientation),
        *message.pose.covariance.tolist(),
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


def _point(v: Any) -> tuple[float, float, float]:
    return v.x, v.y, v.z


def _quaternion(q: Any) -> tuple[float, float, float, float]:
    return q.x, q.y, q.z, q.w
