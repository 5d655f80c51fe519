# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Convert the arrays of a Flight to ROS messages of a rosbags typestore, and back.

`valid`, or `<stream>_valid`, returns which numbers of rows (n, k) can be used: (n, k) bool.
Unmeasured values follow the message definitions: an orientation of (0, 0, 0, 0), an
orientation_covariance[0] of -1, covariances of 0 for unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial, reduce
from operator import attrgetter
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
    make = _maker(store, kind)
    columns = {
        field: np.broadcast_to(values, (len(t), *np.shape(values)[1:]))
        for field, values in content.items()
    }
    for k, stamp in enumerate(nanoseconds(topic, t).tolist()):
        message = make()
        message.header = header_of(store, stamp, frame)
        for field, values in columns.items():
            *way, last = field.split(".")
            _set(reduce(getattr, way, message), last, values[k])
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
    return lambda: store.types[kind](*(make() for make in makers))


def _set(holder: object, name: str, value: np.ndarray) -> None:
    """Write a number, an array, or the numbers of a message (Vector3, Quaternion) to a field."""
    old = getattr(holder, name)
    parts = _parts(old)
    if parts:
        for part, number in zip(parts, value.tolist(), strict=True):
            setattr(old, part, number)
    else:
        setattr(holder, name, np.ascontiguousarray(value) if np.ndim(value) else value.item())


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
