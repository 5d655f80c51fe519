# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Topics of a bag: names, types, QoS, messages as arrays; places of sensors and anchors.

Sensors outside of the body frame are transformed as in the nodes.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
import re
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.typesys.store import Typestore

from uwb_tdoa_bias.common.anchors import Anchors, refuse_faulty
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Imu
from uwb_tdoa_bias.common.sensors import SENSORS, Sensor
from uwb_tdoa_bias.common.transforms import Frames, Place
from uwb_tdoa_ekf.frames import ImuMount

from ..clock import Straightened, straightened
from ..command_lines import suggest_line
from . import messages as bag_messages
from .files import BagReader, connections_of, readable
from .messages import BODY_FRAME, check_type

TF_STATIC = "/tf_static"
ANCHORS, TRANSFORMS, MARKERS = (
    "uwb_tdoa_msgs/msg/AnchorArray",
    "tf2_msgs/msg/TFMessage",
    "visualization_msgs/msg/MarkerArray",
)
FEWEST = 4  # frames or markers that are taken for anchors
TEXT, ADD = 9, 0  # of Marker: the type of labels, and the action
_FRAME = re.compile(r"^(?:.*[/_])?(?:anchor|anc|beacon)[_-]?([0-9]{1,5})$", re.IGNORECASE)


def is_body(frame: str) -> bool:
    """Return whether a frame_id is the body frame of any robot; an empty one counts as body."""
    return frame.rpartition("/")[2] in (BODY_FRAME, "")


def _static_transforms(
    path: str | Path, reader: BagReader, topic: str = TF_STATIC
) -> Iterator[Any]:
    """Yield the transforms on /tf_static, or another topic, of an open bag. Raise InputError."""
    connections = [
        one for one in reader.connections if one.topic == topic and one.msgtype == TRANSFORMS
    ]
    for connection in connections:
        check_type(path, connection)
    for _, _, message in readable(reader, connections):
        yield from message.transforms


def read_frames(path: str | Path, reader: BagReader, name_of: Callable[[str], str]) -> Frames:
    """Read the Frames of /tf_static, then of tf_static in the namespace, of an open bag.

    name_of : Names of the topics. Raises InputError.
    """
    frames = Frames()
    topics = dict.fromkeys((TF_STATIC, name_of("tf_static")))
    for each in chain(*(_static_transforms(path, reader, topic) for topic in topics)):
        q, p = each.transform.rotation, each.transform.translation
        q, p = (q.x, q.y, q.z, q.w), (p.x, p.y, p.z)
        if any(q) and np.isfinite([*q, *p]).all():
            frames.set(each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/"), q, p)
    return frames


def place_in_body(frames: Frames, frame: str) -> Place | None:
    """Return (Rotation, arm (3,) m) of a sensor's frame in the body; None if unknown.

    The body belongs to the same robot, or is the only body frame.
    """
    robot = frame.lstrip("/").rpartition("/")[0]
    for body in ([f"{robot}/{BODY_FRAME}"] if robot else []) + [BODY_FRAME]:
        if place := frames.between(body, frame.lstrip("/")):
            return place
    return None


def imu_in_body(imu: Imu, place: Place) -> Imu:
    """Transform samples of an IMU at a place, see `place_in_body`, to the origin of the body."""
    return Imu(imu.t, *ImuMount(*place).in_body(imu.t, imu.gyro, imu.accel))


def sensor_place(
    frames: Frames, topic: str, counts: Counter[str]
) -> tuple[Place | None, str | None]:
    """Return (place or None, remark or None) of the single frame in the messages of a topic.

    `counts` is {frame_id: messages}. A place changes the result, so it has a remark too.
    """
    others = sorted(frame for frame in counts if not is_body(frame))
    if not others:
        return None, None
    if len(counts) > 1:
        return (
            None,
            (
                f"{topic} comes in several frames ({', '.join(sorted(counts))}): taken as "
                f"{BODY_FRAME}."
            ),
        )
    place = place_in_body(frames, others[0])
    if place is None:
        return (
            None,
            (
                f"{topic} is in frame '{others[0]}', which {TF_STATIC} does not connect with "
                f"'{BODY_FRAME}': taken as that."
            ),
        )
    at = ", ".join(f"{value:.3f}" for value in place[1])
    return (
        place,
        (
            f"{topic} is taken from frame '{others[0]}', which {TF_STATIC} places at ({at}) m in "
            f"'{BODY_FRAME}'."
        ),
    )


class Recorded(NamedTuple):
    """Anchors in a bag, and the topic that they come from."""

    anchors: Anchors
    source: str

    def remarks(self, topic: str) -> list[str]:
        """Return a sentence on the source of the anchors if it is not this topic."""
        return (
            []
            if self.source == topic
            else [
                f"there is no {topic}: the {len(self.anchors)} anchors are those of {self.source}."
            ]
        )


def surveyed(path: str | Path, recorded: Recorded | None, topic: str) -> Recorded:
    """Return the anchors of a bag. Raise InputError without any, and for faulty ones."""
    if recorded is None:
        raise InputError(f"{path}: has no message on {topic}; give a survey file (--survey FILE).")
    refuse_faulty(recorded.anchors, f"{path}: {recorded.source}")
    return recorded


def recorded_anchors(path: str | Path, reader: BagReader, topic: str) -> Recorded | None:
    """Return the last Anchors of an open bag, or None.

    They are on `topic`, else in frames, else in markers. Frames count if their names are "anchor",
    or similar, and a number, and if they have one parent. Markers count if their topic or namespace
    contains "anchor"; the marker ids become anchor ids. Raises InputError.
    """
    last = None
    for _, _, last in readable(reader, connections_of(path, reader, topic, ANCHORS)):
        pass
    if last is None:
        return _of_frames(path, reader) or _of_markers(path, reader)
    try:
        return Recorded(Anchors.from_message(last), topic)
    except InputError as error:
        raise InputError(f"{path}: {topic}: {error}") from error


def _of_frames(path: str | Path, reader: BagReader) -> Recorded | None:
    by_parent: dict[str, dict[int, list[float]]] = defaultdict(dict)
    for each in _static_transforms(path, reader):
        if found := _FRAME.match(each.child_frame_id):
            p, q = each.transform.translation, each.transform.rotation
            # drivers without orientations write the identity
            turn = [q.x, q.y, q.z, q.w] if abs(q.w) < 1.0 else [np.nan] * 4
            by_parent[each.header.frame_id][int(found[1])] = [p.x, p.y, p.z, *turn]
    return _recorded(path, TF_STATIC, by_parent)


def _of_markers(path: str | Path, reader: BagReader) -> Recorded | None:
    for connection in [one for one in reader.connections if one.msgtype == MARKERS]:
        check_type(path, connection)
        by_frame: dict[str, dict[int, list[float]]] = defaultdict(dict)
        for _, _, message in readable(reader, [connection]):
            for marker in message.markers:
                if (
                    marker.action == ADD
                    and marker.type != TEXT
                    and "anchor" in f"{connection.topic} {marker.ns}".lower()
                ):
                    p = marker.pose.position
                    by_frame[marker.header.frame_id][int(marker.id)] = [
                        p.x,
                        p.y,
                        p.z,
                        *[np.nan] * 4,
                    ]
        if found := _recorded(path, connection.topic, by_frame):
            return found
    return None


def _recorded(
    path: str | Path, source: str, by_frame: dict[str, dict[int, list[float]]]
) -> Recorded | None:
    """Return the anchors of {frame: {id: position and quaternion}}; None unless one frame has enough."""
    frames = [(frame, rows) for frame, rows in by_frame.items() if len(rows) >= FEWEST]
    if len(frames) != 1:
        return None
    frame, rows = frames[0]
    table = np.array(list(rows.values()))
    try:
        return Recorded(
            Anchors(np.array(list(rows)), table[:, :3], table[:, 3:], frame.lstrip("/") or "map"),
            source,
        )
    except InputError as error:
        raise InputError(f"{path}: {source}: {error}") from error


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
    row : convert a message to numbers, see `read_topic`.
    make : convert stamps s and rows to the stream.
    content : convert a stream to the fields of messages, see `messages.messages_of`.
    valid : check which numbers of the rows are valid.
    """

    topic: str
    message: str
    row: bag_messages.RowOfMessage
    make: Callable[[np.ndarray, np.ndarray], Any]
    content: Callable[[Any], dict[str, Any]]
    valid: Callable[[np.ndarray], np.ndarray] = bag_messages.valid

    def messages(self, stream: Any, frame: str, store: Typestore) -> Iterator[tuple[int, Any]]:
        """Yield (stamp ns, message) of a stream in a frame."""
        content = self.content(stream)
        return bag_messages.messages_of(self.topic, self.message, stream.t, content, frame, store)


def of_sensor(sensor: Sensor) -> StreamKind:
    """Return the StreamKind of a Sensor."""
    return StreamKind(
        sensor.topics[0][0],
        sensor.message,
        bag_messages.row_of(*sensor.fields),
        lambda stamps, rows: sensor.read(stamps, sensor.split(rows)),
        sensor.content,
        partial(bag_messages.valid_of_sensor, sensor),
    )


STREAMS = {
    "tdoa": StreamKind(
        "uwb/tdoa",
        "uwb_tdoa_msgs/msg/Tdoa",
        bag_messages.row_of("anchor_a", "anchor_b", "distance_difference", "variance"),
        bag_messages.tdoas_of,
        bag_messages.tdoa_content,
    ),
    "imu": StreamKind(
        "imu/data",
        "sensor_msgs/msg/Imu",
        bag_messages.imu_row,
        bag_messages.imu_of,
        bag_messages.imu_content,
    ),
    **{name: of_sensor(sensor) for name, sensor in SENSORS.items()},
    "pose": StreamKind(
        "ground_truth/pose",
        "geometry_msgs/msg/PoseStamped",
        bag_messages.row_of("pose.position", "pose.orientation"),
        bag_messages.truth_of,
        bag_messages.pose_content,
    ),
}


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


@dataclass(frozen=True)
class TopicMessages:
    """Messages of a topic in the order of the bag.

    Attributes
    ----------
    stamps, arrived : (n,) int ns, of the headers and of the recording.
    rows : (n, k), further numbers of each message.
    frames : {frame_id: messages}; of Odometry the frames of the twist.
    remarks : sentences on what was left out or assumed.
    """

    stamps: np.ndarray
    arrived: np.ndarray
    rows: np.ndarray
    frames: Counter[str]
    remarks: tuple[str, ...] = ()

    def in_order(self) -> tuple[np.ndarray, np.ndarray, int]:
        """Return (stamps (n,) s, rows (n, k)) in order of the stamps, and how often they fall."""
        order = np.argsort(self.stamps, kind="stable")
        return self.stamps[order] / 1e9, self.rows[order], int((np.diff(self.stamps) < 0).sum())


class BagStreams(NamedTuple):
    """Streams of a bag in the order of arrival, on one continuous time, without outliers.

    Attributes
    ----------
    found : {stream: TopicMessages}.
    arrivals : {stream: (n,) s, times of recording}; NaN if they equal the stamps.
    clock : changes of the stamps.
    frames : Frames of the bag.
    """

    found: dict[str, TopicMessages]
    arrivals: dict[str, np.ndarray]
    clock: Straightened
    frames: Frames


def read_streams(
    path: str | Path, reader: BagReader, name_of: Names, names: Iterable[str] = STREAMS
) -> BagStreams:
    """Read the named STREAMS of an open bag. Raises InputError."""
    frames = read_frames(path, reader, name_of)
    found = {name: read_stream(path, reader, name, name_of, frames) for name in names}
    known = any(bool((of.stamps != of.arrived).any()) for of in found.values())
    arrivals = {
        name: of.arrived / 1e9 if known else np.full(len(of.arrived), np.nan)
        for name, of in found.items()
    }
    clock = straightened({name: of.stamps / 1e9 for name, of in found.items()}, arrivals)
    for name in {*clock.shifts, *clock.kept}:
        of, kept = found[name], clock.kept.get(name, slice(None))
        stamps = of.stamps + np.round(1e9 * clock.shifts.get(name, np.zeros(1))).astype(np.int64)
        found[name] = replace(of, stamps=stamps[kept], arrived=of.arrived[kept], rows=of.rows[kept])
        arrivals[name] = arrivals[name][kept]
    return BagStreams(found, arrivals, clock, frames)


def read_topic(
    path: str | Path,
    reader: BagReader,
    topic: str,
    msgtype: str,
    row: bag_messages.RowOfMessage,
) -> TopicMessages:
    """Read the messages of a topic; empty if the topic does not exist.

    `row(message)` returns the stamp, ns, and k further numbers, or None without a measurement. Raises InputError for another type
    than `msgtype`.
    """
    arrived, rows, frames = [], [], Counter[str]()
    for _, received, message in readable(reader, connections_of(path, reader, topic, msgtype)):
        frames[getattr(message, "child_frame_id", message.header.frame_id)] += 1
        if (values := row(message)) is not None:
            arrived.append(received)
            rows.append(values)
    stamps, table = (
        np.array([values[0] for values in rows], dtype=np.int64),
        np.array([values[1:] for values in rows], dtype=float),
    )
    remarks: tuple[str, ...] = ()
    if left_out := sum(frames.values()) - len(rows):
        remarks = (
            f"{topic}: {left_out} messages left out: their covariance of -1 means unmeasured.",
        )
    return TopicMessages(stamps, np.array(arrived, dtype=np.int64), table, frames, remarks)


def topics_of(name: str) -> tuple[tuple[str, str], ...]:
    """Return ((topic, type of its messages), ...) of a stream of a Flight, by our names."""
    return (
        SENSORS[name].topics if name in SENSORS else ((STREAMS[name].topic, STREAMS[name].message),)
    )


def read_stream(
    path: str | Path, reader: BagReader, name: str, name_of: Names, tree: Frames
) -> TopicMessages:
    """Read all topics of a stream as a node receives them: in order of arrival, in the body frame.

    Raises InputError as `read_topic`.
    """
    topics, row, sensor = topics_of(name), STREAMS[name].row, SENSORS.get(name)
    parts = [read_topic(path, reader, name_of(topic), kind, row) for topic, kind in topics]
    if sensor is not None and sensor.in_body is not None:
        parts = [
            _in_body(part, sensor, name_of(topic), tree) for part, (topic, _) in zip(parts, topics)
        ]
    filled = [part for part in parts if len(part.stamps)]
    if len(filled) < 2:
        return filled[0] if filled else parts[0]
    order = np.argsort(np.concatenate([part.arrived for part in filled]), kind="stable")
    stamps, arrived, rows = (
        np.concatenate([getattr(part, name) for part in filled])[order]
        for name in ("stamps", "arrived", "rows")
    )
    frames = sum((part.frames for part in filled), Counter[str]())
    remarks = tuple(remark for part in filled for remark in part.remarks)
    return TopicMessages(stamps, arrived, rows, frames, remarks)


def _in_body(part: TopicMessages, sensor: Sensor, topic: str, tree: Frames) -> TopicMessages:
    """Return the messages of a Sensor in the body frame, with a remark on the frame."""
    place, remark = sensor_place(tree, topic, part.frames)
    if remark is not None:
        part = replace(part, remarks=(*part.remarks, remark))
    if place is None or sensor.in_body is None:
        return part
    turned = sensor.in_body(sensor.split(part.rows), *place)
    return replace(part, rows=np.column_stack([turned[field] for field in sensor.fields]))


def other_namespaces(path: str | Path, reader: BagReader, namespace: str) -> str:
    """Return a remedy for an error message: the namespace with such a topic, or a profile."""
    places = sorted(
        {
            one.topic.removesuffix("/uwb/tdoa")
            for one in reader.connections
            if one.topic.endswith("/uwb/tdoa")
        }
    )
    places = [place for place in places if place.strip("/") != namespace.strip("/")]
    if places:
        return (
            f"give the namespace it was recorded in: {', '.join(place or '/' for place in places)}"
        )
    return f"a recording of others needs a profile, which this line names: {suggest_line(path)}"
