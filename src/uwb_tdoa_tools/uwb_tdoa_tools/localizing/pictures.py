# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Draw an estimate, its residuals, and where anchors are heard."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.files import write_picture, write_text
from uwb_tdoa_ekf.core.memory import USED
from uwb_tdoa_ekf.results import VERDICTS, Odometry, Residuals

from ..scoring.metrics import has_innovation, within

if TYPE_CHECKING:
    from collections.abc import Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


RESIDUAL_COLUMNS = "t", "a", "b", "residual", "std", "weight", "verdict"
SHOWN = 20  # largest number of pairs in the picture: those with the most TDOAs
FEWEST = 20  # fewest TDOAs of a pair in the picture
# range of the axes in robust standard deviations; larger residuals are drawn at the edge
SPREAD = 6.0
ZONE_COLUMNS = "x", "y", "seconds", "heard", "tdoas_per_s", "used", "left", "std", "anchors"
SHORTEST = 0.5  # s in a zone that is listed


@dataclass(frozen=True)
class PairResiduals:
    """Residuals of the TDOAs between two anchors a < b, or of the ranges to one anchor, a = b.

    Attributes
    ----------
    t : (n,) s.
    value, std : (n,) m, of d_ab or of the range.
    explained : (n,) bool, within three standard deviations.
    """

    a: int
    b: int
    t: np.ndarray
    value: np.ndarray
    std: np.ndarray
    explained: np.ndarray

    @property
    def name(self) -> str:
        """Return the name for pictures."""
        return f"{self.a} - {self.b}" if self.a != self.b else f"range {self.a}"


def explained(residuals: Residuals) -> np.ndarray:
    """Return which innovations are within three expected standard deviations: (n,) bool."""
    with np.errstate(invalid="ignore"):  # NaN without an innovation
        return has_innovation(residuals) & (residuals.innovation**2 <= 9.0 * residuals.variance)


def by_pair(residuals: Residuals) -> list[PairResiduals]:
    """Return the residuals of each pair of anchors, in the order of their ids."""
    there, fits = has_innovation(residuals), explained(residuals)
    low, high = np.minimum(residuals.a, residuals.b), np.maximum(residuals.a, residuals.b)
    sign = np.where(residuals.a <= residuals.b, 1.0, -1.0)
    pairs = []
    order = np.flatnonzero(there)[np.lexsort((high[there], low[there]))]
    begins = np.flatnonzero((np.diff(low[order]) != 0) | (np.diff(high[order]) != 0)) + 1
    for rows in np.split(order, begins) if len(order) else ():
        a, b = int(low[rows[0]]), int(high[rows[0]])
        value, std = (sign * residuals.innovation)[rows], np.sqrt(residuals.variance[rows])
        pairs.append(PairResiduals(a, b, residuals.t[rows], value, std, fits[rows]))
    return pairs


def write_residuals(path: Path, residuals: Residuals) -> None:
    """Write one CSV line per TDOA: s, ids, m, m, weight 0 to 1, verdict.

    Cells are empty if the filter had no innovation.
    """
    rows = zip(
        residuals.t,
        residuals.a,
        residuals.b,
        residuals.innovation,
        np.sqrt(residuals.variance),
        residuals.weight,
        residuals.verdict,
    )
    lines = (
        f"{t:.6f},{int(a)},{int(b)},"
        f"{f'{value:.4f},{std:.4f},{weight:.3f}' if np.isfinite(value) else ',,'},"
        f"{VERDICTS[int(verdict)]}"
        for t, a, b, value, std, weight, verdict in rows
    )
    write_text(path, "\n".join([",".join(RESIDUAL_COLUMNS), *lines, ""]))


def draw_residuals(path: Path, residuals: Residuals, title: str) -> None:
    """Draw the residuals of each pair over time, in one row each, with outliers in red."""
    from matplotlib.figure import Figure  # takes a second to import

    found = by_pair(residuals)
    pairs = sorted((one for one in found if len(one.t) >= FEWEST), key=lambda one: -len(one.t))[
        :SHOWN
    ]
    pairs = sorted(pairs, key=lambda one: (one.a, one.b))
    if not pairs:
        return
    figure = Figure(figsize=(11.0, 1.2 + 0.62 * len(pairs)), layout="constrained")
    axes = np.atleast_1d(figure.subplots(len(pairs), 1, sharex=True, sharey=True))
    begin = min(one.t[0] for one in pairs)
    limit = max(
        0.3,
        SPREAD * 1.4826 * float(np.median(np.abs(np.concatenate([one.value for one in pairs])))),
    )
    tick = np.floor(8.0 * limit) / 10.0  # m, whole tens of cm
    for ax, one in zip(axes, pairs):
        shown = np.clip(one.value, -limit, limit)
        ax.axhline(0.0, color="0.8", lw=0.8)
        ax.plot(one.t - begin, shown, ".", ms=2.0, color="tab:blue")
        ax.plot(
            (one.t - begin)[~one.explained], shown[~one.explained], ".", ms=3.0, color="tab:red"
        )
        ax.set(ylim=(-limit, limit), yticks=(-tick, 0.0, tick))
        ax.set_yticklabels([f"{-100 * tick:.0f}", "0", f"{100 * tick:.0f}"], fontsize=7)
        ax.set_ylabel(one.name, rotation=0, ha="right", va="center", fontsize=9)
        summary = f"{100 * np.median(one.value):+.0f} cm, {one.explained.mean():.0%} explained"
        ax.text(1.005, 0.5, summary, transform=ax.transAxes, fontsize=8, va="center")
    axes[-1].set_xlabel("time of the recording [s]")
    left_out = (
        f"; {len(found) - len(pairs)} pairs with fewer TDOAs are not shown"
        if len(pairs) < len(found)
        else ""
    )
    figure.suptitle(
        (
            f"{title}: residuals of each pair of anchors [cm]; red: more than three standard "
            f"deviations{left_out}"
        ),
        fontsize=10,
    )
    write_picture(path, figure)


@dataclass(frozen=True)
class Zone:
    """A square in which the tag was.

    Attributes
    ----------
    x, y : m, middle of the square.
    seconds : time of the tag in it.
    heard : anchors per second, median.
    tdoas_per_s : TDOAs per second.
    used : share of the TDOAs that the filter used.
    left : m, 1.48 times the median absolute residual of these, or NaN.
    std : m, standard deviation of the position, median.
    anchors : ((id, share of the seconds with this anchor), ...), most heard first.
    """

    x: float
    y: float
    seconds: float
    heard: float
    tdoas_per_s: float
    used: float
    left: float
    std: float
    anchors: tuple[tuple[int, float], ...]


def zones_of(odometry: Odometry, residuals: Residuals, size: float) -> list[Zone]:
    """Return [Zone] of the squares of some size, m, in which the tag was."""
    if len(odometry) < 2 or not len(residuals.t):
        return []
    near = (residuals.t >= odometry.t[0]) & (residuals.t <= odometry.t[-1])
    t, used, left = residuals.t[near], residuals.verdict[near] == USED, residuals.innovation[near]
    ends = np.stack([residuals.a[near], residuals.b[near]], axis=1)
    places = [np.floor(odometry.p[:, k] / size).astype(int) for k in range(2)]
    row = np.minimum(np.searchsorted(odometry.t, t), len(odometry) - 1)
    std = np.sqrt(np.trace(odometry.covariance[:, :3, :3], axis1=1, axis2=2))
    steps = np.minimum(np.diff(odometry.t, append=odometry.t[-1]), 1.0)
    second = np.floor(t - t[0]).astype(int) if len(t) else np.empty(0, int)
    label = np.unique(np.stack(places, axis=1), axis=0, return_inverse=True)[1].reshape(-1)
    out = []
    for k in range(label.max() + 1):
        here, mine = label == k, label[row] == k
        seconds = float(steps[here].sum())
        if seconds < SHORTEST:
            continue
        heard = np.unique(np.column_stack([np.repeat(second[mine], 2), ends[mine].ravel()]), axis=0)
        each = np.unique(heard[:, 0], return_counts=True)[1]
        ids, count = np.unique(heard[:, 1], return_counts=True)
        most = np.argsort(-count, kind="stable")
        good = mine & used
        x, y = (float((part[here][0] + 0.5) * size) for part in places)
        out.append(
            Zone(
                x,
                y,
                seconds,
                float(np.median(each)) if len(each) else 0.0,
                mine.sum() / seconds,
                float(used[mine].mean()) if mine.any() else 0.0,
                float(1.4826 * np.median(np.abs(left[good]))) if good.any() else np.nan,
                float(np.median(std[here])),
                tuple(zip(ids[most].tolist(), (count[most] / max(len(each), 1)).tolist())),
            )
        )
    return out


def write_zones(path: Path, zones: list[Zone]) -> None:
    """Write one CSV line per Zone, with the columns ZONE_COLUMNS and anchors as "id:share"."""
    lines = (
        "".join(f"{getattr(zone, name):.3f}," for name in ZONE_COLUMNS[:-1])
        + " ".join(f"{anchor}:{share:.2f}" for anchor, share in zone.anchors)
        for zone in zones
    )
    write_text(path, "\n".join([",".join(ZONE_COLUMNS), *lines, ""]))


def draw_zones(path: Path, zones: list[Zone], anchors: Anchors, size: float, title: str) -> None:
    """Draw maps of the number of heard anchors and of the standard deviation of the position.

    size : m, of a square
    """
    import matplotlib.pyplot as plt  # takes a second to import

    figure, axes = plt.subplots(1, 2, figsize=(13.0, 5.5), layout="constrained")
    heard = {anchor for zone in zones for anchor, _ in zone.anchors}
    silent = np.array([anchor not in heard for anchor in anchors.ids.tolist()])
    middles = (np.array([getattr(zone, name) for zone in zones]) for name in "xy")
    # all squares from the first to the last; those without a zone stay white
    x, y = (np.arange(one.min(), one.max() + 0.5 * size, size) for one in middles)
    for ax, name, label, colour_map in (
        (axes[0], "heard", "anchors heard in a second", "viridis"),
        (axes[1], "std", "standard deviation, cm", "viridis_r"),
    ):
        values = np.full((len(y), len(x)), np.nan)
        for zone in zones:
            value = getattr(zone, name)
            values[round((zone.y - y[0]) / size), round((zone.x - x[0]) / size)] = (
                value if name == "heard" else 100.0 * value
            )
        mesh = ax.pcolormesh(x, y, values, shading="nearest", cmap=colour_map)
        ax.plot(*anchors.positions[~silent, :2].T, "k^", ms=4, label="heard")
        ax.plot(*anchors.positions[silent, :2].T, "rx", ms=5, label="never heard")
        ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        figure.colorbar(mesh, ax=ax, label=label)
    axes[0].legend(loc="best")
    figure.suptitle(title, fontsize=10)
    write_picture(path, figure)
    plt.close(figure)


ELLIPSES = 60  # along the path
SIGMAS = 3.0
MARGIN = 0.5  # m around anchors and path


def estimate_figure(
    odometry: Odometry, anchors: Anchors, spans: Sequence[tuple[float, float]], title: str
) -> Figure:
    """Return a Figure of an Odometry among Anchors, from above, from the side, and over time.

    Parameters
    ----------
    spans : [(begin, end)] s, in which the tag was lost.
    title : one line.
    """
    from matplotlib.figure import Figure  # takes a second to import

    figure = Figure(figsize=(13.0, 6.6), layout="constrained")
    grid = figure.add_gridspec(3, 3, width_ratios=(1.4, 1.4, 1.0))
    lost = within(odometry.t, spans)
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
    return figure


def _plane(
    ax: Axes, odometry: Odometry, anchors: Anchors, lost: np.ndarray, plane: tuple[int, int, str]
) -> None:
    """Draw path, ellipses and anchors in a plane: (two axes, name)."""
    from matplotlib.collections import EllipseCollection
    from matplotlib.lines import Line2D

    from ..scoring.plots import labels

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
