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

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
import heapq
import json
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2 import Writer
from rosbags.typesys.store import Typestore
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError, printable, written_by
from uwb_tdoa_bias.common.flight import SENSOR_NAMES, Flight, Imu, Tdoas, Truth
from uwb_tdoa_bias.common.sensors import LOCATING, SENSORS, Stream
from uwb_tdoa_bias.common.sensors.sensor import LARGEST_NUMBER
from uwb_tdoa_ekf.results import Odometry, rows_of

from .. import choices
from ..clock import sentences
from . import messages as bag_messages
from .files import BagReader, check_output, connections_of, new_bag, open_bag, readable, remarks_of
from .messages import typestore
from .topics import (
    LATCHED_QOS,
    STREAM_QOS,
    STREAMS,
    TF_STATIC,
    Names,
    imu_in_body,
    other_namespaces,
    read_streams,
    read_topic,
    recorded_anchors,
    sensor_place,
    surveyed,
    topics_of,
)

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
class RecordedOdometry:
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

    def __len__(self) -> int:
        return len(self.t)


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

    Its topics are odometry, uwb/anchors and /tf_static.
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
    out = {"name": Path(path).stem, "meta": {}}
    try:
        about = json.loads(custom.get(_FLIGHT_KEY, "{}"))
    except (TypeError, ValueError, AttributeError, RecursionError):
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
    valid: Callable[[np.ndarray], np.ndarray],
) -> InputError:
    row, column = np.argwhere(~valid(rows))[0]
    return InputError(
        f"{path}: {topic}, message {row + 1} of {len(rows)} at {stamps[row]:.3f} s: its "
        f"number {column + 1} is "
        f"{rows[row, column]}; it must be finite, within +-{LARGEST_NUMBER:g}: leave such "
        "messages out with --salvage."
    )


Timed = Tdoas | Imu | Truth | Stream

CONVERTED = *choices.STREAMS, *SENSOR_NAMES


def convert(
    read: Callable[[], Flight], out: str | Path, storage: str = "mcap", force: bool = False
) -> dict[str, Any]:
    """Write a recording as a bag, see `write_bag`, and return a summary.

    Parameters
    ----------
    read : returns the Flight.

    Returns
    -------
    flight, bag : name of the flight, path of the bag.
    messages : {topic: count}.
    read : {stream: (samples, s of the first, s of the last)}.
    start, end : s.
    anchors : number of anchors.
    tdoa_unknown_anchor : number of TDOAs and ranges of anchors outside of the survey.
    left_out : {stream without a place in a bag: events}.
    meta : of the Flight.
    apart : sentences on sensors without common time with TDOAs or ranges.

    Raises InputError.
    """
    check_output(out, force)  # before the work, not after it
    flight = _from_zero_on(read())
    counts, held = write_bag(flight, out, storage, force), _held(flight)
    together = [stream for stream in held.values() if _overlaps(stream, flight)]
    known = (flight.anchors.index(flight.tdoa.a) >= 0) & (flight.anchors.index(flight.tdoa.b) >= 0)
    ranges_known = (
        np.ones(0, bool) if flight.range is None else flight.anchors.index(flight.range.anchor) >= 0
    )
    return {
        "flight": flight.name,
        "bag": str(out),
        "messages": counts,
        "read": {name: (len(of.t), float(of.t[0]), float(of.t[-1])) for name, of in held.items()},
        "start": min(float(stream.t[0]) for stream in together),
        "end": max(float(stream.t[-1]) for stream in together),
        "anchors": len(flight.anchors),
        "tdoa_unknown_anchor": int(np.count_nonzero(~known) + np.count_nonzero(~ranges_known)),
        "left_out": {name: len(columns["t"]) for name, columns in flight.extra.items()},
        "meta": flight.meta,
        "apart": _disjoint_sensors(flight),
    }


def described(made: dict[str, Any]) -> list[str]:
    """Return the summary of `convert` as lines: what was read and written, with counts, and what was left out."""
    meta, seconds = made["meta"], made["end"] - made["start"]
    out = [f"{made['flight']}: {seconds:.1f} s, {meta.get('protocol', 'protocol unknown')}"]
    if ids := meta.get("anchor_ids"):
        listed = ", ".join(f"{name} is {number}" for name, number in ids.items())
        out.append(f"  ids in the bag: {listed}")
    out += [f"  read {sentence}" for sentence in meta.get("read", ())]
    out += [f"  not read {sentence}" for sentence in meta.get("unread", ())]
    out += [f"  {remark}" for remark in meta.get("remarks", ())]
    out += [
        f"  {stream}: {count}, {first:.1f} to {last:.1f} s"
        for stream, (count, first, last) in made["read"].items()
    ]
    out += [f"  {topic}: {count}" for topic, count in made["messages"].items()]
    out += [
        f"  {name}: {count} events left out, a bag has no place for them"
        for name, count in made["left_out"].items()
    ]
    out += [
        f"  {topic}: sorted, its stamps fell {falls} times"
        for topic, falls in meta.get("reordered", {}).items()
    ]
    if count := made["tdoa_unknown_anchor"]:
        out.append(
            f"  {count} measurements name an anchor that the survey does not have; check lists them"
        )
    return out


def shifted(flight: Flight, offsets: dict[str, float]) -> Flight:
    """Return the Flight with offsets {sensor: s} added to its stamps.

    Raises InputError for a sensor that the Flight does not have.
    """
    changed = {}
    for sensor, offset in offsets.items():
        stream = getattr(flight, sensor)
        if stream is None:
            raise InputError(
                f"--time-offset: {flight.name} holds no {sensor}; it holds "
                f"{', '.join(_held(flight))}."
            )
        changed[sensor] = replace(stream, t=stream.t + offset)
    return replace(flight, **changed)


def _from_zero_on(flight: Flight) -> Flight:
    """Return the Flight without samples before 0 s of sensors, if TDOAs and ranges start later.

    A shifted clock may start there, and a bag has no negative stamps.
    """
    changed, remarks = dict[str, Any](), list(flight.meta.get("remarks", ()))
    for name, stream in _held(flight).items() if flight.start >= 0.0 else ():
        inside = stream.t >= 0.0
        if inside.any() and not inside.all():
            changed[name] = rows_of(stream, inside)
            remarks.append(
                f"{name}: {np.count_nonzero(~inside)} samples before 0 s, which a bag has no "
                "place for, are left out"
            )
    return (
        replace(flight, **changed, meta={**flight.meta, "remarks": remarks}) if changed else flight
    )


def _held(flight: Flight) -> dict[str, Timed]:
    """Return {name: stream} of the streams that have messages."""
    streams = {name: getattr(flight, name) for name in CONVERTED}
    return {name: of for name, of in streams.items() if of is not None and len(of.t)}


def _overlaps(one: Timed, flight: Flight) -> bool:
    """Return whether a stream has a time in common with TDOAs or ranges."""
    return one.t[-1] >= flight.start and one.t[0] <= flight.end


def _disjoint_sensors(flight: Flight) -> list[str]:
    """Return sentences on sensors without common time with TDOAs or ranges: another clock."""
    begin, end, remarks = flight.start, flight.end, []
    radio = "TDOAs" if len(flight.tdoa) else "ranges"
    for name, stream in _held(flight).items():
        t = stream.t
        if not _overlaps(stream, flight):
            remarks.append(
                f"{name} runs from {t[0]:.1f} to {t[-1]:.1f} s, the {radio} from {begin:.1f} "
                f"to {end:.1f} s: clocks that have no time in common; "
                f"--time-offset {name}={begin - t[0]:.3f} lets both begin together, if they did."
            )
    return remarks
