# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Where a bag places sensors and anchors: /tf_static, uwb/anchors, markers for RViz.

Sensors outside of the body frame are transformed as in the nodes.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterator
from itertools import chain
from pathlib import Path
import re
from typing import Any, NamedTuple

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Imu
from uwb_tdoa_bias.common.transforms import Frames, Place
from uwb_tdoa_ekf.frames import ImuMount

from .files import BagReader, connections_of, readable
from .message_types import check_type
from .messages import BODY_FRAME

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
    frames = [(parent, rows) for parent, rows in by_parent.items() if len(rows) >= FEWEST]
    if len(frames) != 1:
        return None
    return _recorded(path, TF_STATIC, *frames[0])


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
        frames = [(frame, rows) for frame, rows in by_frame.items() if len(rows) >= FEWEST]
        if len(frames) == 1:
            return _recorded(path, connection.topic, *frames[0])
    return None


def _recorded(path: str | Path, source: str, frame: str, rows: dict[int, list[float]]) -> Recorded:
    """Return the anchors of rows {id: position and quaternion}."""
    table = np.array(list(rows.values()))
    try:
        return Recorded(
            Anchors(np.array(list(rows)), table[:, :3], table[:, 3:], frame.lstrip("/") or "map"),
            source,
        )
    except InputError as error:
        raise InputError(f"{path}: {source}: {error}") from error
