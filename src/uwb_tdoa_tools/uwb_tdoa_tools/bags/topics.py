# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Topics of a bag: their names, types, QoS, and messages as arrays."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
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

from uwb_tdoa_bias.common.sensors import SENSORS, Sensor
from uwb_tdoa_bias.common.transforms import Frames

from ..clock import Straightened, straightened
from ..command_lines import suggest_line
from . import messages as bag_messages
from .files import BagReader, connections_of, readable
from .frames import sensor_place


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


def arrivals(found: Mapping[str, TopicMessages]) -> dict[str, np.ndarray]:
    """Return {stream: (n,) s, times of recording}; NaN if they equal the stamps."""
    known = any(bool((of.stamps != of.arrived).any()) for of in found.values())
    return {
        name: of.arrived / 1e9 if known else np.full(len(of.arrived), np.nan)
        for name, of in found.items()
    }


def on_one_clock(
    found: Mapping[str, TopicMessages],
) -> tuple[dict[str, TopicMessages], Straightened]:
    """Put the messages of a recording on a continuous time and remove outliers.

    Returns the messages and the changes.
    """
    clock = straightened({name: of.stamps / 1e9 for name, of in found.items()}, arrivals(found))
    out = dict(found)
    for name in {*clock.shifts, *clock.kept}:
        of, kept = found[name], clock.kept.get(name, slice(None))
        stamps = of.stamps + np.round(1e9 * clock.shifts.get(name, np.zeros(1))).astype(np.int64)
        out[name] = replace(of, stamps=stamps[kept], arrived=of.arrived[kept], rows=of.rows[kept])
    return out, clock


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
