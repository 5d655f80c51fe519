"""Who is heard where, and how well: the view of whoever installs anchors."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.files import write_filled, write_text
from uwb_tdoa_ekf.core.verdicts import USED
from uwb_tdoa_ekf.results import Odometry, Residuals

from ..scoring.plots import plt

COLUMNS = "x", "y", "seconds", "heard", "tdoas_per_s", "used", "left", "std", "anchors"
LEAST = 0.5  # s in a zone, of which less tells nothing


@dataclass(frozen=True)
class Zone:
    """A square in which the tag was. x, y : m, of its middle; seconds in it; heard : anchors in a
    second, median; tdoas_per_s; used : share of them; left : m, 1.48 times the median of what is
    left of those used, NaN without; std : m, of the position, median; anchors : ((id, share of the
    seconds in which it was heard), ...), those heard most first.
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
    """[Zone] of squares of some size, m, that the tag was in, by an Odometry and the Residuals that
    came with it.
    """
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
        if seconds < LEAST:
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


def write_csv(path: Path, zones: list[Zone]) -> None:
    """Write [Zone] as CSV: a line for each, COLUMNS; anchors as "id:share" one after the other."""
    lines = [",".join(COLUMNS)]
    for zone in zones:
        numbers = [f"{getattr(zone, name):.3f}" for name in COLUMNS[:-1]]
        lines.append(
            ",".join(
                [*numbers, " ".join(f"{anchor}:{share:.2f}" for anchor, share in zone.anchors)]
            )
        )
    write_text(path, "\n".join([*lines, ""]))


def draw(path: Path, zones: list[Zone], anchors: Anchors, size: float, title: str) -> None:
    """Maps of how many anchors are heard, and of the standard deviation of the position."""
    figure, axes = plt.subplots(1, 2, figsize=(13.0, 5.5), layout="constrained")
    heard = {anchor for zone in zones for anchor, _ in zone.anchors}
    silent = np.array([anchor not in heard for anchor in anchors.ids.tolist()])
    x, y = (np.unique([getattr(zone, name) for zone in zones]) for name in "xy")
    x, y = (np.arange(some.min(), some.max() + 0.5 * size, size) for some in (x, y))
    for ax, name, label, colours in (
        (axes[0], "heard", "anchors heard in a second", "viridis"),
        (axes[1], "std", "standard deviation, cm", "viridis_r"),
    ):
        values = np.full((len(y), len(x)), np.nan)
        for zone in zones:
            value = getattr(zone, name)
            values[round((zone.y - y[0]) / size), round((zone.x - x[0]) / size)] = (
                value if name == "heard" else 100.0 * value
            )
        mesh = ax.pcolormesh(x, y, values, shading="nearest", cmap=colours)
        ax.plot(*anchors.positions[~silent, :2].T, "k^", ms=4, label="heard")
        ax.plot(*anchors.positions[silent, :2].T, "rx", ms=5, label="never heard")
        ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        figure.colorbar(mesh, ax=ax, label=label)
    axes[0].legend(loc="best")
    figure.suptitle(title, fontsize=10)
    write_filled(path, partial(figure.savefig, dpi=110))
    plt.close(figure)
