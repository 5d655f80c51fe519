"""Where a bag says where the anchors are: on uwb/anchors, else as frames on /tf_static, else as
markers for RViz.
"""

from __future__ import annotations

from collections import defaultdict
import re
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError

from .files import connections_of, readable
from .message_types import check_type
from .placing import TF_STATIC

if TYPE_CHECKING:
    from pathlib import Path

    from .files import BagReader

ANCHORS, TRANSFORMS, MARKERS = (
    "uwb_tdoa_msgs/msg/AnchorArray",
    "tf2_msgs/msg/TFMessage",
    "visualization_msgs/msg/MarkerArray",
)
FEWEST = (
    4  # anchors by which a tag is located: fewer frames or markers are taken for something else
)
TEXT, ADD = 9, 0  # of Marker: a type, whose place is beside that of the anchor, and an action
_FRAME = re.compile(r"^(?:.*[/_])?(?:anchor|anc|beacon)[_-]?([0-9]{1,5})$", re.IGNORECASE)


class Recorded(NamedTuple):
    """anchors : Anchors; source : the topic that they are from."""

    anchors: Anchors
    source: str

    def remarks(self, topic: str) -> list[str]:
        """Sentences on where they are from, if that is another than this topic."""
        return (
            []
            if self.source == topic
            else [
                f"there is no {topic}: the {len(self.anchors)} anchors are those of {self.source}."
            ]
        )


def recorded_anchors(path: str | Path, reader: BagReader, topic: str) -> Recorded | None:
    """Return the last Anchors on a topic of an open bag; without that, those that frames or markers
    name; None without any.

    Frames count whose names are "anchor", or the like, and a number, and that have one parent;
    markers of a topic or namespace with "anchor" in its name, by their ids. Raises InputError.
    """
    last = None
    for _, _, last in readable(path, reader, connections_of(path, reader, topic, ANCHORS)):
        pass
    if last is None:
        return _of_frames(path, reader) or _of_markers(path, reader)
    try:
        return Recorded(Anchors.from_message(last), topic)
    except InputError as error:
        raise InputError(f"{path}: {topic}: {error}") from error


def _of_frames(path: str | Path, reader: BagReader) -> Recorded | None:
    by_parent: dict[str, dict[int, list[float]]] = defaultdict(dict)
    connections = [
        one for one in reader.connections if one.topic == TF_STATIC and one.msgtype == TRANSFORMS
    ]
    for connection in connections:
        check_type(path, connection)
    for _, _, message in readable(path, reader, connections):
        for each in message.transforms:
            if found := _FRAME.match(each.child_frame_id):
                p, q = each.transform.translation, each.transform.rotation
                turn = (
                    [q.x, q.y, q.z, q.w] if abs(q.w) < 1.0 else [np.nan] * 4
                )  # no turn is what a driver writes that knows none
                by_parent[each.header.frame_id][int(found[1])] = [p.x, p.y, p.z, *turn]
    frames = [(parent, rows) for parent, rows in by_parent.items() if len(rows) >= FEWEST]
    if len(frames) != 1:
        return None
    return _recorded(path, TF_STATIC, *frames[0])


def _of_markers(path: str | Path, reader: BagReader) -> Recorded | None:
    for connection in [one for one in reader.connections if one.msgtype == MARKERS]:
        check_type(path, connection)
        by_frame: dict[str, dict[int, list[float]]] = defaultdict(dict)
        for _, _, message in readable(path, reader, [connection]):
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
    """Of rows: {id: position and quaternion}."""
    table = np.array(list(rows.values()))
    try:
        return Recorded(
            Anchors(np.array(list(rows)), table[:, :3], table[:, 3:], frame.lstrip("/") or "map"),
            source,
        )
    except InputError as error:
        raise InputError(f"{path}: {source}: {error}") from error
