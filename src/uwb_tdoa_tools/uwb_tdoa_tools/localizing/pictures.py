"""The path from above and from the side with its uncertainty, and over time."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.files import write_filled
from uwb_tdoa_ekf.results import Odometry

from ..scoring.labels import labels

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes

ELLIPSES = 60  # along the path
SIGMAS = 3.0
MARGIN = 0.5  # m around anchors and path


def draw(
    path: Path,
    odometry: Odometry,
    anchors: Anchors,
    spans: Sequence[tuple[float, float]],
    title: str,
) -> None:
    """Draw an Odometry among Anchors. spans : [(begin, end)] s, in which the tag was lost; title :
    a line.
    """
    from matplotlib.figure import Figure  # takes a second to import

    figure = Figure(figsize=(13.0, 6.6), layout="constrained")
    grid = figure.add_gridspec(3, 3, width_ratios=(1.4, 1.4, 1.0))
    lost = np.any(
        [(odometry.t >= begin) & (odometry.t <= end) for begin, end in spans]
        or [np.zeros(len(odometry), bool)],
        axis=0,
    )
    for column, (u, v, name) in enumerate(((0, 1, "from above"), (0, 2, "from the side"))):
        _plane(figure.add_subplot(grid[:, column]), odometry, anchors, lost, (u, v, name))
    std = np.sqrt(np.einsum("nii->ni", odometry.covariance[:, :3, :3]))
    limit = 1.1 * SIGMAS * float(np.quantile(std, 0.98)) if len(std) else 1.0
    begin = odometry.t[0] if len(odometry) else 0.0
    for k, axis in enumerate("xyz"):
        ax = figure.add_subplot(grid[k, 2])
        since, value = odometry.t - begin, odometry.p[:, k]
        ax.fill_between(
            since,
            value - SIGMAS * std[:, k],
            value + SIGMAS * std[:, k],
            color="tab:blue",
            alpha=0.25,
            lw=0,
            label="3 sigma",
        )
        ax.plot(since, value, lw=0.9, color="tab:blue", label="estimate")
        for first, last in spans:
            ax.axvspan(first - begin, last - begin, color="tab:red", alpha=0.2, lw=0)
        inside = value[~lost] if (~lost).any() else value
        if len(inside):
            ax.set_ylim(inside.min() - max(limit, MARGIN), inside.max() + max(limit, MARGIN))
        ax.set_ylabel(f"{axis} [m]")
        ax.grid(alpha=0.25)
    ax.set_xlabel("time of the estimate [s]")
    figure.suptitle(title, fontsize=11)
    write_filled(path, partial(figure.savefig, dpi=110))


def _plane(
    ax: Axes, odometry: Odometry, anchors: Anchors, lost: np.ndarray, plane: tuple[int, int, str]
) -> None:
    """Path, ellipses and anchors in a plane: (two axes, name)."""
    from matplotlib.collections import EllipseCollection
    from matplotlib.lines import Line2D

    u, v, name = plane
    known = odometry.p[~lost] if (~lost).any() else odometry.p
    if len(odometry):
        some = np.unique(np.linspace(0, len(odometry) - 1, ELLIPSES).astype(int))
        values, vectors = np.linalg.eigh(odometry.covariance[some][:, (u, v)][:, :, (u, v)])
        width, height = 2.0 * SIGMAS * np.sqrt(np.maximum(values, 0.0)).T
        turned = np.degrees(np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0]))
        ax.add_collection(
            EllipseCollection(
                width,
                height,
                turned,
                units="xy",
                offsets=odometry.p[some][:, (u, v)],
                transOffset=ax.transData,
                facecolor="tab:blue",
                edgecolor="none",
                alpha=0.12,
            )
        )
        path = np.where(lost[:, None], np.nan, odometry.p)
        ax.plot(path[:, u], path[:, v], lw=1.0, color="tab:blue")
        ax.plot(*np.where(lost[:, None], odometry.p, np.nan)[:, (u, v)].T, lw=1.0, color="tab:red")
        ax.plot(*odometry.p[0, [u, v]], "o", ms=6, mfc="white", color="tab:blue")
        ax.plot(*odometry.p[-1, [u, v]], "s", ms=5, color="tab:blue")
    ax.plot(anchors.positions[:, u], anchors.positions[:, v], "^", ms=8, color="0.2")
    for names, place in labels(anchors.ids.tolist(), anchors.positions[:, (u, v)]):
        ax.annotate(
            names, (place[0], place[1]), textcoords="offset points", xytext=(6, 5), fontsize=9
        )
    both = np.concatenate([anchors.positions, known])[:, (u, v)]
    lower, upper = both.min(axis=0) - MARGIN, both.max(axis=0) + MARGIN
    ax.set(
        xlim=(lower[0], upper[0]),
        ylim=(lower[1], upper[1]),
        aspect="equal",
        title=name,
        xlabel=f"{'xyz'[u]} [m]",
        ylabel=f"{'xyz'[v]} [m]",
    )
    ax.grid(alpha=0.25)
    if v == 1:
        marks = [
            Line2D([], [], color="tab:blue", label="estimate"),
            Line2D([], [], color="tab:blue", alpha=0.25, lw=6, label="3 sigma"),
            Line2D([], [], color="tab:red", label="lost"),
            Line2D([], [], color="tab:blue", marker="o", mfc="white", ls="", label="begin"),
            Line2D([], [], color="tab:blue", marker="s", ls="", label="end"),
            Line2D([], [], color="0.2", marker="^", ls="", label="anchor"),
        ]
        ax.legend(
            handles=marks, loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=3, fontsize=8
        )
