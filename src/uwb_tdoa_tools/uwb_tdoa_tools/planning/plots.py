"""Pictures of charts: precision, failure, accuracy, layouts."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import EllipseCollection
from matplotlib.colors import ListedColormap
from PIL import Image
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.files import write_filled

from ..scoring.labels import labels
from ..scoring.plots import plt
from .bifurcation import Subsets
from .precision import NORMAL_99, ellipses

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from uwb_tdoa_bias.foundation.anchors import Anchors
    from .accuracy import AccuracyMap
    from .installation import Installation
    from .maps import Chart, Grid

HULL, ENVELOPE, FLYABLE = "magenta", "tab:green", "#ffe680"
_MOST_LAYERS = 3
ACROSS = 9  # ellipses along the longer side of a map
TITLE: dict[str, Any] = {"fontsize": 9, "pad": 12.0}  # above anchors on the upper edge, and their labels


def plot_precision(installation: Installation, chart: Chart, path: str | Path) -> None:
    """The bound at 99 % (2.58 times the root mean square of its axes) with ellipses, and the dilution of precision."""
    layers = _layers(chart.grid)
    figure, axes = _panels(2 * len(layers), 2)
    per_axis = NORMAL_99 * chart.error / np.sqrt(installation.dimensions)
    for row, k in zip(axes, layers):
        for ax, values, label in (
            (row[0], 100.0 * per_axis, "99 % of one axis within +- cm"),
            (row[1], chart.dop, "PDOP"),
        ):
            _field(ax, chart, values, k, label)
            _room(ax, installation, chart.grid, k)
        row[0].set_title(f"{row[0].get_title()}, 99 % ellipses times {_ellipses(row[0], chart, k)}", **TITLE)
    _save(figure, "Precision of one round", path)


def plot_failure(installation: Installation, chart: Chart, path: str | Path) -> None:
    """Where pairings have two solutions: their share, each bifurcation curve, the envelope, hull and flyable area."""
    layers = _layers(chart.grid)
    figure, axes = _panels(2 * len(layers), 2)
    subsets = Subsets(installation.anchors, installation.unknowns)
    x, y, _ = chart.grid.axes
    share = (0.0, max(10.0, 100.0 * np.quantile(chart.ambiguous[chart.hull], 0.98) if chart.hull.any() else 0.0))  # %
    for row, k in zip(axes, layers):
        points = chart.grid.layer(chart.grid.points, k).reshape(-1, 3)
        discriminant = subsets.discriminant(points).reshape(len(y), len(x), -1)
        _field(row[0], chart, 100.0 * chart.ambiguous, k, "pairings with two solutions, %", levels=False, scale=share)
        row[1].contourf(x, y, chart.grid.layer(chart.flyable, k).astype(float), levels=[0.5, 1.5], colors=[FLYABLE])
        for q in range(discriminant.shape[2]):
            row[1].contour(x, y, discriminant[:, :, q], levels=[0.0], colors="0.55", linewidths=0.5)
        if min(len(x), len(y)) > 1:
            worst = discriminant.max(axis=2)
            row[1].contour(x, y, worst, levels=[0.0], colors=ENVELOPE, linewidths=1.8)
        for ax in row:
            _room(ax, installation, chart.grid, k)
    title = "Left: ambiguity. Right: flyable (yellow), curves (grey), envelope (green), hull of the anchors (magenta)"
    _save(
        figure,
        f"{title}\n{100.0 * chart.flyable.mean():.0f} % of {'the slice' if chart.grid.shape[2] == 1 else 'the room'} is flyable",
        path,
    )


def plot_flips(
    installation: Installation, points: np.ndarray, unique: np.ndarray, agrees: np.ndarray,
    mirrors: tuple[np.ndarray, np.ndarray], path: str | Path,
) -> None:  # fmt: skip
    """Result of the brute-force check: points with one solution, with several, and where it contradicts the prediction.

    points (n, 3); unique, agrees (n,) bool; mirrors : (from (m, 2), to (m, 2)), flips to draw as arrows.
    """
    figure, ax = plt.subplots(figsize=(7, 6), layout="constrained")
    for chosen, colour, label in ((unique, "tab:blue", "one solution"), (~unique, "tab:red", "flips for a pairing")):
        ax.plot(*points[chosen, :2].T, "s", color=colour, ms=3, label=f"{label}: {np.mean(chosen):.0%}")
    ax.plot(*points[~agrees, :2].T, "kx", ms=6, label=f"not as predicted: {np.mean(~agrees):.1%}")
    for (x0, y0), (x1, y1) in zip(*mirrors):
        ax.annotate("", (x1, y1), (x0, y0), arrowprops={"arrowstyle": "->", "color": "0.3", "lw": 0.7})
    _anchors(ax, installation.anchors)
    ax.plot(*installation.hull_outline().T, color=HULL, lw=1.2)
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    ax.legend(loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=3, frameon=False)
    _save(figure, "Solved from many starts; arrows lead to the other solution", path)


def plot_accuracy(installation: Installation, found: AccuracyMap, path: str | Path) -> None:
    """Measured bias and RMSE beside the bound and what the filter claims, 3D, one colour scale; seen from above."""
    figure, axes = _panels(4, 2)
    columns = (
        ("bias", found.bias),
        ("RMSE", found.rmse),
        ("filter claims", found.claimed),
        ("bound, one round", found.bound),
    )
    flat = []
    for _, values in columns:
        weight = np.where(np.isfinite(values[:, 0]), found.count, 0)
        squared = found.grid.shape, np.where(weight > 0, np.nan_to_num(np.sum(values**2, axis=1)) * weight, 0.0)
        summed, counted = squared[1].reshape(squared[0]).sum(axis=2), weight.reshape(squared[0]).sum(axis=2)
        flat.append(100.0 * np.sqrt(np.where(counted > 0, summed, np.nan) / np.maximum(counted, 1)).T)
    top = np.nanquantile(np.concatenate([values.ravel() for values in flat]), 0.98)
    x, y, _ = found.grid.axes
    for ax, (label, _), values in zip(axes.ravel(), columns, flat):
        mesh = ax.pcolormesh(x, y, values, cmap="viridis_r", vmin=0.0, vmax=top, shading="nearest", rasterized=True)
        ax.set_title(label)
        _room(ax, installation, found.grid, None)
    figure.colorbar(mesh, ax=axes.ravel().tolist(), label="3D, cm", shrink=0.8)
    _save(figure, "Achieved, claimed and possible error at each place", path)


def plot_layouts(
    charts: Sequence[tuple[str, Installation, Chart]], path: str | Path,
    candidates: tuple[np.ndarray, np.ndarray] | None = None,
) -> None:  # fmt: skip
    """Bound before and after, side by side at one scale. charts : [(title, Installation, Chart)].

    candidates : (positions (n, 3) m, scores (n,) m) of one more anchor, drawn from above and from the side, or None.
    """
    layers = _layers(charts[0][2].grid)
    wide = len(charts) + (candidates is not None)
    figure, axes = _panels(wide * len(layers), wide)
    finite = np.concatenate([chart.error[np.isfinite(chart.error) & chart.hull] for _, _, chart in charts])
    scale = (100.0 * finite.min(), 100.0 * np.quantile(finite, 0.99))
    for row, k in zip(axes, layers):
        for ax, (title, installation, chart) in zip(row, charts):
            _field(ax, chart, 100.0 * chart.error, k, "bound, 3D rms, cm", scale=scale)
            x, y, _ = chart.grid.axes
            _hatch(ax, chart, k)
            _room(ax, installation, chart.grid, k)
            flown = chart.grid.layer(chart.flyable, k).mean()
            ax.set_title(f"{title}{ax.get_title()}: {100.0 * flown:.0f} % flyable", **TITLE)
    if candidates is not None:
        worst_first = np.argsort(-candidates[1])
        positions, scores = candidates[0][worst_first], candidates[1][worst_first]
        for row, (i, j) in zip(axes, ((0, 1), (0, 2), (1, 2))):
            dots = row[-1].scatter(positions[:, i], positions[:, j], c=100.0 * scores, cmap="viridis_r", s=14)
            row[-1].set(xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[j]} [m]", aspect="equal")
            row[-1].set_title("score with one more anchor there", **TITLE)
            figure.colorbar(dots, ax=row[-1], label="cm", shrink=0.8)
    hatched = any(not chart.flyable.all() for _, _, chart in charts)
    _save(figure, "Before and after; hatched: not flyable" if hatched else "Before and after; all is flyable", path)


def _layers(grid: Grid) -> list[int]:
    """Layers to draw: all, or three spread over the height."""
    n = grid.shape[2]
    return list(range(n)) if n <= _MOST_LAYERS else [round(share * (n - 1)) for share in (0.2, 0.5, 0.8)]


def _panels(count: int, wide: int) -> tuple[Figure, np.ndarray]:
    high = -(-count // wide)
    figure, axes = plt.subplots(high, wide, figsize=(4.4 * wide + 0.8, 3.9 * high), squeeze=False, layout="constrained")
    return figure, axes


def _field(
    ax: Axes, chart: Chart, values: np.ndarray, k: int, label: str, levels: bool = True,
    scale: tuple[float, float] | None = None,
) -> None:  # fmt: skip
    """Colours scaled to what lies inside the hull, or to `scale`; contour lines over them."""
    x, y, _ = chart.grid.axes
    inside = values[chart.hull & np.isfinite(values)]
    inside = inside if len(inside) else np.array([0.0, 1.0])
    low, high = scale or (inside.min(), np.quantile(inside, 0.98))
    high = high if high > low else low + 1.0  # all the same
    layer = chart.grid.layer(np.where(np.isfinite(values), values, np.nan), k)
    mesh = ax.pcolormesh(x, y, layer, cmap="viridis_r", vmin=low, vmax=high, shading="nearest", rasterized=True)
    if levels and min(layer.shape) > 1:
        lines = ax.contour(x, y, layer, levels=np.linspace(low, high, 7)[1:-1], colors="k", linewidths=0.4)
        ax.clabel(lines, fontsize=6, fmt="%.1f")
    ax.figure.colorbar(mesh, ax=ax, label=label, shrink=0.85)


def _hatch(ax: Axes, chart: Chart, k: int) -> None:
    """Lines, on a lighter ground, over what is not flyable."""
    x, y, _ = chart.grid.axes
    edges = [np.append(axis - 0.5 * chart.grid.step, axis[-1] + 0.5 * chart.grid.step) for axis in (x, y)]
    blocked = np.ma.masked_equal(~chart.grid.layer(chart.flyable, k), False)
    ax.pcolormesh(*edges, blocked.astype(float), cmap=ListedColormap(["white"]), alpha=0.5, lw=0)
    if min(blocked.shape) > 1 and blocked.any():
        ax.contourf(x, y, blocked.filled(0).astype(float), levels=[0.5, 1.5], colors="none", hatches=["////"])


def _room(ax: Axes, installation: Installation, grid: Grid, k: int | None) -> None:
    ax.plot(*installation.hull_outline().T, color=HULL, lw=1.2)
    _anchors(ax, installation.anchors)
    x, y, z = grid.axes
    half = 0.5 * grid.step
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
    ax.set(xlim=(x[0] - half, x[-1] + half), ylim=(y[0] - half, y[-1] + half))
    if k is not None:
        ax.set_title(f"z = {z[k]:.2f} m", **TITLE)


def _anchors(ax: Axes, anchors: Anchors) -> None:
    p = anchors.positions
    ax.plot(p[:, 0], p[:, 1], "r^", ms=6, clip_on=False)
    turned = np.isfinite(anchors.orientations).all(axis=1)
    if turned.any():
        front = Rotation.from_quat(anchors.orientations[turned]).apply([1.0, 0.0, 0.0])
        ax.quiver(*p[turned, :2].T, *front[:, :2].T, color="r", width=0.005, scale=18)
    for names, at in labels(anchors.ids.tolist(), p[:, :2]):
        place = float(at[0]), float(at[1])
        ax.annotate(names, place, xytext=(3, 3), textcoords="offset points", fontsize=7, color="r")


def _ellipses(ax: Axes, chart: Chart, k: int) -> int:
    """99 % ellipses of some cells inside the hull, enlarged so that they can be seen. Returns by how much."""
    every = max(1, max(chart.grid.shape[:2]) // ACROSS)
    rows = np.zeros(chart.grid.shape, bool)
    rows[every // 2 :: every, every // 2 :: every, k] = True
    rows = rows.ravel() & chart.hull & np.isfinite(chart.error)
    if not rows.any():
        return 1
    semi, angle = ellipses(chart.covariance[rows])
    enlarged = max(1, round(0.4 * every * chart.grid.step / np.median(semi[:, 0])))
    ax.add_collection(
        EllipseCollection(
            2 * enlarged * semi[:, 0], 2 * enlarged * semi[:, 1], np.rad2deg(angle), units="xy",
            offsets=chart.grid.points[rows, :2], offset_transform=ax.transData, facecolors="none", edgecolors="w",
            linewidths=0.8,
        )
    )  # fmt: skip
    return enlarged


def _save(figure: Figure, title: str, path: str | Path) -> None:
    figure.suptitle(title, fontsize=10)
    figure.set_dpi(80)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    image = Image.frombuffer("RGBA", canvas.get_width_height(), canvas.buffer_rgba())
    plt.close(figure)
    # 256 colours are enough, and a third of the size
    few = image.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    write_filled(path, lambda file: few.save(file, "PNG", optimize=True))
