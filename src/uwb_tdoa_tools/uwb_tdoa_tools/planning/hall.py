"""A hall in which a tag hears the anchors within the radio's reach, not all: cells that hear the same anchors are charted together."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, TYPE_CHECKING

import numpy as np
from matplotlib.colors import BoundaryNorm
from scipy.spatial import Delaunay, QhullError, cKDTree

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.files import write_filled

from .. import parallel
from ..checking.sides import sides_of, to_copy
from ..scoring.plots import plt
from ..simulation.walls import heard_at
from .bifurcation import Subsets
from .optimisation import with_one
from .maps import Chart
from .precision import bound, dilution, information, position_error
from .report import quantiles

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path
    from uwb_tdoa_bias.foundation.anchors import Anchors
    from ..simulation.walls import Walls
    from .goal import Goal
    from .maps import Grid

    # covariance (n, k, k) m^2, dop, hull, ambiguous and flyable, (n,) each, of a Chart
    OfGroup = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]

MOST_HEARD = 10  # nearest anchors that a cell is judged by: more add little, and pairings grow with the fourth power
AT_ONCE = 64  # groups of cells that a process takes at once
ANCHOR_HEIGHT = 4.0  # m above the floor, of an anchor that is proposed
TRIED, LOOKED_AT = 12, 30  # places that are tried for it, the most promising first, and holes that are looked at for each
WORTH = 0.001  # of the cells: less is not worth an anchor
HEARD_COLOURS = [0, 1, 2, 3, 4, 5, 6, 8, 10, 13, 17, 25]  # bounds of the colours of the picture


@dataclass(frozen=True)
class Hall:
    """goal : Goal, whose points are not used; anchors : Anchors; reach : m; walls : Walls, or None. Can be pickled."""

    goal: Goal
    anchors: Anchors
    reach: float
    walls: Walls | None = None

    def heard(self, points: np.ndarray) -> list[np.ndarray]:
        """Rows of the anchors that are heard at points (n, 3) m, the nearest first: list of (k,) arrays."""
        return [
            rows[np.argsort(np.linalg.norm(self.anchors.positions[rows] - p, axis=1))]
            for p, rows in zip(points, heard_at(points, self.anchors.positions, self.reach, self.walls))
        ]

    def chart(self, grid: Grid, jobs: int | None = None, dask: str | None = None) -> tuple[Chart, np.ndarray]:
        """(Chart, heard (n,) anchors at each cell) over a Grid. jobs, dask : as of `parallel.over`."""
        points = grid.points
        heard = self.heard(points)
        groups: dict[tuple[int, ...], list[int]] = {}
        for cell, rows in enumerate(heard):
            groups.setdefault(tuple(sorted(rows[:MOST_HEARD].tolist())), []).append(cell)
        n, k, unknowns = len(points), self.goal.installation.dimensions, self.goal.installation.unknowns
        covariance, dop = np.full((n, k, k), np.inf), np.full(n, np.inf)
        hull, ambiguous, flyable = np.zeros(n, bool), np.ones(n), np.zeros(n, bool)
        items = [(rows, points[cells]) for rows, cells in groups.items() if len(rows) > unknowns]
        cells_of = [cells for rows, cells in groups.items() if len(rows) > unknowns]
        batches = [items[at : at + AT_ONCE] for at in range(0, len(items), AT_ONCE)]
        results = (each for batch in parallel.over(self, batches, jobs, dask, unit="part of the hall") for each in batch)
        for cells, (its, one, inside, share, good) in zip(cells_of, results):
            covariance[cells], dop[cells], hull[cells], ambiguous[cells], flyable[cells] = its, one, inside, share, good
        return Chart(grid, covariance, position_error(covariance), dop, hull, ambiguous, flyable), np.array([len(rows) for rows in heard])

    def __call__(self, batch: Sequence[tuple[Sequence[int], np.ndarray]]) -> list[OfGroup]:
        return [self.of_group(*item) for item in batch]

    def of_group(self, rows: Sequence[int], points: np.ndarray) -> OfGroup:
        """Covariance, dop, hull, ambiguous and flyable of a Chart at points (n, 3) m that hear the anchors in rows; hull : seen from
        above."""
        n = len(points)
        try:
            installation = self.goal.installed(self.anchors.only(np.array(rows)))
            above, subsets = Delaunay(installation.anchors.positions[:, :2]), Subsets(installation.anchors, installation.unknowns)
        except (InputError, QhullError):  # in a plane: nothing tells its sides apart; or on a line
            k = self.goal.installation.dimensions
            return np.full((n, k, k), np.inf), np.full(n, np.inf), np.zeros(n, bool), np.ones(n), np.zeros(n, bool)
        inside, ambiguous = above.find_simplex(points[:, :2]) >= 0, subsets.ambiguous(points)
        unique = subsets.unique(points, installation, self.goal.criterion, ambiguous)
        covariance = bound(information(points, installation))
        return covariance, np.linalg.norm(dilution(points, installation), axis=1), inside, ambiguous, inside & unique

    def side(self, points: np.ndarray) -> dict[str, Any] | None:
        """{"share": of points (n, 3) m, "tag_side": values}: where those that are heard lie in a plane, so that the side of it must be
        given; None where nowhere, or where the height is known and they have one height."""
        sides = [
            sides_of(self.anchors.positions[rows[:MOST_HEARD]])
            for rows in self.heard(points)
            if len(rows) > self.goal.installation.unknowns
        ]
        needed = [one for one in sides if len(one) == 2 or one and self.goal.installation.unknowns == 3]
        most = max(sorted(set(needed)), key=needed.count, default=None)
        return None if most is None else {"share": needed.count(most) / len(points), "tag_side": list(most)}

    def addition(self, chart: Chart, floor: float) -> dict[str, Any] | None:
        """{"position": (3,) m, "gain": share of the cells} of the best place for one more anchor, None where nearly all can be flown. floor
        : m."""
        holes = np.flatnonzero(~chart.flyable)
        if len(holes) < 0.02 * len(chart.flyable):
            return None
        points = chart.grid.points
        tree = cKDTree(points[holes])
        best: tuple[float, list[float] | None] = (0, None)
        spread = holes[np.linspace(0, len(holes) - 1, min(len(holes), 50 * TRIED)).astype(int)]
        around = tree.query_ball_point(points[spread], 0.5 * self.reach, return_length=True)
        for cell in spread[np.argsort(-around, kind="stable")][:TRIED]:
            position = np.array([*points[cell, :2].round(1), floor + ANCHOR_HEIGHT])
            near = holes[tree.query_ball_point(position, self.reach)]
            near = near[np.linspace(0, len(near) - 1, min(len(near), LOOKED_AT)).astype(int)] if len(near) else near
            more = Hall(self.goal, with_one(self.anchors, position), self.reach, self.walls)
            gained = 0
            for rows, point in zip(more.heard(points[near]), points[near]):
                nearest = sorted(rows[:MOST_HEARD].tolist())
                if len(nearest) > self.goal.installation.unknowns:
                    gained += int(more.of_group(nearest, point[None])[4][0])
            share = len(tree.query_ball_point(position, self.reach)) / max(len(near), 1)
            best = max(best, (gained * share, position.tolist()), key=lambda one: one[0])
        return {"position": best[1], "gain": float(best[0] / len(chart.flyable))}


def summary(chart: Chart, heard: np.ndarray) -> dict[str, Any]:
    """Figures of a Chart and heard (n,): {"heard": {number: share of the cells}, "flyable_share", "bound_flyable": quantiles, m}."""
    numbers, counts = np.unique(heard, return_counts=True)
    return {
        "cells": list(chart.grid.shape),
        "step": chart.grid.step,
        "heard": dict(zip(map(str, numbers.tolist()), (counts / len(heard)).tolist())),
        "flyable_share": float(chart.flyable.mean()),
        "too_few_share": float(np.mean(~np.isfinite(chart.error) & ~chart.hull)),
        "bound_flyable": quantiles(chart.error[chart.flyable]),
    }


def say(about: dict[str, Any], addition: dict[str, Any] | None, side: dict[str, Any] | None) -> None:
    """Print what `summary`, `Hall.addition` and `Hall.side` found."""
    print(f"{' x '.join(map(str, about['cells']))} cells of {about['step']:.3g} m")
    shares = {int(number): share for number, share in about["heard"].items()}
    for label, low, high in (("fewer than 4", 0, 3), ("4 or 5", 4, 5), ("6 or 7", 6, 7), ("8 or more", 8, 1 << 30)):
        print(f"  {label:14s} anchors heard: {100.0 * sum(s for n, s in shares.items() if low <= n <= high):5.1f} % of the cells")
    print(
        f"{100.0 * about['flyable_share']:.0f} % of the cells can be flown; the others hear too few, are not among those they hear, or have two solutions"
    )
    if about["bound_flyable"]:
        print("  bound of one round there, m: " + "  ".join(f"{name} {value:.2f}" for name, value in about["bound_flyable"].items()))
    if side:
        print(f"at {100.0 * side['share']:.0f} % of the cells the anchors that are heard lie in a plane: {to_copy(side['tag_side'])}")
    if addition and addition["position"] and addition["gain"] > WORTH:
        at = ", ".join(f"{x:.1f}" for x in addition["position"])
        print(f"one more anchor would help most near ({at}): {100.0 * (about['flyable_share'] + addition['gain']):.1f} % of the cells")


def plot(hall: Hall, chart: Chart, heard: np.ndarray, path: str | Path) -> None:
    """How many are heard, and how precise a round is where it can be flown; seen from above, of the middle layer."""
    anchors = hall.anchors
    x, y, z = chart.grid.axes
    k, wide = len(z) // 2, np.ptp(x) > 1.2 * np.ptp(y)
    shape, ratio = ((2, 1) if wide else (1, 2)), (np.ptp(y) + 1.0) / (np.ptp(x) + 1.0)
    size = (11.0, 2.0 * 11.0 * ratio + 1.5) if wide else (15.0, 7.0 * ratio + 1.5)
    figure, axes = plt.subplots(*shape, figsize=size, layout="constrained", squeeze=False)
    norm = BoundaryNorm(HEARD_COLOURS, 256, extend="max")
    flown = np.where(chart.flyable, 100.0 * chart.error, np.nan)
    top = np.nanquantile(flown, 0.98) if chart.flyable.any() else 1.0
    for ax, values, label, kind in (
        (axes.flat[0], heard.astype(float), "anchors heard", {"norm": norm, "cmap": "viridis"}),
        (axes.flat[1], flown, "bound of one round, cm; grey: not to be flown", {"cmap": "viridis_r", "vmin": 0.0, "vmax": top}),
    ):
        ax.set_facecolor("0.75")
        mesh = ax.pcolormesh(x, y, chart.grid.layer(values, k), shading="nearest", rasterized=True, **kind)
        ax.plot(*anchors.positions[:, :2].T, "r^", ms=float(np.clip(60.0 / np.sqrt(len(anchors)), 1.5, 6.0)), mew=0.0)
        for x0, y0, x1, y1, _ in hall.walls.segments if hall.walls else ():
            ax.plot([x0, x1], [y0, y1], "w-", lw=2.0)
        ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        figure.colorbar(mesh, ax=ax, label=label, shrink=0.85)
    figure.suptitle(f"{len(anchors)} anchors, z = {z[k]:.2f} m: {100.0 * chart.flyable.mean():.0f} % can be flown", fontsize=11)
    write_filled(path, partial(figure.savefig, dpi=110))
    plt.close(figure)
