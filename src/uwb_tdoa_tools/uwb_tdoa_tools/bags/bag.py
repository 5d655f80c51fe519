# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Flights to and from ROS 2 bags (mcap or sqlite3), with the topics that the nodes use.

Topic (in a bag always absolute)   type                              what
/imu/data                          sensor_msgs/msg/Imu               Flight.imu, frame base_link
/uwb/tdoa                          uwb_tdoa_msgs/msg/Tdoa            Flight.tdoa
/uwb/anchors                       uwb_tdoa_msgs/msg/AnchorArray     Flight.anchors, once, transient local
/height, /pressure, ...            those of SENSORS                  Flight.height, Flight.pressure, ..., frame base_link
/velocity/odometry, ...            others of SENSORS                 read into the same stream; not written
/ground_truth/pose                 geometry_msgs/msg/PoseStamped     Flight.truth
/tf_static                         tf2_msgs/msg/TFMessage            frames anchor_<id>, once, transient local; of sensors, if there are

The time of a message is its header stamp. `Flight.extra` has no message type and stays behind.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
import heapq
from itertools import chain
import json
from pathlib import Path
import re
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import Writer
from rosbags.typesys.store import Typestore
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors, refuse_faulty
from uwb_tdoa_bias.common.arrays import Stamped
from uwb_tdoa_bias.common.errors import InputError, printable, written_by
from uwb_tdoa_bias.common.flight import Flight, Imu
from uwb_tdoa_bias.common.sensors import LOCATING, SENSORS, Sensor
from uwb_tdoa_bias.common.sensors.sensor import LARGEST_NUMBER
from uwb_tdoa_bias.common.transforms import Frames, Place
from uwb_tdoa_ekf.frames import ImuMount
from uwb_tdoa_ekf.results import Odometry

from ..clock import Straightened, sentences, straightened
from ..command_lines import suggest_line
from . import messages as bag_messages
from .files import BagReader, check_output, connections_of, new_bag, open_bag, readable, remarks_of
from .messages import (
    BODY_FRAME,
    LATCHED_QOS,
    STREAM_QOS,
    STREAMS,
    Names,
    check_type,
    is_body,
    topics_of,
    typestore,
)

TF_STATIC = "/tf_static"
ANCHORS, TRANSFORMS, MARKERS = (
    "uwb_tdoa_msgs/msg/AnchorArray",
    "tf2_msgs/msg/TFMessage",
    "visualization_msgs/msg/MarkerArray",
)
FEWEST = 4  # frames or markers that are taken for anchors
TEXT, ADD = 9, 0  # of Marker: the type of labels, and the action
_FRAME = re.compile(r"^(?:.*[/_])?(?:anchor|anc|beacon)[_-]?([0-9]{1,5})$", re.IGNORECASE)
# {topic: (type, QoS, (stamp ns, message) in order)}
Topics = dict[str, tuple[str, Qos, Iterable[tuple[int, Any]]]]

__all__ = [
    "RecordedOdometry",
    "check_output",
    "late_tdoas",
    "read_bag",
    "read_odometry",
    "write_bag",
    "write_odometry",
]

_FLIGHT_KEY = "uwb_tdoa_tools.flight"  # custom data of the bag: name and meta, as JSON
_PRINTED = ("source", "format", "protocol")  # texts of this meta that are only printed


@dataclass(frozen=True)
class RecordedOdometry(Stamped):
    """Recorded estimates, with world and body frame as in nav_msgs/Odometry.

    Attributes
    ----------
    t : (n,) s, header stamps.
    p, v : (n, 3) m and m/s, world frame.
    q : (n, 4) x y z w, body to world.
    covariance : (n, 6, 6) m^2 and rad^2, of position (world) and rotation.
    remarks : sentences on missing data.
    """

    t: np.ndarray
    p: np.ndarray
    v: np.ndarray
    q: np.ndarray
    covariance: np.ndarray
    remarks: tuple[str, ...] = ()


def write_bag(
    flight: Flight, out: str | Path, storage: str = "mcap", force: bool = False
) -> dict[str, int]:
    """Write a Flight as a ROS 2 bag and return {topic: number of messages}.

    Parameters
    ----------
    out : path of the new bag, a directory. It appears when it is complete. An existing path is
        refused; with `force` an existing bag is replaced.
    storage : "mcap" or "sqlite3".

    Raises InputError, also for stamps that a ROS message cannot hold.
    """
    store = typestore()
    present = {
        name: stream
        for name in ("imu", *SENSORS, "tdoa", "pose")
        if (stream := getattr(flight, "truth" if name == "pose" else name)) is not None
    }
    starts = [
        bag_messages.nanoseconds(name, stream.t[:1])[0]
        for name, stream in present.items()
        if len(stream)
    ]
    if not starts:
        raise InputError(f"{flight.name}: holds no message; there is nothing to write.")
    antenna = flight.meta.get("antenna")
    topics = _of_anchors(flight.anchors, int(min(starts)), store, antenna)
    of_radio = bag_messages.ANTENNA_FRAME if antenna else bag_messages.BODY_FRAME
    frame_of = dict.fromkeys(("tdoa", *LOCATING), of_radio) | {"pose": flight.anchors.frame}
    for name, stream in present.items():
        kind, frame = STREAMS[name], frame_of.get(name, bag_messages.BODY_FRAME)
        topics[f"/{kind.topic}"] = kind.message, STREAM_QOS, kind.messages(stream, frame, store)

    about = {"name": flight.name, "meta": flight.meta, "written_by": written_by()}
    with new_bag(out, storage, force) as writer:
        writer.set_custom_data(_FLIGHT_KEY, json.dumps(about, default=str))
        return _write(writer, topics, store)


def write_odometry(
    odometry: Odometry, anchors: Anchors, out: str | Path, force: bool = False
) -> dict[str, int]:
    """Write an Odometry among Anchors as a bag, see `write_bag`.

    Its topics are odometry, /tf, uwb/anchors and /tf_static.
    """
    store = typestore()
    if not len(odometry):
        raise InputError(f"{out}: there is no odometry to write.")
    topics = _of_anchors(
        anchors, int(bag_messages.nanoseconds("odometry", odometry.t[:1])[0]), store
    )
    kind, content = "nav_msgs/msg/Odometry", bag_messages.odometry_content(odometry)
    made = bag_messages.messages_of("odometry", kind, odometry.t, content, anchors.frame, store)
    topics["/odometry"] = kind, STREAM_QOS, made
    poses = bag_messages.tag_transforms(odometry, anchors.frame, store)
    topics["/tf"] = TRANSFORMS, STREAM_QOS, poses
    with new_bag(out, "mcap", force) as writer:
        return _write(writer, topics, store)


def _of_anchors(
    anchors: Anchors, first: int, store: Typestore, antenna: Sequence[float] | None = None
) -> Topics:
    """Return {topic: (type, QoS, [(stamp ns, message)])} of Anchors, the first topics of a bag.

    `first` is the first stamp, ns. `antenna` is its position in the body frame, (3,) m.
    """
    # at equal stamps the order of the topics holds: anchors first
    array = bag_messages.anchors_message(anchors, first, store)
    frames = bag_messages.anchor_transforms(anchors, first, store, antenna)
    return {
        "/uwb/anchors": ("uwb_tdoa_msgs/msg/AnchorArray", LATCHED_QOS, [array]),
        TF_STATIC: (TRANSFORMS, LATCHED_QOS, [frames]),
    }


def _write(writer: Writer, topics: Topics, store: Typestore) -> dict[str, int]:
    """Write {topic: (type, QoS, (stamp ns, message) in order)} to an open bag, in order of stamps.

    Returns {topic: number of messages}.
    """
    counts, streams = dict.fromkeys(topics, 0), []
    for topic, (msgtype, qos, outgoing) in topics.items():
        connection = writer.add_connection(
            topic, msgtype, typestore=store, offered_qos_profiles=[qos]
        )
        streams.append(_serialized(connection, outgoing, store))
    for stamp, connection, data in heapq.merge(*streams, key=lambda message: message[0]):
        writer.write(connection, stamp, data)
        counts[connection.topic] += 1
    return counts


def _serialized(
    connection: Connection, outgoing: Iterable[tuple[int, Any]], store: Typestore
) -> Iterator[tuple[int, Connection, memoryview]]:
    for stamp, message in outgoing:
        yield stamp, connection, store.serialize_cdr(message, connection.msgtype)


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


def read_bag(
    path: str | Path,
    namespace: str = "",
    anchors: Anchors | None = None,
    salvage: bool = False,
    topics: dict[str, str] | None = None,
    truth: bool = True,
) -> Flight:
    """Read the Flight in a bag from `ros2 bag record` or from these tools.

    Other topics are ignored. Stamps are header stamps on a continuous time (`meta["clock"]`: [Jump] and {stream: outliers},
    see `clock.straightened`). Messages are sorted by stamp (`meta["reordered"]`). IMU samples and velocities
    are transformed to the body frame with /tf_static and that of the namespace. `meta["antenna"]` is the position of the antenna
    in the body, (3,) m. `meta["unread"]` has sentences on other topics.

    Parameters
    ----------
    namespace : of the tag's topics, e.g. "tag1" for /tag1/uwb/tdoa.
    topics : {our name of a topic: its name in the bag}, e.g. {"uwb/tdoa": "/my/tdoa"}. Relative
        names are in the namespace.
    anchors : Anchors to use instead of the recorded uwb/anchors, or None.
    salvage : leave out invalid messages; see `meta["remarks"]`.
    truth : read ground_truth/pose, if it exists.

    A bag is read up to where it is cut, see `meta["remarks"]`. Raises InputError without uwb/tdoa,
    without any anchors, and for numbers that are not finite.
    """
    name_of, streams = Names(namespace, topics), dict[str, Any]()
    of_anchors = name_of("uwb/anchors")
    with open_bag(path) as reader:
        about = _about(path, reader.custom)
        meta = {**about["meta"], "bag": str(path)}
        names = [name for name in STREAMS if truth or name != "pose"]
        bag = read_streams(path, reader, name_of, names)
        if bag.clock.jumps or bag.clock.kept:
            meta["clock"] = bag.clock.jumps, bag.clock.outliers
        remarks = [remark for of in bag.found.values() for remark in of.remarks]
        remarks += sentences(bag.clock)
        for name in names:
            kind = STREAMS[name]
            stamps, rows, falls = bag.found[name].in_order()
            if falls:
                meta.setdefault("reordered", {})[kind.topic] = falls
            whole = kind.valid(rows).all(axis=1) if len(rows) else np.zeros(0, bool)
            if not whole.all():
                if not salvage:
                    listed = " and ".join(name_of(topic) for topic, _ in topics_of(name))
                    raise _not_finite(path, listed, stamps, rows, kind.valid)
                left_out = np.count_nonzero(~whole)
                remarks.append(f"{kind.topic}: {left_out} messages left out, they are no numbers.")
            if whole.any():
                streams[name] = kind.make(stamps[whole], rows[whole])
        radio = [name for name in ("tdoa", *LOCATING) if name in streams]
        if not radio:
            count = reader.unreadable[name_of("uwb/tdoa")]
            why = (
                f"{count} that are there cannot be read"
                if count
                else other_namespaces(path, reader, namespace)
            )
            raise InputError(f"{path}: has no message on {name_of('uwb/tdoa')}; {why}.")
        if anchors is None:
            recorded = surveyed(path, recorded_anchors(path, reader, of_anchors), of_anchors)
            anchors = recorded.anchors
            remarks += recorded.remarks(of_anchors)
        # the antenna is that of the TDOAs, or of ranges without any
        for name in ("imu", *(["tdoa"] if "tdoa" in streams else radio)):
            place, remark = sensor_place(bag.frames, STREAMS[name].topic, bag.found[name].frames)
            remarks += [remark] if remark else []
            if place and name != "imu":
                meta["antenna"] = place[1].tolist()
            elif place and name in streams:
                streams[name] = imu_in_body(streams[name], place)
        if remarks := [*remarks_of(reader), *remarks]:
            meta["remarks"] = remarks
        if unread := _unread(reader, name_of):
            meta["unread"] = unread
    streams.setdefault("tdoa", bag_messages.tdoas_of(np.empty(0), np.empty((0, 4))))
    streams["truth"] = streams.pop("pose", None)
    return Flight(about["name"], anchors, meta=meta, restarts=bag.clock.restarts, **streams)


def _unread(reader: BagReader, name_of: Names) -> list[str]:
    """Return sentences on topics of an open bag that no stream takes."""
    read = {name_of(topic) for name in STREAMS for topic, _ in topics_of(name)}
    read |= {name_of("uwb/anchors"), name_of("tf_static"), TF_STATIC}
    return [
        f"{one.topic}: {one.msgcount} messages of {one.msgtype}, which no stream takes"
        for one in reader.connections
        if one.topic not in read and one.msgcount
    ]


def read_odometry(
    path: str | Path,
    namespace: str = "",
    topics: dict[str, str] | None = None,
) -> RecordedOdometry:
    """Read a nav_msgs/Odometry topic in order of header stamps.

    The velocity is rotated from the child frame to the world frame. Estimates may be NaN.
    `namespace`, `topics` : see `read_bag`. Raises InputError.
    """
    with open_bag(path) as reader:
        topic = Names(namespace, topics)("odometry")
        names = [connection.topic for connection in reader.connections]
        t, rows, _ = read_topic(
            path, reader, topic, "nav_msgs/msg/Odometry", bag_messages.odometry_row
        ).in_order()
        remarks = tuple(remarks_of(reader))
    if not len(t):
        others = " or ".join(
            f"--topic odometry={name}"
            for name in names
            if name.endswith("/odometry") and name != topic
        )
        remedy = f"say which to take ({others})" if others else "record the output of the filter"
        raise InputError(f"{path}: has no message on {topic}; {remedy}.")
    p, v, q = rows[:, 0:3], rows[:, 3:6], rows[:, 6:10]
    known = np.isfinite(q).all(axis=1) & (np.abs(q).max(axis=1) > 0.0)
    v = np.where(
        known[:, None],
        Rotation.from_quat(np.where(known[:, None], q, [0.0, 0.0, 0.0, 1.0])).apply(v),
        np.nan,
    )
    return RecordedOdometry(t, p, v, q, rows[:, 10:46].reshape(-1, 6, 6), remarks)


def late_tdoas(
    path: str | Path,
    namespace: str = "",
    topics: dict[str, str] | None = None,
) -> int:
    """Return the number of TDOAs that came too late for the recorded odometry.

    The source is uwb/residual; 0 without that topic. Arguments as in `read_odometry`. Raises
    InputError.
    """
    beside = Names(namespace, topics)("odometry").rpartition("/")[0]
    with open_bag(path) as reader:
        found = connections_of(
            path, reader, f"{beside}/uwb/residual", "uwb_tdoa_msgs/msg/TdoaResidual"
        )
        return sum(
            residual.verdict == residual.VERDICT_LATE for _, _, residual in readable(reader, found)
        )


def _about(path: str | Path, custom: dict[str, Any]) -> dict[str, Any]:
    """Return {"name", "meta"} of the flight from the custom data of `write_bag`.

    Only _PRINTED texts are used. A bag of other software gives the name of the file and an empty
    dict.
    """
    try:
        about = json.loads(custom.get(_FLIGHT_KEY, "{}"))
        name, texts = about.get("name"), about.get("meta")
    except (TypeError, ValueError, AttributeError, RecursionError):
        name, texts = None, None
    texts = texts if isinstance(texts, dict) else {}
    return {
        "name": name if isinstance(name, str) and name else Path(path).stem,
        "meta": {
            key: printable(texts[key])[:1000] for key in _PRINTED if isinstance(texts.get(key), str)
        },
    }


def _not_finite(
    path: str | Path,
    topic: str,
    stamps: np.ndarray,
    rows: np.ndarray,
    valid: Callable[[np.ndarray], np.ndarray],
) -> InputError:
    row, column = np.argwhere(~valid(rows))[0]
    return InputError(
        f"{path}: {topic}, message {row + 1} of {len(rows)} at {stamps[row]:.3f} s: its "
        f"number {column + 1} is "
        f"{rows[row, column]}; it must be finite, within +-{LARGEST_NUMBER:g}: leave such "
        "messages out with --salvage."
    )
