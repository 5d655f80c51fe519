# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Report a plan: figures for plan.json, lines for the screen, and ROS messages of the maps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.typesys.store import Typestore
from scipy.ndimage import binary_erosion

from uwb_tdoa_bias.common.anchors import Anchors

from ..bags.files import new_bag
from ..bags.messages import LATCHED_QOS, anchors_message, header_of, pose_of, typestore
from ..checking.coverage import to_copy
from ..scoring.metrics import change_in_words
from ..simulation.config import Room
from .maps import FLYABLE, IMPRECISE, OUTSIDE, TOO_FEW, TWO_SOLUTIONS, Chart, Grid
from .precision import NORMAL_99, Installation, dilution

SHARES = {
    "flyable": FLYABLE,
    "two_solutions": TWO_SOLUTIONS,
    "imprecise": IMPRECISE,
    "too_few": TOO_FEW,
    "outside": OUTSIDE,
}
LISTED = 20  # anchors of a design that are printed one by one; more are in hall.yaml alone
_COLUMNS = {
    "rmse": "RMSE",
    "scatter": "scatter",
    "claimed": "claimed",
    "bound": "bound",
    "achieved_over_bound": "/ bound",
    "efficiency_claimed": "eff. cl.",
    "efficiency_achieved": "eff. ach.",
}


def summary(chart: Chart) -> dict[str, Any]:
    """Return the figures of a Chart: shares 0 to 1 of its cells, sizes in m, m^2 or m^3.

    "heard" : {anchors heard: share}; "bound_flyable" : quantiles, m.
    """
    step = chart.grid.step
    cell = step**2 if chart.grid.shape[2] == 1 else step**3
    numbers, counts = np.unique(chart.heard, return_counts=True)
    return {
        "cells": list(chart.grid.shape),
        "step": step,
        **{f"{name}_share": float(np.mean(chart.status == code)) for name, code in SHARES.items()},
        "flyable_size": float(chart.flyable.sum() * cell),
        "size": float(chart.flyable.size * cell),
        "heard": dict(zip(map(str, numbers.tolist()), (counts / len(chart.heard)).tolist())),
        "bound_flyable": quantiles(chart.error[chart.flyable]),
    }


def in_hull(chart: Chart, installation: Installation) -> dict[str, Any]:
    """Return the figures of a Chart inside the anchors' hull, m; None if no cell is inside."""
    rows = installation.inside_hull(chart.grid.points) & np.isfinite(chart.error)
    pdop = (
        np.linalg.norm(dilution(chart.grid.points[rows], installation), axis=1)
        if rows.any()
        else np.empty(0)
    )
    return {
        "bound_in_hull": quantiles(chart.error[rows]),
        "bound_99_per_axis_in_hull": {
            axis: quantiles(column) for axis, column in zip("xyz", NORMAL_99 * chart.std[rows].T)
        },
        "pdop_in_hull": quantiles(pdop),
    }


def print_room(room: Room, given: bool) -> None:
    """Print the Room; given : whether by --room, else it is what the anchors span."""
    ends = ", ".join(
        f"{axis} {low:.2f} to {high:.2f}" for axis, low, high in zip("xyz", room.lower, room.upper)
    )
    print(
        f"room: {ends} m"
        + (
            ""
            if given
            else ", what the anchors span; if yours is another: --room X0 X1 Y0 Y1 Z0 Z1"
        )
    )


def print_in_hull(about: dict[str, Any]) -> None:
    """Print the figures of `in_hull`."""
    if about["bound_in_hull"] is None:
        print("no cell is among the anchors with a bound; choose another --room or --height")
        return
    print("among the anchors (inside their hull):")
    for label, values in (
        ("bound of one round, root of the summed variances, m", about["bound_in_hull"]),
        *(
            (f"99 % of {axis} within +-, m", values)
            for axis, values in about["bound_99_per_axis_in_hull"].items()
        ),
        ("PDOP", about["pdop_in_hull"]),
    ):
        print(f"  {label:52s}" + _quantiles(values, 3))


def print_heard(about: dict[str, Any]) -> None:
    """Print how many anchors the cells of a hall hear."""
    shares = {int(number): share for number, share in about["heard"].items()}
    for label, low, high in (
        ("fewer than 4", 0, 3),
        ("4 or 5", 4, 5),
        ("6 or 7", 6, 7),
        ("8 or more", 8, 1 << 30),
    ):
        print(
            f"  {label:14s} anchors heard: "
            f"{100.0 * sum(s for n, s in shares.items() if low <= n <= high):5.1f} % of the "
            "cells"
        )


def print_flyable(about: dict[str, Any], accuracy: float) -> None:
    """Print how much can be flown, and the reasons for the rest.

    about : of `summary`; accuracy : m, of the options.
    """
    unit, whole = (
        ("m^2", "this slice of your room") if about["cells"][2] == 1 else ("m^3", "your room")
    )
    print(f"{' x '.join(map(str, about['cells']))} cells of {about['step']:.3g} m")
    print(
        f"{_percent(about['flyable_share'])} of {whole} can be flown "
        f"({about['flyable_size']:.1f} of {about['size']:.1f} {unit}); "
        f"too few anchors heard {_percent(about['too_few_share'])}, imprecise (bound of one "
        f"round over {accuracy:g} m) "
        f"{_percent(about['imprecise_share'])}, two solutions "
        f"{_percent(about['two_solutions_share'])}"
        + (
            f", outside of the anchors' hull {_percent(about['outside_share'])}"
            if about["outside_share"]
            else ""
        )
    )
    if about["bound_flyable"]:
        print(
            "  bound of one round where it can be flown, m: "
            + _quantiles(about["bound_flyable"], 2)
        )


def print_addition(gains: dict[str, Any] | None, before: float) -> None:
    """Print the gain of one more anchor.

    gains : of `best_addition`; before : share that can be flown without it.
    """
    if gains is None:
        print(
            "no place that was tried for one more anchor gains 1 % of the room, or 5 % of precision"
        )
        return
    at = ", ".join(f"{x:.2f}" for x in gains["position"])
    finer = ""
    if gains["bound_before"]:
        finer = (
            f"; the bound where it can be flown now goes from {100.0 * gains['bound_before']:.1f} "
            f"to {100.0 * gains['bound_after']:.1f} cm (median)"
        )
    print(
        f"add an anchor at ({at}): {100.0 * before:.1f} -> "
        f"{100.0 * gains['flyable_share']:.1f} % can be flown{finer}"
    )


def print_design(
    steps: Sequence[dict[str, Any]],
    chosen: dict[str, Any],
    placed: Sequence[dict[str, Any]],
    share: float,
) -> None:
    """Print the steps of a design, the chosen one, and the places of its anchors.

    steps, chosen : of `hall.Step`; placed : of `hall.placements`.
    """
    print(
        f"{'anchors':>8s}{'one for':>9s}{'spacing':>9s}{'flyable':>9s}  bound there, m: "
        "median, 95 %"
    )
    for step in [*steps, chosen]:
        bound = (
            "       -" if step["median"] is None else f"{step['median']:8.2f}{step['most']:8.2f}"
        )
        mark = f"  <- on all cells; wanted {_percent(share)}" if step is chosen else ""
        print(
            f"{step['count']:8d}{step['spacing'] ** 2:5.0f} m^2{step['spacing']:7.1f} "
            f"m{100.0 * step['share']:7.1f} %{bound}{mark}"
        )
    heights = np.array([anchor["position"][2] for anchor in placed])
    print(
        f"heights: {heights.min():.1f} to {heights.max():.1f} m, "
        f"{np.sum(heights < heights.mean())} low and {np.sum(heights >= heights.mean())} high"
    )
    for anchor in placed if len(placed) <= LISTED else ():
        at = ", ".join(f"{x:.1f}" for x in anchor["position"])
        print(
            f"anchor {anchor['id']}: at ({at}), upright, its front turned {anchor['yaw']:.0f} "
            "deg from x towards y"
        )


def print_side(side: dict[str, Any] | None) -> None:
    """Print the result of `Hall.side`."""
    if side:
        print(
            f"at {_percent(side['share'])} of the cells the anchors that are heard lie in a "
            f"plane: {to_copy(side['tag_side'])}"
        )


def print_flights(rows: Sequence[dict[str, Any]]) -> None:
    """Print the rows of `maps.comparison`, each with its "flight"."""
    print(
        "3D, root mean square, m; efficiency: variance of the bound of one round over that of "
        "the estimate"
    )
    print(f"{'flight':20s}" + "".join(f"{label:>10s}" for label in _COLUMNS.values()))
    for row in rows:
        print(f"{row['flight']:20s}" + "".join(f"{row[name]:10.3f}" for name in _COLUMNS))


def print_improvement(found: dict[str, Any]) -> None:
    """Print before and after: the shares of `summary`, and the bound of the flown places."""
    print(f"{'':44s}  before   after")
    for name, label, factor, digits in (
        ("flyable_share", "flyable, % of the room", 100.0, 1),
        ("worst", f"worst bound of {found['points']} places that are flown, m", 1.0, 3),
        ("mean", "mean bound there, m", 1.0, 3),
        ("failing", "of them not flyable, %", 100.0, 1),
    ):
        old, new = (factor * found[when][name] for when in ("before", "after"))
        change = f"  {change_in_words(old, new)}" if old and factor == 1.0 else ""
        print(f"{label:44s}{old:8.{digits}f}{new:8.{digits}f}{change}")
    for anchor in found["placed"]:
        print(f"anchor {anchor['id']}: {anchor['words']}")


def _percent(share: float) -> str:
    return f"{100.0 * share:.0f} %"


def _quantiles(values: dict[str, float], digits: int) -> str:
    return "  ".join(f"{name} {value:.{digits}f}" for name, value in values.items())


def quantiles(values: np.ndarray) -> dict[str, float] | None:
    """Return {"best", "median", "95 %", "worst"} of values (n,); None without any."""
    if not len(values):
        return None
    return dict(
        zip(
            ("best", "median", "95 %", "worst"), np.quantile(values, [0.0, 0.5, 0.95, 1.0]).tolist()
        )
    )


TOPICS = {
    "plan/flyable": "nav_msgs/msg/OccupancyGrid",
    "plan/precision": "nav_msgs/msg/OccupancyGrid",
    "plan/markers": "visualization_msgs/msg/MarkerArray",
    "uwb/anchors": "uwb_tdoa_msgs/msg/AnchorArray",
}
OCCUPIED = {FLYABLE: 0, TWO_SOLUTIONS: 50, IMPRECISE: 75, TOO_FEW: 100, OUTSIDE: 100}
_CUBES, _SPHERES, _TEXT = 6, 7, 9  # visualization_msgs/msg/Marker


def map_messages(chart: Chart, anchors: Anchors) -> dict[str, Any]:
    """Return {topic: rosbags message} of TOPICS, with the stamp 0.

    plan/flyable : the middle layer, with values of OCCUPIED
    plan/precision : the same layer, the bound (root of its trace) in cm, at most 100; -1 without one
    plan/markers : the surface of the flyable cells, from green (best bound) to red, and the anchors
    """
    store = typestore()
    k = chart.grid.shape[2] // 2
    status = np.array([OCCUPIED[one] for one in range(len(OCCUPIED))])[chart.status]
    cm = np.where(
        np.isfinite(chart.error), np.minimum(np.rint(100.0 * np.minimum(chart.error, 1e3)), 100), -1
    )
    return {
        "plan/flyable": _occupancy(store, chart.grid, status, k, anchors.frame),
        "plan/precision": _occupancy(store, chart.grid, cm, k, anchors.frame),
        "plan/markers": _markers(store, chart, anchors),
        "uwb/anchors": anchors_message(anchors, 0, store)[1],
    }


def write_messages(found: dict[str, Any], path: str | Path) -> None:
    """Write `map_messages` as a bag, transient local, one message per topic.

    An existing bag is replaced.
    """
    store = typestore()
    with new_bag(path, force=True) as writer:
        for topic, message in found.items():
            connection = writer.add_connection(
                f"/{topic}", TOPICS[topic], typestore=store, offered_qos_profiles=[LATCHED_QOS]
            )
            writer.write(connection, 0, store.serialize_cdr(message, TOPICS[topic]))


def _occupancy(store: Typestore, grid: Grid, values: np.ndarray, k: int, frame: str) -> Any:
    """Return the layer k of values (n,), -1 to 100, as an OccupancyGrid at its height."""
    types, (nx, ny, _) = store.types, grid.shape
    header = header_of(store, 0, frame)
    corner = pose_of(store, (*grid.lower[:2], grid.axes[2][k]))
    info = types["nav_msgs/msg/MapMetaData"](header.stamp, grid.step, nx, ny, corner)
    data = np.ascontiguousarray(grid.layer(values, k).ravel(), dtype=np.int8)
    return types["nav_msgs/msg/OccupancyGrid"](header, info, data)


def _markers(store: Typestore, chart: Chart, anchors: Anchors) -> Any:
    types, grid = store.types, chart.grid
    flyable = chart.flyable.reshape(grid.shape)
    # cells beside one that cannot be flown, or at the edge of the grid
    surface = (flyable & ~binary_erosion(flyable)).ravel()
    error = chart.error[surface]
    worse = (error - error.min(initial=np.inf)) / max(np.ptp(error) if len(error) else 0.0, 1e-9)
    green_to_red = np.column_stack(
        [np.minimum(2 * worse, 1), np.minimum(2 - 2 * worse, 1), 0 * worse, 0 * worse + 0.4]
    )
    header = header_of(store, 0, anchors.frame)
    point, colour = types["geometry_msgs/msg/Point"], types["std_msgs/msg/ColorRGBA"]
    cells = [point(*p) for p in grid.points[surface].tolist()]
    colours = [colour(*c) for c in green_to_red.tolist()]
    places = [point(*p) for p in anchors.positions.tolist()]
    markers = [
        _marker(store, header, "flyable", _CUBES, grid.step, points=cells, colors=colours),
        _marker(store, header, "anchors", _SPHERES, 0.15, points=places),
    ]
    for number, p in zip(anchors.ids.tolist(), anchors.positions):
        above = pose_of(store, p + [0, 0, 0.25])
        text = {"id": number, "pose": above, "text": str(number)}
        markers.append(_marker(store, header, "ids", _TEXT, 0.25, **text))
    return types["visualization_msgs/msg/MarkerArray"](markers)


def _marker(
    store: Typestore, header: Any, namespace: str, kind: int, size: float, **fields: Any
) -> Any:
    """Return a blue Marker at the origin; fields : those of the message that differ. size : m."""
    types = store.types
    nothing = np.empty(0, np.uint8)
    empty = types["sensor_msgs/msg/CompressedImage"](header_of(store, 0, ""), "", nothing)
    usual = {
        "header": header,
        "ns": namespace,
        "id": 0,
        "type": kind,
        "action": 0,
        "pose": pose_of(store, (0.0, 0.0, 0.0)),
        "scale": types["geometry_msgs/msg/Vector3"](size, size, size),
        "color": types["std_msgs/msg/ColorRGBA"](0.1, 0.3, 0.9, 1.0),
        "lifetime": types["builtin_interfaces/msg/Duration"](0, 0),
        "frame_locked": False,
        "points": [],
        "colors": [],
        "texture_resource": "",
        "texture": empty,
        "uv_coordinates": [],
        "text": "",
        "mesh_resource": "",
        "mesh_file": types["visualization_msgs/msg/MeshFile"]("", nothing),
        "mesh_use_embedded_materials": False,
    }
    return types["visualization_msgs/msg/Marker"](**{**usual, **fields})
