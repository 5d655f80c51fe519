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

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
import heapq
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flight import Flight
from uwb_tdoa_bias.foundation.foreign_text import printable
from uwb_tdoa_bias.foundation.sensors import LOCATING, SENSORS
from uwb_tdoa_bias.foundation.sensors.sensor import LARGEST_NUMBER
from uwb_tdoa_bias.foundation.survey_faults import refuse_faulty
from uwb_tdoa_bias.foundation.version import written_by

from ..clock import sentences, straightened
from . import frames
from . import messages as bag_messages
from .files import check_output, connections_of, new_bag, open_bag, readable, remarks_of
from .frames import recorded_anchors
from .integrity import metadata
from .mcap import Damaged
from .message_types import typestore

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from rosbags.interfaces import Connection
    from rosbags.rosbag2 import Writer
    from rosbags.typesys.store import Typestore

    from uwb_tdoa_bias.foundation.sensors import Sensor
    from uwb_tdoa_ekf.results import Odometry

    from ..clock import Straightened
    from .files import BagReader

    Topics = dict[
        str, tuple[str, Qos, Iterable[tuple[int, Any]]]
    ]  # {topic: (type, QoS, (stamp ns, message) in order)}

__all__ = [
    "Names",
    "RecordedOdometry",
    "check_output",
    "late_tdoas",
    "read_bag",
    "read_fields",
    "read_odometry",
    "write_bag",
    "write_odometry",
]

_FLIGHT_KEY = (
    "uwb_tdoa_tools.flight"  # in the bag's custom data: name and meta of the flight, as JSON
)
_PRINTED = (
    "source",
    "format",
    "protocol",
)  # of that meta: texts that are read again, to be printed; nothing is computed with them


class _Kind(NamedTuple):
    """Of a stream of a Flight: our topic, the type of its messages, row(message) as for
    `read_topic`, make(stamps s, rows) : the stream, and sound(rows) : whether its numbers can be
    used.
    """

    topic: str
    message: str
    row: Callable[[Any], tuple[float, ...]]
    make: Callable[[np.ndarray, np.ndarray], Any]
    sound: Callable[[np.ndarray], np.ndarray] = bag_messages.sound


_STREAMS = {
    "tdoa": _Kind(
        "uwb/tdoa", "uwb_tdoa_msgs/msg/Tdoa", bag_messages.tdoa_row, bag_messages.tdoas_of
    ),
    "imu": _Kind("imu/data", "sensor_msgs/msg/Imu", bag_messages.imu_row, bag_messages.imu_of),
    **{
        name: _Kind(of.topics[0][0], of.message, *bag_messages.of_sensor(of))
        for name, of in SENSORS.items()
    },
    "pose": _Kind(
        "ground_truth/pose",
        "geometry_msgs/msg/PoseStamped",
        bag_messages.pose_row,
        bag_messages.truth_of,
    ),
}


def _qos(durability: QosDurability, depth: int) -> Qos:
    """Reliable, because a reliable publisher serves reliable and best-effort subscriptions, and
    loses nothing.
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


_STREAM_QOS = _qos(QosDurability.VOLATILE, 1000)
LATCHED_QOS = _qos(QosDurability.TRANSIENT_LOCAL, 1)


@dataclass(frozen=True)
class RecordedOdometry:
    """Recorded estimates. World frame of the filter and body frame as in nav_msgs/Odometry.

    t : (n,) s, header stamps; p : (n, 3) m and v : (n, 3) m/s in the world frame; q : (n, 4) x y z
        w, body to world;
    covariance : (n, 6, 6) of position (world) and rotation, m^2 and rad^2; remarks : what is
        missing, sentences.
    """

    t: np.ndarray
    p: np.ndarray
    v: np.ndarray
    q: np.ndarray
    covariance: np.ndarray
    remarks: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.t)


def write_bag(
    flight: Flight, out: str | Path, storage: str = "mcap", force: bool = False
) -> dict[str, int]:
    """Write a Flight as a ROS 2 bag. Returns {topic: number of messages}.

    out : path of the new bag, a directory. It appears only when it is complete. An existing path is
        refused; with force
        an existing bag (nothing else) is replaced.
    storage : "mcap" or "sqlite3".
    Raises InputError; also for stamps that a ROS message cannot hold.
    """
    store = typestore()
    present = [(name, getattr(flight, name)) for name in ("tdoa", "imu", "truth", *SENSORS)]
    starts = [
        bag_messages.nanoseconds(name, s.t[:1])[0]
        for name, s in present
        if s is not None and len(s)
    ]
    if not starts:
        raise InputError(f"{flight.name}: holds no message; there is nothing to write.")
    first = int(min(starts))
    antenna = flight.meta.get("antenna")
    topics = _of_anchors(flight.anchors, first, store, antenna)
    if flight.imu is not None:
        topics["/imu/data"] = (
            "sensor_msgs/msg/Imu",
            _STREAM_QOS,
            bag_messages.imu_messages(flight.imu, store),
        )
    for name, sensor in SENSORS.items():
        if (stream := getattr(flight, name)) is not None:
            topics[f"/{sensor.topics[0][0]}"] = (
                sensor.message,
                _STREAM_QOS,
                bag_messages.sensor_messages(sensor, stream, store),
            )
    topics["/uwb/tdoa"] = (
        "uwb_tdoa_msgs/msg/Tdoa",
        _STREAM_QOS,
        bag_messages.tdoa_messages(flight.tdoa, store, antenna),
    )
    if flight.truth is not None:
        poses = bag_messages.pose_messages(flight.truth, flight.anchors.frame, store)
        topics["/ground_truth/pose"] = "geometry_msgs/msg/PoseStamped", _STREAM_QOS, poses

    with new_bag(out, storage, force) as writer:
        writer.set_custom_data(_FLIGHT_KEY, _about_flight(flight))
        return _write(writer, topics, store)


def write_odometry(
    odometry: Odometry, anchors: Anchors, out: str | Path, force: bool = False
) -> dict[str, int]:
    """Write an Odometry among Anchors as a bag with odometry, uwb/anchors and /tf_static; see
    `write_bag`.
    """
    store = typestore()
    if not len(odometry):
        raise InputError(f"{out}: there is no odometry to write.")
    topics = _of_anchors(
        anchors, int(bag_messages.nanoseconds("odometry", odometry.t[:1])[0]), store
    )
    topics["/odometry"] = (
        "nav_msgs/msg/Odometry",
        _STREAM_QOS,
        bag_messages.odometry_messages(odometry, anchors.frame, store),
    )
    with new_bag(out, "mcap", force) as writer:
        return _write(writer, topics, store)


def _of_anchors(
    anchors: Anchors, first: int, store: Typestore, antenna: Sequence[float] | None = None
) -> Topics:
    """{topic: (type, QoS, [(stamp ns, message)])} of Anchors, to be written before anything else.
    first : ns, of the bag; antenna : (3,) m.
    """
    array = bag_messages.anchors_message(
        anchors, first, store
    )  # at equal stamps this order holds: anchors before what needs them
    frames = bag_messages.transforms_message(anchors, first, store, antenna)
    return {
        "/uwb/anchors": ("uwb_tdoa_msgs/msg/AnchorArray", LATCHED_QOS, [array]),
        "/tf_static": ("tf2_msgs/msg/TFMessage", LATCHED_QOS, [frames]),
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


def _about_flight(flight: Flight) -> str:
    return json.dumps(
        {"name": flight.name, "meta": flight.meta, "written_by": written_by()}, default=str
    )


def read_bag(
    path: str | Path,
    namespace: str = "",
    anchors: Anchors | None = None,
    salvage: bool = False,
    topics: dict[str, str] | None = None,
    truth: bool = True,
) -> Flight:
    """Flight of a bag that was written here, by `ros2 bag record` or by our `record`; other topics
    are ignored.

    namespace : where the tag's topics are in the bag, e.g. "tag1" for /tag1/uwb/tdoa.
    topics : {our name of a topic: its name in the bag}, e.g. {"uwb/tdoa": "/my/tdoa"}; not
        absolute: in the namespace.
    anchors : Anchors to use instead of the recorded uwb/anchors, or None.
    salvage : read a cut or damaged bag up to there, and without messages that are no numbers;
        `meta["remarks"]` tells.
    truth : read ground_truth/pose, where it is.
    Stamps are header stamps, on one continuous time (`meta["clock"]`: [Jump] and {stream:
    outliers}, see `clock.straightened`); messages that were recorded out of their order are sorted
    (`meta["reordered"]`). An IMU in a frame of its own is taken to the body as /tf_static says;
    `meta["antenna"]` is the place of an antenna on it, (3,) m. Raises InputError for a bag that is
    damaged, has no uwb/tdoa, or neither anchors nor uwb/anchors, and for messages with numbers that
    are not finite.
    """
    with open_bag(path, salvage) as reader:
        about = _about(path)
        meta = {**about["meta"], "bag": str(path)}
        remarks, name_of = list[str](), Names(namespace, topics)
        kinds = (
            _STREAMS if truth else {name: kind for name, kind in _STREAMS.items() if name != "pose"}
        )
        own = {name: kind for name, kind in kinds.items() if name not in SENSORS}
        found = {
            name: read_topic(path, reader, name_of(kind.topic), kind.message, kind.row)
            for name, kind in own.items()
        }
        found |= {
            name: read_sensor(path, reader, sensor, name_of) for name, sensor in SENSORS.items()
        }
        found, clock = on_one_clock(found)
        if clock.jumps or clock.kept:
            meta["clock"] = clock.jumps, clock.outliers
            remarks += sentences(clock)

        def stream(name: str) -> Any:
            if name not in found:
                return None
            topic, make, sound = kinds[name].topic, kinds[name].make, kinds[name].sound
            stamps, rows, falls = found[name].in_order()
            if falls:
                meta.setdefault("reordered", {})[topic] = falls
            if not len(stamps):
                return None
            whole = sound(rows).all(axis=1)
            if not whole.all():
                if not salvage:
                    raise _not_finite(
                        path,
                        " and ".join(name_of(each) for each, _ in topics_of(name)),
                        stamps,
                        rows,
                        sound,
                    )
                remarks.append(
                    f"{topic}: {np.count_nonzero(~whole)} messages left out, they are no numbers."
                )
                stamps, rows = stamps[whole], rows[whole]
            return make(stamps, rows) if len(stamps) else None

        tdoa = stream("tdoa")
        sensors: dict[str, Any] = {name: stream(name) for name in SENSORS}
        if tdoa is None and any(sensors[name] is not None for name in LOCATING):
            tdoa = bag_messages.tdoas_of(np.empty(0), np.empty((0, 4)))
        if tdoa is None:
            count = reader.unreadable[name_of("uwb/tdoa")]
            why = f"{count} that are there cannot be read" if count else _others(reader, namespace)
            raise InputError(f"{path}: has no message on {name_of('uwb/tdoa')}; {why}.")
        if anchors is None:
            recorded = recorded_anchors(path, reader, name_of("uwb/anchors"))
            if recorded is None:
                raise InputError(
                    f"{path}: has no message on {name_of('uwb/anchors')}; give a survey file "
                    "(--survey FILE)."
                )
            anchors = refuse_faulty(recorded.anchors, f"{path}: {recorded.source}")
            remarks += recorded.remarks(name_of("uwb/anchors"))
        imu = stream("imu")
        tree = frames.read_frames(path, reader)
        places = {
            kinds[name].topic: frames.sensor_place(tree, kinds[name].topic, found[name].frames)
            for name in ("imu", "tdoa")
        }
        remarks += [remark for _, remark in places.values() if remark]
        remarks = [*remarks_of(reader), *remarks]
        poses = stream("pose")
    if imu is not None and (place := places["imu/data"][0]):
        imu = frames.imu_in_body(imu, place)
    if place := places["uwb/tdoa"][0]:
        meta["antenna"] = place[1].tolist()
    if remarks:
        meta["remarks"] = remarks
    return Flight(about["name"], anchors, tdoa, imu, poses, {}, meta, clock.restarts, **sensors)


def read_odometry(
    path: str | Path,
    namespace: str = "",
    salvage: bool = False,
    topics: dict[str, str] | None = None,
) -> RecordedOdometry:
    """RecordedOdometry of a nav_msgs/Odometry topic, in order of header stamps; raises InputError.

    nav_msgs/Odometry has the velocity in the child frame; it is turned into the world frame here.
    An estimate may be NaN: that is for who judges it. namespace, salvage, topics : see `read_bag`.
    """
    with open_bag(path, salvage) as reader:
        topic = Names(namespace, topics)("odometry")
        names = [connection.topic for connection in reader.connections]
        t, rows, _ = read_topic(
            path, reader, topic, "nav_msgs/msg/Odometry", bag_messages.odometry_row
        ).in_order()
        remarks = tuple(remarks_of(reader))
    if not len(t):
        others = " or ".join(
            f"--topic odometry={name}" for name in names if name.endswith("/odometry")
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
    salvage: bool = False,
    topics: dict[str, str] | None = None,
) -> int:
    """How many TDOAs came too late for the filter that made the odometry of a bag, by the
    uwb/residual beside it.

    0 where that was not recorded. Arguments as of `read_odometry`. Raises InputError.
    """
    beside = Names(namespace, topics)("odometry").rpartition("/")[0]
    with open_bag(path, salvage) as reader:
        found = connections_of(
            path, reader, f"{beside}/uwb/residual", "uwb_tdoa_msgs/msg/TdoaResidual"
        )
        return sum(
            residual.verdict == residual.VERDICT_LATE
            for _, _, residual in readable(path, reader, found)
        )


def read_fields(path: str | Path, topic: str) -> dict[str, np.ndarray]:
    """Columns of a recorded topic whose messages have a header, e.g. uwb/residual or
    uwb/tdoa_corrected.

    Returns {"t": (n,) s, field: (n,) array, ...} for every field that is one number or one string,
    in order of header stamps; raises InputError.
    """
    with open_bag(path) as reader:
        topic = Names()(topic)
        found = connections_of(path, reader, topic)
        if not found:
            raise InputError(f"{path}: has no topic {topic}; record it.")
        recorded = [message for _, _, message in readable(path, reader, found)]
    stamps = np.array(
        [bag_messages.stamp_of(message.header) for message in recorded], dtype=np.int64
    )
    order = np.argsort(stamps, kind="stable")
    columns = {"t": stamps[order] / 1e9}
    _, fields = typestore().fielddefs[found[0].msgtype]
    for name, _ in fields if recorded else ():
        values = [getattr(message, name) for message in recorded]
        if isinstance(values[0], (bool, int, float, str)):
            columns[name] = np.array(values)[order]
    return columns


def _about(path: str | Path) -> dict[str, Any]:
    """{"name", "meta"} of the flight, as `write_bag` left them in the bag's custom data, what is
    _PRINTED of it; of bags of others, and where they cannot be read, the name of the file and
    nothing.
    """
    out = {"name": Path(path).stem, "meta": {}}
    try:
        about = json.loads(metadata(Path(path))["custom_data"].get(_FLIGHT_KEY, "{}"))
    except (InputError, Damaged, TypeError, ValueError, RecursionError):
        return out
    if isinstance(about, dict):
        name, meta = about.get("name"), about.get("meta")
        if isinstance(name, str) and name:
            out["name"] = name
        if isinstance(meta, dict):
            out["meta"] = {
                key: printable(meta[key])[:1000]
                for key in _PRINTED
                if isinstance(meta.get(key), str)
            }
    return out


def _not_finite(
    path: str | Path,
    topic: str,
    stamps: np.ndarray,
    rows: np.ndarray,
    sound: Callable[[np.ndarray], np.ndarray],
) -> InputError:
    row, column = np.argwhere(~sound(rows))[0]
    return InputError(
        f"{path}: {topic}, message {row + 1} of {len(rows)} at {stamps[row]:.3f} s: its "
        f"number {column + 1} is "
        f"{rows[row, column]}; it must be finite, within +-{LARGEST_NUMBER:g}: leave such "
        "messages out with --salvage."
    )


class Names:
    """Absolute names of our topics in a bag."""

    def __init__(self, namespace: str = "", topics: dict[str, str] | None = None) -> None:
        """namespace, topics : see `read_bag`."""
        self._namespace, self._topics = namespace.strip("/"), topics or {}

    def __call__(self, topic: str) -> str:
        """Where a topic of ours is, e.g. "uwb/tdoa"."""
        name = self._topics.get(topic, topic)
        absolute = name.startswith("/") or not self._namespace
        return f"/{name.strip('/')}" if absolute else f"/{self._namespace}/{name.strip('/')}"


@dataclass(frozen=True)
class TopicMessages:
    """Messages of a topic in the order of the bag. stamps, arrived : (n,) int ns, of their headers,
    and of when they were recorded; rows : (n, k), what else was taken of each; frames : {frame_id:
    messages}.
    """

    stamps: np.ndarray
    arrived: np.ndarray
    rows: np.ndarray
    frames: Counter[str]

    def in_order(self) -> tuple[np.ndarray, np.ndarray, int]:
        """(stamps (n,) s, rows (n, k)) in order of the stamps, and how often these fell."""
        order = np.argsort(self.stamps, kind="stable")
        return self.stamps[order] / 1e9, self.rows[order], int((np.diff(self.stamps) < 0).sum())


def arrivals(found: Mapping[str, TopicMessages]) -> dict[str, np.ndarray]:
    """{stream: (n,) s at which its messages were recorded}; NaN of a bag all of whose times are the
    stamps themselves: they tell none.
    """
    known = any(bool((of.stamps != of.arrived).any()) for of in found.values())
    return {
        name: of.arrived / 1e9 if known else np.full(len(of.arrived), np.nan)
        for name, of in found.items()
    }


def on_one_clock(
    found: Mapping[str, TopicMessages],
) -> tuple[dict[str, TopicMessages], Straightened]:
    """The TopicMessages of a recording, by the names of their streams, on one continuous time and
    without outliers, and what was done.
    """
    clock = straightened({name: of.stamps / 1e9 for name, of in found.items()}, arrivals(found))
    out = dict(found)
    for name in {*clock.shifts, *clock.kept}:
        of, kept = found[name], clock.kept.get(name, slice(None))
        stamps = of.stamps + np.round(1e9 * clock.shifts.get(name, np.zeros(1))).astype(np.int64)
        out[name] = TopicMessages(stamps[kept], of.arrived[kept], of.rows[kept], of.frames)
    return out, clock


def read_topic(
    path: str | Path,
    reader: BagReader,
    topic: str,
    msgtype: str,
    row: Callable[[Any], tuple[float, ...]],
) -> TopicMessages:
    """TopicMessages of a topic, none if it is not there. row(message) : its stamp, ns, and k other
    numbers. Raises InputError if its type is another than msgtype.
    """
    arrived, rows, frames = [], [], Counter[str]()
    for _, received, message in readable(
        path, reader, connections_of(path, reader, topic, msgtype)
    ):
        arrived.append(received)
        rows.append(row(message))
        frames[message.header.frame_id] += 1
    stamps, table = (
        np.array([values[0] for values in rows], dtype=np.int64),
        np.array([values[1:] for values in rows], dtype=float),
    )
    return TopicMessages(stamps, np.array(arrived, dtype=np.int64), table, frames)


def topics_of(name: str) -> tuple[tuple[str, str], ...]:
    """((topic, type of its messages), ...) of a stream of a Flight, by our names."""
    return (
        SENSORS[name].topics
        if name in SENSORS
        else ((_STREAMS[name].topic, _STREAMS[name].message),)
    )


def read_sensor(
    path: str | Path, reader: BagReader, sensor: Sensor, name_of: Names
) -> TopicMessages:
    """TopicMessages of all topics of a Sensor, as the node hears them: in the order in which they
    came. Raises InputError as `read_topic` does.
    """
    row, _, _ = bag_messages.of_sensor(sensor)
    parts = [read_topic(path, reader, name_of(topic), kind, row) for topic, kind in sensor.topics]
    filled = [part for part in parts if len(part.stamps)]
    if len(filled) < 2:
        return filled[0] if filled else parts[0]
    order = np.argsort(np.concatenate([part.arrived for part in filled]), kind="stable")
    stamps, arrived, rows = (
        np.concatenate([getattr(part, name) for part in filled])[order]
        for name in ("stamps", "arrived", "rows")
    )
    return TopicMessages(stamps, arrived, rows, sum((part.frames for part in filled), Counter()))


def _others(reader: BagReader, namespace: str) -> str:
    """Where the bag has such a topic instead, for an error message."""
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
    return "it is no recording of this suite"
