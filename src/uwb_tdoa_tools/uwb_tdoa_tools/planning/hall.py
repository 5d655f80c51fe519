"""A hall in which a tag hears the anchors within the radio's reach, not all."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from .. import parallel
from ..checking.coverage import sides_of
from ..simulation.walls import heard_at
from .judging import TOO_FEW, Judged, judge
from .maps import Chart

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.foundation.anchors import Anchors

    from ..simulation.walls import Walls
    from .goal import Goal
    from .maps import Grid

NEAREST = 10  # anchors that are looked at for a plane through them
FEW = 100_000  # times points: anchors that are judged at once, wherever they are
TILES = 16  # parts of a hall that a process takes at once


@dataclass(frozen=True)
class Hall:
    """goal : Goal, whose points are not used; anchors : Anchors; reach : m; walls : Walls, or None.

    Can be pickled.
    """

    goal: Goal
    anchors: Anchors
    reach: float
    walls: Walls | None = None

    def heard(self, points: np.ndarray) -> list[np.ndarray]:
        """Rows of the anchors that are heard at points (n, 3) m: list of (k,) arrays."""
        return heard_at(points, self.anchors.positions, self.reach, self.walls)

    def chart(self, grid: Grid, jobs: int | None = None, dask: str | None = None) -> Chart:
        """Chart over a Grid. jobs, dask : as of `parallel.over`."""
        points = grid.points
        tiles = self._tiles(points)
        batches = [tiles[at : at + TILES] for at in range(0, len(tiles), TILES)]
        results = parallel.over(
            self,
            [[points[cells] for cells in batch] for batch in batches],
            jobs,
            dask,
            unit="part of the hall",
        )
        whole, heard = self.nothing(points), np.zeros(len(points), int)
        for cells, (found, counts) in zip(tiles, (each for batch in results for each in batch)):
            whole.put(cells, found)
            heard[cells] = counts
        return Chart(whole.covariance, whole.error, whole.status, grid, heard)

    def __call__(self, batch: Sequence[np.ndarray]) -> list[tuple[Judged, np.ndarray]]:
        return [self.judge(points) for points in batch]

    def judge(self, points: np.ndarray) -> tuple[Judged, np.ndarray]:
        """(Judged, anchors heard (n,)) at points (n, 3) m that are near each other."""
        rows = self.heard(points)
        counts = np.array([len(each) for each in rows], int)
        whole = self.nothing(points)
        near = np.unique(np.concatenate([np.empty(0, int), *rows]))
        for count in np.unique(counts[counts > self.goal.installation.unknowns]):
            cells = np.flatnonzero(counts == count)
            installation = self.goal.installed(self.anchors.only(near), int(count))
            columns = np.searchsorted(near, np.stack([rows[cell] for cell in cells]))
            whole.put(cells, judge(points[cells], installation, self.goal.demand, columns))
        return whole, counts

    def _tiles(self, points: np.ndarray) -> list[np.ndarray]:
        """Rows of points (n, 3) m that are near each other: list of (k,) arrays.

        One array where there are few points and anchors.
        """
        if len(points) * len(self.anchors) <= FEW:
            return [np.arange(len(points))]
        at = np.floor(
            (points[:, :2] - points[:, :2].min(axis=0)) / max(0.5 * self.reach, 1e-3)
        ).astype(int)
        _, tile = np.unique(at, axis=0, return_inverse=True)
        order = np.argsort(tile.ravel(), kind="stable")
        return np.split(order, np.flatnonzero(np.diff(tile.ravel()[order])) + 1)

    def nothing(self, points: np.ndarray) -> Judged:
        """Judged of points (n, 3) m that hear no anchor."""
        n, k = len(points), self.goal.installation.dimensions
        return Judged(np.full((n, k, k), np.inf), np.full(n, np.inf), np.full(n, TOO_FEW))

    def of(self, anchors: Anchors) -> Hall:
        """The same Hall with other Anchors."""
        return replace(self, anchors=anchors)

    def changed(
        self, before: Judged, points: np.ndarray, anchors: Anchors, places: np.ndarray
    ) -> Judged:
        """Judged of points (n, 3) m with other Anchors, which differ at places (m, 3) m only.
        before : Judged with those of this Hall.
        """
        away = np.min(np.linalg.norm(points[:, None] - places, axis=2), axis=1)
        near = np.flatnonzero(away <= self.reach)
        whole, other = before.part(np.arange(len(points))), self.of(anchors)
        for cells in self._tiles(points[near]) if len(near) else ():
            whole.put(near[cells], other.judge(points[near[cells]])[0])
        return whole

    def side(self, points: np.ndarray) -> dict[str, Any] | None:
        """{"share": of points (n, 3) m, "tag_side": values}: where those that are heard lie in a
        plane, so that the side of it must be given; None where nowhere, or where the height is
        known and they have one height.
        """
        sides = []
        for point, rows in zip(points, self.heard(points)):
            if len(rows) > self.goal.installation.unknowns:
                positions = self.anchors.positions[rows]
                sides.append(
                    sides_of(
                        positions[np.argsort(np.linalg.norm(positions - point, axis=1))[:NEAREST]]
                    )
                )
        needed = [
            one for one in sides if len(one) == 2 or one and self.goal.installation.unknowns == 3
        ]
        most = max(sorted(set(needed)), key=needed.count, default=None)
        return (
            None
            if most is None
            else {"share": needed.count(most) / len(points), "tag_side": list(most)}
        )
