# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draw maps and layouts, each with one message, to be read at 700 pixels."""

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
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.files import write_picture

from ..scoring.plots import draw_labels
from ..simulation.config import Walls
from .maps import FLYABLE, IMPRECISE, OUTSIDE, TOO_FEW, TWO_SOLUTIONS, AccuracyMap, Chart, Grid
from .precision import Installation, Subsets, ellipses

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
