# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Pictures of errors, and labels of anchors."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
import numpy as np

from uwb_tdoa_bias.common.flight import Truth

from .metrics import Estimate, Score
from .phases import TITLES

SHADES = {  # of phases that follow one another
    "at_rest_earlier": "0.9",
    "at_rest_before": "tab:gray",
    "first_3_s": "tab:green",
    "last_3_s": "tab:orange",
    "at_rest_after": "tab:gray",
}
TOGETHER = 0.35  # m; anchors that are nearer to each other in a picture have one label
SIZE, FEW = 10.0, 20  # pt, font size of labels; the font of more than FEW labels is smaller
MOST = 80  # anchors that have labels: more could not be read
# where a label may be, as seen from its anchor
AROUND = ((1, 1), (-1, 1), (1, -1), (-1, -1), (0, 1), (0, -1), (1, 0), (-1, 0))
_LETTER_WIDTH, _LINE_HEIGHT = 0.62, 1.15  # in units of the font size
_LABEL_GAP = 4.0  # pt, between an anchor and its label
_POINT_CLEARANCE = 3.0  # pt, between a label and all points that it avoids
# Costs of a place for a label, in px^2 of another label that it covers
_COST_OF_POINT = 50.0  # px^2 for each point that the label covers
_COST_BEYOND_AXES = 20.0  # px^2 for each px that the label reaches beyond the axes


def error_figure(score: Score, odometry: Estimate, truth: Truth) -> Figure:
    """Return a Figure of the error per axis with its 3-sigma band, the phases, and the path.

    score : of `odometry` against `truth`
    """
    figure = Figure(figsize=(13, 8), layout="constrained")
    axes = figure.subplots(3, 2, width_ratios=(3, 2))
    series, phases = score.series, score.phases()
    std = np.sqrt(np.einsum("nii->ni", series.covariance))
    seconds = series.t - truth.t[0]
    for k, axis in enumerate("xyz"):
        ax = axes[k, 0]
        for name in (name for name in SHADES if name in phases):
            begin = phases[name]["begin"] - truth.t[0]
            ax.axvspan(
                begin,
                begin + phases[name]["duration"],
                color=SHADES[name],
                alpha=0.2,
                lw=0,
                label=TITLES[name] if not k else None,
            )
        ax.fill_between(
            seconds,
            -3 * std[:, k],
            3 * std[:, k],
            color="tab:red",
            alpha=0.2,
            lw=0,
            label=None if k else "3 sigma",
        )
        ax.plot(seconds, series.error[:, k], lw=0.8, label=None if k else "error")
        sizes = np.abs(series.error[np.isfinite(series.error[:, k]), k])
        limit = max(0.5, 1.2 * sizes.max(initial=0.0))
        ax.set(ylabel=f"{axis} [m]", ylim=(-limit, limit))
        ax.grid(alpha=0.3)
    axes[0, 0].legend(loc="upper center", ncols=4, fontsize="small")
    axes[2, 0].set_xlabel("time of the recording [s]")
    with_truth = (odometry.t >= truth.t[0]) & (odometry.t <= truth.t[-1])
    for ax, (i, k) in zip(axes[:, 1], ((0, 1), (0, 2), (1, 2))):
        ax.plot(truth.p[:, i], truth.p[:, k], "k", lw=1.2, label="truth")
        ax.plot(odometry.p[with_truth, i], odometry.p[with_truth, k], lw=0.8, label="estimate")
        ax.set(xlabel=f"{'xyz'[i]} [m]", ylabel=f"{'xyz'[k]} [m]", aspect="equal")
        ax.grid(alpha=0.3)
    axes[0, 1].legend(loc="upper right")
    row = score.row()
    judged = TITLES[score.part].removesuffix(" recording")  # "in the air", if it flies
    figure.suptitle(
        f"{row['flight']}: 3D RMSE {row['rmse_3d']:.3f} m {judged}, "
        f"{phases['whole']['rmse_3d']:.3f} m of all"
    )
    return figure


def two_views() -> tuple[Figure, list[tuple[Axes, tuple[int, int]]]]:
    """Return a Figure, and [(axes, the two coordinates)] for a map from above and from the side."""
    figure = Figure(figsize=(11.0, 5.0), layout="constrained")
    views = list(zip(figure.subplots(1, 2), ((0, 1), (0, 2))))
    for (ax, (u, v)), title in zip(views, ("from above", "from the side")):
        ax.set(xlabel=f"{'xyz'[u]} [m]", ylabel=f"{'xyz'[v]} [m]", title=title)
        ax.set_aspect("equal", adjustable="datalim")
        ax.grid(alpha=0.25)
    return figure, views


def labels(ids: Sequence[int], places: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield (label, (2,) m) of ids at places (n, 2) m; labels that would overlap become one."""
    left = list(range(len(ids)))
    while left:
        here = [k for k in left if np.linalg.norm(places[k] - places[left[0]]) < TOGETHER]
        yield ", ".join(str(ids[k]) for k in here), places[here].max(axis=0)
        left = [k for k in left if k not in here]


def draw_labels(
    ax: Axes, ids: Sequence[int], places: np.ndarray, avoided: np.ndarray, colour: str = "k"
) -> None:
    """Write ids beside places (n, 2) m.

    A label avoids places, the points `avoided` (m, 2) m, other labels and the edges of the axes, as
    far as there is room. All of these are compared in pixels: call figure.draw_without_rendering()
    first, which determines the layout. More than MOST ids are not written.
    """
    if len(ids) > MOST:
        return
    pixels_per_pt, frame = ax.figure.dpi / 72.0, ax.get_window_extent()
    points = ax.transData.transform(np.vstack([places, avoided]))
    boxes = np.empty((0, 4))  # px, of the labels so far: left, bottom, right, top
    size = SIZE if len(ids) <= FEW else 0.75 * SIZE
    for text, at in labels(ids, places):
        x, y = ax.transData.transform(at)
        extent = np.array([_LETTER_WIDTH * len(text), _LINE_HEIGHT])
        half_size = 0.5 * pixels_per_pt * size * extent
        smallest_cost, chosen = np.inf, AROUND[0]
        for side in AROUND:
            centre = np.array([x, y]) + np.array(side) * (half_size + _LABEL_GAP * pixels_per_pt)
            box = np.concatenate([centre - half_size, centre + half_size])
            common = np.minimum(boxes[:, 2:], box[2:]) - np.maximum(boxes[:, :2], box[:2])
            overlap = np.maximum(common, 0.0).prod(axis=1).sum()  # px^2
            clearance = half_size + _POINT_CLEARANCE * pixels_per_pt
            covered = np.sum((np.abs(points - centre) < clearance).all(axis=1))
            beyond_axes = (  # px
                np.maximum(box[2:] - [frame.x1, frame.y1], 0.0).sum()
                + np.maximum([frame.x0, frame.y0] - box[:2], 0.0).sum()
            )
            cost = overlap + _COST_OF_POINT * covered + _COST_BEYOND_AXES * beyond_axes
            if cost < smallest_cost:
                smallest_cost, chosen, chosen_box = cost, side, box
        boxes = np.vstack([boxes, chosen_box])
        shift = np.array(chosen) * (half_size / pixels_per_pt + _LABEL_GAP)
        ax.annotate(
            text,
            (float(at[0]), float(at[1])),
            xytext=tuple(shift),
            textcoords="offset points",
            fontsize=size,
            color=colour,
            ha="center",
            va="center",
            zorder=6,
            path_effects=[withStroke(linewidth=2.5, foreground="w")],
        )
