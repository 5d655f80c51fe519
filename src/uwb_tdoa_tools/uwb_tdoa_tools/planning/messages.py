"""Charts as standard ROS messages, for RViz and Foxglove: to a bag, or published."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..bags.files import new_bag
from ..bags.message_types import typestore
from ..bags.messages import anchors_message, header_of, pose_of
from ..bags.topics import LATCHED_QOS
from .judging import FLYABLE, IMPRECISE, OUTSIDE, TOO_FEW, TWO_SOLUTIONS

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from rosbags.typesys.store import Typestore

    from uwb_tdoa_bias.foundation.anchors import Anchors

    from .maps import Chart, Grid

TOPICS = {
    "plan/flyable": "nav_msgs/msg/OccupancyGrid",
    "plan/precision": "nav_msgs/msg/OccupancyGrid",
    "plan/markers": "visualization_msgs/msg/MarkerArray",
    "uwb/anchors": "uwb_tdoa_msgs/msg/AnchorArray",
}
OCCUPIED = {FLYABLE: 0, TWO_SOLUTIONS: 50, IMPRECISE: 75, TOO_FEW: 100, OUTSIDE: 100}
_CUBES, _SPHERES, _TEXT = 6, 7, 9  # visualization_msgs/msg/Marker


def messages(chart: Chart, anchors: Anchors, stamp: int = 0) -> dict[str, Any]:
    """{topic: rosbags message} of TOPICS. stamp : ns.

    plan/flyable : one slice (the middle layer), values of OCCUPIED plan/precision : the same slice,
    the bound (root of its trace) in cm, at most 100; -1 where there is none plan/markers : the
    surface of the flyable cells, coloured from green (best bound) to red (worst), and the anchors
    """
    store = typestore()
    k = chart.grid.shape[2] // 2
    status = np.array([OCCUPIED[one] for one in range(len(OCCUPIED))])[chart.status]
    cm = np.where(
        np.isfinite(chart.error), np.minimum(np.rint(100.0 * np.minimum(chart.error, 1e3)), 100), -1
    )
    return {
        "plan/flyable": _occupancy(store, chart.grid, status, k, anchors.frame, stamp),
        "plan/precision": _occupancy(store, chart.grid, cm, k, anchors.frame, stamp),
        "plan/markers": _markers(store, chart, anchors, stamp),
        "uwb/anchors": anchors_message(anchors, stamp, store)[1],
    }


def write(found: dict[str, Any], path: str | Path) -> None:
    """Write what `messages` gave as a bag (replaced if it is one), transient local, one message per
    topic.
    """
    store = typestore()
    with new_bag(path, force=True) as writer:
        for topic, message in found.items():
            connection = writer.add_connection(
                f"/{topic}", TOPICS[topic], typestore=store, offered_qos_profiles=[LATCHED_QOS]
            )
            writer.write(connection, 0, store.serialize_cdr(message, TOPICS[topic]))


def publish(found: dict[str, Any]) -> None:
    """Publish what `messages` gave, transient local, until SIGINT or SIGTERM. Needs rclpy."""
    import rclpy
    from rclpy.serialization import deserialize_message

    from uwb_tdoa_bias.foundation.ros_anchors import ANCHORS_QOS

    from ..live.session import message_class, session

    store = typestore()
    with session("plan", []) as (node, stop):
        for topic, message in found.items():
            kind = message_class(TOPICS[topic])
            data = bytes(store.serialize_cdr(message, TOPICS[topic]))
            node.create_publisher(kind, topic, ANCHORS_QOS).publish(deserialize_message(data, kind))
        while not stop:
            rclpy.spin_once(node, timeout_sec=0.2)


def _occupancy(
    store: Typestore, grid: Grid, values: np.ndarray, k: int, frame: str, stamp: int
) -> Any:
    """Values (n,) of layer k as an OccupancyGrid at the height of the layer's middle."""
    types, (nx, ny, _) = store.types, grid.shape
    header = header_of(store, stamp, frame)
    corner = pose_of(store, (*grid.lower[:2], grid.axes[2][k]))
    info = types["nav_msgs/msg/MapMetaData"](header.stamp, grid.step, nx, ny, corner)
    data = np.ascontiguousarray(grid.layer(values, k).ravel(), dtype=np.int8)
    return types["nav_msgs/msg/OccupancyGrid"](header, info, data)


def _markers(store: Typestore, chart: Chart, anchors: Anchors, stamp: int) -> Any:
    types, grid = store.types, chart.grid
    surface = _surface(chart.flyable.reshape(grid.shape)).ravel()
    error = chart.error[surface]
    worse = (error - error.min(initial=np.inf)) / max(np.ptp(error) if len(error) else 0.0, 1e-9)
    green_to_red = np.column_stack(
        [np.minimum(2 * worse, 1), np.minimum(2 - 2 * worse, 1), 0 * worse, 0 * worse + 0.4]
    )
    drawn = [
        _Drawn("flyable", _CUBES, grid.step, points=grid.points[surface], colours=green_to_red)
    ]
    drawn.append(_Drawn("anchors", _SPHERES, 0.15, points=anchors.positions))
    for number, p in zip(anchors.ids.tolist(), anchors.positions):
        drawn.append(_Drawn("ids", _TEXT, 0.25, number, at=p + [0, 0, 0.25], text=str(number)))
    header = header_of(store, stamp, anchors.frame)
    return types["visualization_msgs/msg/MarkerArray"](
        [_marker(store, header, one) for one in drawn]
    )


@dataclass(frozen=True)
class _Drawn:
    """What a marker shows. kind : of visualization_msgs/Marker; size : m; points (n, 3) m and
    colours (n, 4), red, green, blue and opacity, of its parts; at (3,) m : where it is.
    """

    namespace: str
    kind: int
    size: float
    number: int = 0
    points: Sequence[float] | np.ndarray = ()
    colours: Sequence[float] | np.ndarray = ()
    at: Sequence[float] | np.ndarray = (0.0, 0.0, 0.0)
    text: str = ""


def _marker(store: Typestore, header: Any, drawn: _Drawn) -> Any:
    types = store.types
    colour, zero = types["std_msgs/msg/ColorRGBA"], types["builtin_interfaces/msg/Duration"](0, 0)
    nothing = types["sensor_msgs/msg/CompressedImage"](
        header_of(store, 0, ""), "", np.empty(0, np.uint8)
    )
    return types["visualization_msgs/msg/Marker"](
        header,
        drawn.namespace,
        drawn.number,
        drawn.kind,
        0,
        pose_of(store, drawn.at),
        types["geometry_msgs/msg/Vector3"](*[drawn.size] * 3),
        colour(0.1, 0.3, 0.9, 1.0),
        zero,
        False,
        [types["geometry_msgs/msg/Point"](*p) for p in np.asarray(drawn.points).tolist()],
        [colour(*c) for c in np.asarray(drawn.colours).tolist()],
        "",
        nothing,
        [],
        drawn.text,
        "",
        types["visualization_msgs/msg/MeshFile"]("", np.empty(0, np.uint8)),
        False,
    )


def _surface(cells: np.ndarray) -> np.ndarray:
    """Cells that are true and have a neighbour, or the edge of the grid, that is not."""
    padded = np.pad(cells, 1)
    inner = np.ones_like(cells)
    for axis in range(3):
        for shift in (-1, 1):
            inner &= np.roll(padded, shift, axis)[1:-1, 1:-1, 1:-1]
    return cells & ~inner
