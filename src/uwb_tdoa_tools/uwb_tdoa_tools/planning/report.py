# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Report a plan: figures for plan.json, lines for the screen, pictures, and ROS messages of the maps.

A picture has one message, to be read at 700 pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.patheffects import withStroke
import matplotlib.pyplot as plt
import numpy as np
from rosbags.typesys.store import Typestore
from scipy.ndimage import binary_erosion
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.files import write_picture

from ..bags.files import new_bag
from ..bags.messages import LATCHED_QOS, anchors_message, header_of, pose_of, typestore
from ..checking.coverage import to_copy
from ..scoring.metrics import change_in_words
from ..scoring.plots import draw_labels
from ..simulation.config import Room, Walls
from .maps import FLYABLE, IMPRECISE, OUTSIDE, TOO_FEW, TWO_SOLUTIONS, AccuracyMap, Chart, Grid
from .precision import NORMAL_99, Installation, Subsets, dilution, ellipses

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


WIDTH, DPI = 7.0, 100  # inches, pixels an inch
STATES = {  # of a cell: what it is called, and its colour
    FLYABLE: ("can be flown", "#7fc97f"),
    TWO_SOLUTIONS: ("two solutions", "#e34a33"),
    IMPRECISE: ("imprecise", "#fdcc8a"),
    TOO_FEW: ("too few anchors heard", "#bdbdbd"),
    OUTSIDE: ("outside of the hull", "#e8e8e8"),
}
ANCHOR, HULL = "#1f3a93", "#8e44ad"
HEARD_COLOURS = [0, 1, 2, 3, 4, 5, 6, 8, 10, 13, 17, 25]  # bounds of the colours of the picture
COLOURS = "viridis_r"
_MOST_LAYERS = 3
_ARROWS_ACROSS = 25.0  # lengths of an arrow at an anchor along the x axis of a map
ACROSS = 9  # ellipses along the longer side of a map
NEAR = 0.1  # of the size of a map: anchors so close to it are drawn too


def plot_precision(
    anchors: Anchors, chart: Chart, path: str | Path, walls: Walls | None = None
) -> None:
    """Draw the bound of one round, with 99 % ellipses, as a PNG.

    The colours span the errors of the flyable places, in cm.
    """
    layers = _layers(chart.grid)
    figure, axes = _panels(chart.grid, len(layers))
    judged = chart.flyable if chart.flyable.any() else np.isfinite(chart.error)
    scale, times = _scale(100.0 * chart.error[judged]), _enlarged(chart)
    for ax, k in zip(axes, layers):
        mesh = _field(ax, chart.grid, chart.grid.layer(100.0 * chart.error, k), *scale)
        _room(ax, anchors, chart.grid, walls)
        _ellipses(ax, chart, k, times)
        ax.set_title(_height(chart.grid, k), fontsize=10)
    _bar(axes, mesh, "bound of one round, cm", 100.0 * chart.error)
    label = "99 % of the estimates" + (f", {times} times as large" if times > 1 else "")
    ellipse = Line2D([], [], color="0.3", marker="o", mfc="none", ls="", label=label)
    marks = [*_anchor_marks(anchors), ellipse]
    _finish(figure, "How precise one round is", marks, dict.fromkeys(axes, anchors), path)


def plot_flyable(
    anchors: Anchors,
    chart: Chart,
    path: str | Path,
    walls: Walls | None = None,
    pairings: Installation | None = None,
) -> None:
    """Draw which cells can be flown, and why the others cannot.

    pairings : Installation whose bifurcation curves are drawn, one for each choice of anchors; or
    None.
    """
    layers, codes = _layers(chart.grid), [code for code in STATES if (chart.status == code).any()]
    figure, axes = _panels(chart.grid, len(layers))
    colours = ListedColormap([colour for _, colour in STATES.values()])
    for ax, k in zip(axes, layers):
        status = chart.grid.layer(chart.status, k)
        _field(ax, chart.grid, status, -0.5, len(STATES) - 0.5, cmap=colours)
        if pairings is not None and min(status.shape) > 1:
            _curves(ax, chart.grid, k, pairings)
        _room(ax, anchors, chart.grid, walls)
        share = f"{np.mean(status == FLYABLE):.0%} can be flown".replace("%", " %")
        ax.set_title(f"{_height(chart.grid, k)}: {share}", fontsize=10)
    marks: list[Any] = []
    for code in codes:
        name, colour = STATES[code]
        label = f"{name}: {100.0 * np.mean(chart.status == code):.0f} %"
        marks.append(Patch(facecolor=colour, label=label))
    marks += _anchor_marks(anchors)
    if pairings is not None:
        label = "bifurcation curve of a choice of anchors"
        marks.append(Line2D([], [], color="0.45", lw=0.8, label=label))
    whole = "this slice" if chart.grid.shape[2] == 1 else "the room"
    title = f"Where it can be flown: {100.0 * chart.flyable.mean():.0f} % of {whole}"
    _finish(figure, title, marks, dict.fromkeys(axes, anchors), path)


def _curves(ax: Axes, grid: Grid, k: int, pairings: Installation) -> None:
    """Draw the bifurcation curves of all choices of anchors in the layer k."""
    points = grid.layer(grid.points, k)
    subsets = Subsets(pairings.anchors, pairings.unknowns)
    for values in subsets.discriminant(points.reshape(-1, 3)).T:
        level = values.reshape(points.shape[:2])
        ax.contour(*grid.axes[:2], level, levels=[0.0], colors="0.45", linewidths=0.6)


def plot_heard(
    anchors: Anchors, chart: Chart, path: str | Path, walls: Walls | None = None
) -> None:
    """Draw how many anchors the middle layer hears."""
    figure, (ax,) = _panels(chart.grid, 1)
    k = chart.grid.shape[2] // 2
    norm = BoundaryNorm(HEARD_COLOURS, 256, extend="max")
    layer = chart.grid.layer(chart.heard.astype(float), k)
    mesh = _field(ax, chart.grid, layer, None, None, cmap="viridis", norm=norm)
    _bar([ax], mesh, "anchors heard")
    _room(ax, anchors, chart.grid, walls)
    share = f"{100.0 * np.mean(chart.heard >= 4):.0f} % hear 4 or more"
    ax.set_title(f"{_height(chart.grid, k)}: {share}", fontsize=10)
    title = f"How many of {len(anchors)} anchors are heard"
    _finish(figure, title, _anchor_marks(anchors), {ax: anchors}, path)


def plot_accuracy(installation: Installation, found: AccuracyMap, path: str | Path) -> None:
    """Draw measured error, its bias, stated error and bound, 3D, seen from above.

    A square shows the root mean square over the height. All have one colour scale.
    """
    anchors, grid = installation.anchors, found.grid
    columns = {
        "measured error (RMSE)": found.rmse,
        "its bias": found.bias,
        "the filter claims": found.claimed,
        "bound of one round": found.bound,
    }
    weight = np.where(np.isfinite(found.rmse[:, 0]), found.count, 0).reshape(grid.shape)
    counted = np.where(weight.any(axis=2), weight.sum(axis=2), np.nan)
    from_above = []
    for values in columns.values():
        squared = np.nan_to_num(np.sum(values**2, axis=1)).reshape(grid.shape) * weight
        from_above.append(100.0 * np.sqrt(squared.sum(axis=2) / counted).T)
    every = np.ravel(from_above)
    scale = _scale(every[np.isfinite(every)])
    ratio = np.ptp(grid.axes[1]) / max(np.ptp(grid.axes[0]), 1e-9)
    size = WIDTH, 1.2 + 0.85 * WIDTH * ratio
    figure, axes = plt.subplots(2, 2, figsize=size, layout="constrained", sharex=True, sharey=True)
    for ax, label, values in zip(axes.ravel(), columns, from_above):
        mesh = _field(ax, grid, values, *scale)
        ax.set_title(label, fontsize=10)
        _room(ax, anchors, grid)
        ax.label_outer()
    _bar(axes.ravel(), mesh, "3D, cm", every)
    title = "Measured error beside what is claimed and what is possible"
    _finish(figure, title, _anchor_marks(anchors), {}, path)


def plot_layouts(
    charts: Sequence[tuple[str, Installation, Chart]], flown: np.ndarray, path: str | Path
) -> None:
    """Draw the bound before and after, of the middle layer, at one scale.

    charts : [(title, Installation, Chart)]; flown : (n, 3) m, places that are flown. The scale is
    that of these places.
    """
    grid = charts[0][2].grid
    k = grid.shape[2] // 2
    figure, axes = _panels(grid, len(charts))
    low, high = flown.min(axis=0)[:2], flown.max(axis=0)[:2]
    inside = ((grid.points[:, :2] >= low) & (grid.points[:, :2] <= high)).all(axis=1)
    errors = np.stack([100.0 * chart.error for _, _, chart in charts])
    scale = _scale(errors[inside & np.isfinite(errors)])
    blocked = any((~chart.grid.layer(chart.flyable, k)).any() for _, _, chart in charts)
    for ax, (title, installation, chart), error in zip(axes, charts, errors):
        mesh = _field(ax, grid, grid.layer(error, k), *scale)
        _hatch(ax, chart, k)
        _room(ax, installation.anchors, grid)
        ax.add_patch(Rectangle(tuple(low), *(high - low).tolist(), fill=False, ec="r", lw=1.5))
        median = np.median(error[inside]) if inside.any() else np.nan
        share = f"{100.0 * chart.flyable.mean():.0f} % can be flown"
        ax.set_title(
            f"{title}: {share}; median bound where it is flown {median:.1f} cm", fontsize=10
        )
    _bar(axes, mesh, "bound of one round, cm", errors)
    marks: list[Any] = [
        *_anchor_marks(charts[0][1].anchors),
        Patch(fill=False, ec="r", label="where it is flown"),
    ]
    if blocked:
        marks.append(Patch(facecolor="white", edgecolor="k", hatch="////", label="cannot be flown"))
    hatched = "hatched: cannot be flown" if blocked else "all can be flown"
    labelled = {ax: installation.anchors for ax, (_, installation, _) in zip(axes, charts)}
    _finish(figure, f"Before and after, {_height(grid, k)}; {hatched}", marks, labelled, path)


def _layers(grid: Grid) -> list[int]:
    """Return the layers to draw: all, or three spread over the height."""
    n = grid.shape[2]
    return (
        list(range(n))
        if n <= _MOST_LAYERS
        else [round(share * (n - 1)) for share in (0.2, 0.5, 0.8)]
    )


def _height(grid: Grid, k: int) -> str:
    return f"z = {grid.axes[2][k]:.2f} m"


def _panels(grid: Grid, count: int) -> tuple[Figure, np.ndarray]:
    """Return a figure with maps one above the other.

    Each is as wide as the picture, or as high as wide if the room is longer along y.
    """
    ratio = min(1.0, grid.shape[1] / grid.shape[0])
    figure, axes = plt.subplots(
        count,
        1,
        figsize=(WIDTH, 1.0 + count * (0.75 * WIDTH * ratio + 0.7)),
        squeeze=False,
        layout="constrained",
    )
    return figure, axes[:, 0]


def _scale(values: np.ndarray) -> tuple[float, float]:
    """Return the ends of the colours: 98 % of values (n,) lie between them."""
    low, high = np.quantile(values, [0.01, 0.99]) if len(values) else (0.0, 1.0)
    return float(low), float(high if high > low else low + 1.0)


def _field(
    ax: Axes, grid: Grid, layer: np.ndarray, low: float | None, high: float | None, **look: Any
) -> Any:
    """Draw the colours of a layer (ny, nx) between two values. Infinite cells are white.

    look : colour map and norm, if they are others
    """
    layer = np.where(np.isfinite(layer), layer, np.nan)
    look = {"cmap": COLOURS, "vmin": low, "vmax": high, "shading": "nearest"} | look
    return ax.pcolormesh(*grid.axes[:2], layer, rasterized=True, **look)


def _bar(
    axes: Sequence[Axes] | np.ndarray, drawn: Any, label: str, values: np.ndarray | None = None
) -> None:
    """Draw a colour scale with an arrow at each end that some values exceed.

    Without values the colours have bounds, and an arrow of their own.
    """
    extend, (low, high) = "max", drawn.get_clim()
    if values is not None:
        finite = values[np.isfinite(values)]
        beyond = bool((finite < low).any()), bool((finite > high).any())
        extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[beyond]
    bar = axes[0].figure.colorbar(
        drawn, ax=list(axes), extend=extend, shrink=0.9 / len(axes) ** 0.5, pad=0.02, aspect=25
    )
    if values is not None:
        even = np.linspace(low, high, 5).tolist()
        bar.set_ticks(even, labels=[f"{tick:.3g}" for tick in even])
    bar.set_label(label, fontsize=9)


def _hatch(ax: Axes, chart: Chart, k: int) -> None:
    """Draw lines on a lighter ground over cells that cannot be flown."""
    x, y, _ = chart.grid.axes
    edges = [
        np.append(axis - 0.5 * chart.grid.step, axis[-1] + 0.5 * chart.grid.step) for axis in (x, y)
    ]
    blocked = np.ma.masked_equal(~chart.grid.layer(chart.flyable, k), False)
    ax.pcolormesh(*edges, blocked.astype(float), cmap=ListedColormap(["white"]), alpha=0.6, lw=0)
    if min(blocked.shape) > 1 and blocked.any():
        ax.contourf(
            x,
            y,
            blocked.filled(0).astype(float),
            levels=[0.5, 1.5],
            colors="none",
            hatches=["////"],
        )


def _room(ax: Axes, anchors: Anchors, grid: Grid, walls: Walls | None = None) -> None:
    """Draw the axes of a map, with walls, hull and anchors.

    The margin keeps anchors at the edge of the map, or a little beyond it, inside the picture.
    """
    x, y, _ = grid.axes
    size = max(np.ptp(x), np.ptp(y), grid.step)
    margin = 0.5 * grid.step + 0.03 * size
    for x0, y0, x1, y1, _ in walls.segments if walls else ():
        ax.plot([x0, x1], [y0, y1], "k-", lw=2.5)
    ax.set(xlabel="x, m", ylabel="y, m", aspect="equal")
    low, high = np.array([x[0], y[0]]), np.array([x[-1], y[-1]])
    above = anchors.positions[:, :2]
    beyond = np.maximum(low - above, above - high).max(axis=1)
    near = np.vstack([low, high, above[beyond < NEAR * size]])
    left, bottom = near.min(axis=0) - margin
    right, top = near.max(axis=0) + margin
    ax.set(xlim=(left, right), ylim=(bottom, top))
    if len(anchors) > 2 and np.linalg.matrix_rank(above - above[0], 1e-6) == 2:
        corners = ConvexHull(above).vertices
        ax.plot(
            *above[np.append(corners, corners[0])].T,
            color=HULL,
            lw=1.2,
            ls="--",
            scalex=False,
            scaley=False,
            path_effects=[withStroke(linewidth=2.4, foreground="w")],
        )
    ax.plot(
        *above.T,
        "^",
        color=ANCHOR,
        mec="w",
        mew=0.6,
        ms=float(np.clip(60.0 / np.sqrt(len(anchors)), 4.0, 8.0)),
        zorder=5,
        scalex=False,
        scaley=False,
    )
    oriented = np.isfinite(anchors.orientations).all(axis=1)
    if oriented.any():
        ax.quiver(
            *above[oriented].T,
            *_directions(anchors)[oriented].T,
            color=ANCHOR,
            width=0.005,
            scale=_ARROWS_ACROSS,
            edgecolor="w",
            linewidth=0.5,
            zorder=5,
        )


def _directions(anchors: Anchors) -> np.ndarray:
    """Return the directions of the fronts of anchors from above: (n, 2), 0 without an orientation."""
    out = np.zeros((len(anchors), 2))
    oriented = np.isfinite(anchors.orientations).all(axis=1)
    if oriented.any():
        fronts = Rotation.from_quat(anchors.orientations[oriented]).apply([1.0, 0.0, 0.0])
        out[oriented] = fronts[:, :2]
    return out


def _anchor_marks(anchors: Anchors) -> list[Line2D]:
    """Return the marks of the hull and of the anchors for a legend."""
    oriented = np.isfinite(anchors.orientations).all(axis=1).any()
    label = "anchor, arrow: its front" if oriented else "anchor"
    return [
        Line2D([], [], color=HULL, lw=1.2, ls="--", label="hull of the anchors"),
        Line2D([], [], color=ANCHOR, marker="^", ls="", label=label),
    ]


def _some_cells(chart: Chart, k: int) -> np.ndarray:
    """Return which cells of the layer k have an ellipse: (n,) bool."""
    every = max(1, max(chart.grid.shape[:2]) // ACROSS)
    rows = np.zeros(chart.grid.shape, bool)
    rows[every // 2 :: every, every // 2 :: every, k] = True
    return rows.ravel() & chart.flyable


def _enlarged(chart: Chart) -> int:
    """Return the enlargement at which ellipses can be seen and hardly cover each other."""
    rows = np.any([_some_cells(chart, k) for k in _layers(chart.grid)], axis=0)
    if not rows.any():
        return 1
    every = max(1, max(chart.grid.shape[:2]) // ACROSS)
    return max(
        1,
        round(
            0.35 * every * chart.grid.step / np.median(ellipses(chart.covariance[rows])[0][:, 0])
        ),
    )


def _ellipses(ax: Axes, chart: Chart, k: int, times: int) -> None:
    """Draw 99 % ellipses of some cells that can be flown."""
    rows = _some_cells(chart, k)
    if rows.any():
        semi, angle = ellipses(chart.covariance[rows])
        ax.add_collection(
            EllipseCollection(
                2 * times * semi[:, 0],
                2 * times * semi[:, 1],
                np.rad2deg(angle),
                units="xy",
                offsets=chart.grid.points[rows, :2],
                offset_transform=ax.transData,
                facecolors="none",
                edgecolors="w",
                linewidths=1.2,
            )
        )


def _finish(
    figure: Figure,
    title: str,
    marks: Sequence[Any],
    labelled: dict[Axes, Anchors],
    path: str | Path,
) -> None:
    """Draw title and legend, then the ids of anchors, and write the picture."""
    figure.suptitle(title, fontsize=12)
    longest = max(len(str(mark.get_label())) for mark in marks)
    columns = 3 if longest < 28 else 2
    figure.legend(
        handles=marks, loc="outside lower center", ncols=columns, frameon=False, fontsize=9
    )
    figure.set_dpi(DPI)
    figure.draw_without_rendering()  # labels need the final layout
    for ax, anchors in labelled.items():
        arrow = _directions(anchors) * np.ptp(ax.get_xlim()) / _ARROWS_ACROSS
        # labels avoid the middles and the tips of the arrows
        avoided = np.vstack([anchors.positions[:, :2] + share * arrow for share in (0.5, 1.0)])
        draw_labels(ax, anchors.ids.tolist(), anchors.positions[:, :2], avoided, ANCHOR)
    write_picture(path, figure, DPI)
    plt.close(figure)
