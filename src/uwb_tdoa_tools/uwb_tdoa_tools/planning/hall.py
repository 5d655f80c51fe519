# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Judge and design a hall in which a tag hears the anchors within the radio's reach.

A design tries regular patterns, from sparse to dense, until the wanted share can be flown.
`scipy.optimize.minimize` chooses margins, stagger and heights. Then anchors are removed one by
one while the share can still be flown, and the neighbours of each are moved.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.optimize import minimize, minimize_scalar
from scipy.spatial.transform import Rotation
from scipy.special import expit

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError

from .. import parallel
from ..checking.coverage import sides_of
from ..simulation.rooms import facing, heard_at
from .layout import UNUSABLE
from .maps import TOO_FEW, Chart, Judged, judge

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..parallel import Progress
    from ..simulation.rooms import Room, Walls
    from .layout import Goal
    from .maps import Grid

PLANE_NEAREST = 10  # anchors that are looked at for a plane through them
JUDGED_AT_ONCE = 100_000  # times points: anchors that are judged at once, wherever they are
TILES = 16  # parts of a hall that a process takes at once


@dataclass(frozen=True)
class Hall:
    """A hall with walls, and its anchors. It can be pickled.

    goal : Goal, without its points; anchors : Anchors; reach : m; walls : Walls, or None
    """

    goal: Goal
    anchors: Anchors
    reach: float
    walls: Walls | None = None

    def heard(self, points: np.ndarray) -> list[np.ndarray]:
        """Return the rows of the anchors that are heard at points (n, 3) m: list of (k,) arrays."""
        return heard_at(points, self.anchors.positions, self.reach, self.walls)

    def chart(self, grid: Grid, jobs: int | None = None, dask: str | None = None) -> Chart:
        """Return the Chart of a Grid. jobs, dask : as for `parallel.over`."""
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
        whole, heard = self.unheard(points), np.zeros(len(points), int)
        for cells, (found, counts) in zip(tiles, (each for batch in results for each in batch)):
            whole.assign(cells, found)
            heard[cells] = counts
        return Chart(whole.covariance, whole.error, whole.status, grid, heard)

    def __call__(self, batch: Sequence[np.ndarray]) -> list[tuple[Judged, np.ndarray]]:
        """Return the Judged, and the number of anchors heard, of each part of a hall."""
        return [self.judge(points) for points in batch]

    def judge(self, points: np.ndarray) -> tuple[Judged, np.ndarray]:
        """Return (Judged, anchors heard (n,)) of points (n, 3) m that are near each other."""
        rows = self.heard(points)
        counts = np.array([len(each) for each in rows], int)
        whole = self.unheard(points)
        near = np.unique(np.concatenate([np.empty(0, int), *rows]))
        for count in np.unique(counts[counts > self.goal.installation.unknowns]):
            cells = np.flatnonzero(counts == count)
            installation = self.goal.installed(self.anchors.only(near), int(count))
            columns = np.searchsorted(near, np.stack([rows[cell] for cell in cells]))
            whole.assign(cells, judge(points[cells], installation, self.goal.demand, columns))
        return whole, counts

    def _tiles(self, points: np.ndarray) -> list[np.ndarray]:
        """Return the rows of points (n, 3) m that are near each other: list of (k,) arrays.

        It is one array if there are few points and anchors.
        """
        if len(points) * len(self.anchors) <= JUDGED_AT_ONCE:
            return [np.arange(len(points))]
        at = np.floor(
            (points[:, :2] - points[:, :2].min(axis=0)) / max(0.5 * self.reach, 1e-3)
        ).astype(int)
        _, tile = np.unique(at, axis=0, return_inverse=True)
        order = np.argsort(tile.ravel(), kind="stable")
        return np.split(order, np.flatnonzero(np.diff(tile.ravel()[order])) + 1)

    def unheard(self, points: np.ndarray) -> Judged:
        """Return the Judged of points (n, 3) m that hear no anchor."""
        n, k = len(points), self.goal.installation.dimensions
        return Judged(np.full((n, k, k), np.inf), np.full(n, np.inf), np.full(n, TOO_FEW))

    def with_anchors(self, anchors: Anchors) -> Hall:
        """Return the same Hall with other Anchors."""
        return replace(self, anchors=anchors)

    def changed(
        self, before: Judged, points: np.ndarray, anchors: Anchors, places: np.ndarray
    ) -> Judged:
        """Return the Judged of points (n, 3) m with other Anchors.

        before : Judged with the anchors of this Hall; places : (m, 3) m, the only places at which they differ.
        """
        away = np.min(np.linalg.norm(points[:, None] - places, axis=2), axis=1)
        near = np.flatnonzero(away <= self.reach)
        whole, other = before.subset(np.arange(len(points))), self.with_anchors(anchors)
        for cells in self._tiles(points[near]) if len(near) else ():
            whole.assign(near[cells], other.judge(points[near[cells]])[0])
        return whole

    def side(self, points: np.ndarray) -> dict[str, Any] | None:
        """Return where the heard anchors lie in a plane: {"share": of points, "tag_side": values}.

        The tag's side must be given there. points : (n, 3) m. None if there is no such point, or if the
        height is known and the anchors have one height.
        """
        sides = []
        for point, rows in zip(points, self.heard(points)):
            if len(rows) > self.goal.installation.unknowns:
                positions = self.anchors.positions[rows]
                sides.append(
                    sides_of(
                        positions[
                            np.argsort(np.linalg.norm(positions - point, axis=1))[:PLANE_NEAREST]
                        ]
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


# margins, stagger and heights of the first pattern, see `_pattern`
FIRST = (0.4, 0.4, 0.1, 0.1, 0.85)
LOWEST = 0.5  # m above the floor, of an anchor
# of the reach: the first spacing, the densest, and the ratio of each to the one before
SPACINGS = (1.2, 0.25, 0.88)
MOST = 400  # anchors of a pattern that is tried
SEARCH_CELLS = 500  # places that a search looks at
# of the logarithm of the bound, over which a place turns from precise to imprecise while a search
# goes on
SOFT = 0.15
FINE = 0.02  # weight of the mean logarithm of the bound beside the share
TRIALS = 60  # layouts of one pattern
MOVES = 40  # places of an anchor that is moved
TURNS = 10  # directions of an anchor
MOVED = 3  # neighbours of an anchor that is taken away
FARTHEST = 4.0  # m that they are moved by, along each axis


@dataclass(frozen=True)
class Step:
    """One layout of a search.

    count : anchors; spacing : m, root of the area over their number; share : that can be flown;
    median, most : m, median and 95 % of the bound there, None if there is none.
    """

    count: int
    spacing: float
    share: float
    median: float | None
    most: float | None


def step_of(found: Judged, anchors: Anchors, room: Room) -> Step:
    """Return the Step of Judged places."""
    errors, size = found.error[found.flyable], room.upper - room.lower
    quantiles = np.quantile(errors, [0.5, 0.95]).tolist() if len(errors) else [None, None]
    return Step(
        len(anchors),
        float(np.sqrt(size[0] * size[1] / len(anchors))),
        float(found.flyable.mean()),
        *quantiles,
    )


def design(
    hall: Hall, room: Room, points: np.ndarray, share: float, progress: Progress
) -> tuple[list[Anchors], list[Step]]:
    """Return (layouts, steps) of a Room: Anchors, the fewest first, and Steps.

    points : (n, 3) m, the cells to be flown; hall : Hall, without its anchors. Raises
    InputError if no pattern gives that share.
    """
    points = points[np.sort(np.random.default_rng(0).permutation(len(points))[:SEARCH_CELLS])]
    quick, steps, anchors, x = _quick(hall), [], None, np.array(FIRST)
    for columns, rows in _patterns(room, hall.reach):
        progress(f"layouts of {columns} x {rows} anchors")
        x = _best_pattern(quick, room, points, columns, rows, x)
        found = _pattern(room, columns, rows, x)
        judged = _judged_everywhere(hall.with_anchors(found), points)
        steps.append(step_of(judged, found, room))
        if anchors is not None:
            break  # one pattern more, to say what it costs
        if judged.flyable.mean() >= share:
            anchors = found
    if anchors is None:
        most = max(steps, key=lambda step: step.share)
        raise InputError(
            f"share: {100.0 * share:.0f} % of the hall cannot be flown at an accuracy of "
            f"{hall.goal.demand.accuracy:g} m; {most.count} "
            f"anchors give {100.0 * most.share:.0f} %. Give a larger --accuracy, a smaller "
            "--share, or a known height (--planar, --with height)."
        )
    layouts, more = _without_spare_anchors(hall, room, points, share, anchors, progress)
    progress("directions of the anchors")
    return [_with_best_yaws(quick, points, each) for each in layouts[:2]] + layouts[
        2:
    ], _best_steps(steps + more)


def _best_steps(steps: list[Step]) -> list[Step]:
    """Return the Steps with a larger share than all with fewer anchors, the fewest first."""
    out: list[Step] = []
    for step in sorted(steps, key=lambda step: (step.count, -step.share)):
        if not out or step.share > out[-1].share:
            out.append(step)
    return out


def _patterns(room: Room, reach: float) -> list[tuple[int, int]]:
    """Return the (columns, rows) of patterns, from sparse to dense."""
    first, last, ratio = SPACINGS
    size, out, spacing = (
        room.upper - room.lower,
        [],
        first * min(reach, float((room.upper - room.lower)[:2].max())),
    )
    while spacing > last * min(reach, float(size[:2].max())):
        columns, rows = (max(2, round(side / spacing)) for side in size[:2])
        if columns * rows >= 4 and columns * rows <= MOST and (columns, rows) not in out:
            out.append((columns, rows))
        spacing *= ratio
    return out


def _pattern(room: Room, columns: int, rows: int, x: np.ndarray) -> Anchors:
    """Return the Anchors of a pattern.

    x : (5,) from 0 to 1: margins along x and y, up to half a pitch; stagger of each second row, up to
    a quarter; heights of the two halves of the anchors, which alternate.
    """
    size, (i, j) = room.upper - room.lower, np.indices((columns, rows)).reshape(2, -1)
    pitch = size[:2] / (np.array([columns, rows]) - 1 + x[:2])
    across = np.column_stack([i, j]) * pitch + 0.5 * x[:2] * pitch
    across[:, 0] += np.where(j % 2 == 1, 0.25, -0.25) * x[2] * pitch[0]
    height = LOWEST + np.where((i + j) % 2 == 0, x[3], x[4]) * max(size[2] - LOWEST, 0.0)
    return _facing(np.column_stack([np.clip(across, 0.0, size[:2]), height]) + room.lower, room)


def _facing(positions: np.ndarray, room: Room) -> Anchors:
    return facing(positions.round(1), room.centre)


def _best_pattern(
    quick: Hall, room: Room, points: np.ndarray, columns: int, rows: int, start: np.ndarray
) -> np.ndarray:
    """Return x of the best `_pattern`, from a start."""
    simplex = np.vstack([start, start + np.where(start < 0.5, 0.3, -0.3) * np.eye(len(start))])
    found = minimize(
        lambda x: _cost(quick, points, _pattern(room, columns, rows, np.clip(x, 0.0, 1.0))),
        start,
        method="Nelder-Mead",
        bounds=[(0.0, 1.0)] * len(start),
        options={"maxfev": TRIALS, "initial_simplex": simplex},
    )
    return np.clip(found.x, 0.0, 1.0)


def _judged_everywhere(hall: Hall, points: np.ndarray) -> Judged:
    """Return the Judged of points all over a hall."""
    nothing = hall.unheard(points)
    return hall.changed(nothing, points, hall.anchors, hall.anchors.positions)


def _cost(quick: Hall, points: np.ndarray, anchors: Anchors) -> float:
    return _cost_of(_judged_everywhere(quick.with_anchors(anchors), points), quick)


def _cost_of(found: Judged, quick: Hall) -> float:
    """Return the cost: a smooth share of imprecise places, and a little of the bound."""
    log = np.log(np.minimum(found.error, UNUSABLE))
    return float(
        np.mean(expit((log - np.log(quick.goal.demand.accuracy)) / SOFT)) + FINE * log.mean()
    )


def _without_spare_anchors(
    hall: Hall, room: Room, points: np.ndarray, share: float, anchors: Anchors, progress: Progress
) -> tuple[list[Anchors], list[Step]]:
    """Return layouts with fewer and fewer anchors, and a Step for each try.

    Each layout still has the wanted share. The fewest come first.
    """
    layouts, steps, quick = [anchors], [], _quick(hall)
    while len(anchors) > hall.goal.installation.unknowns + 1:
        progress(f"layouts of {len(anchors) - 1} anchors")
        now = _judged_everywhere(quick.with_anchors(anchors), points)
        costs = []
        for row in range(len(anchors)):
            rest = anchors.only(np.delete(np.arange(len(anchors)), row))
            costs.append(
                _cost_of(quick.changed(now, points, rest, anchors.positions[[row]]), quick)
            )
        gone = int(np.argmin(costs))
        fewer = anchors.only(np.delete(np.arange(len(anchors)), gone))
        for row in np.argsort(np.linalg.norm(fewer.positions - anchors.positions[gone], axis=1))[
            :MOVED
        ]:
            fewer = _moved(quick, room, points, fewer, int(row))
        judged = _judged_everywhere(hall.with_anchors(fewer), points)
        steps.append(step_of(judged, fewer, room))
        if judged.flyable.mean() < share:
            break
        anchors = fewer
        layouts.insert(0, anchors)
    return layouts, steps


def _quick(hall: Hall) -> Hall:
    """Return the same Hall, judged without second solutions."""
    return replace(hall, goal=replace(hall.goal, demand=replace(hall.goal.demand, quick=True)))


def _moved(quick: Hall, room: Room, points: np.ndarray, anchors: Anchors, row: int) -> Anchors:
    """Return Anchors with one moved to the least cost nearby."""
    start = anchors.positions[row]
    low = np.maximum(
        start - FARTHEST, room.lower + [0.0, 0.0, min(LOWEST, (room.upper - room.lower)[2])]
    )
    high = np.minimum(start + FARTHEST, room.upper)
    before = _judged_everywhere(quick.with_anchors(anchors), points)

    def at(place: np.ndarray) -> Anchors:
        return _facing(
            np.insert(np.delete(anchors.positions, row, axis=0), row, place, axis=0), room
        )

    def cost(place: np.ndarray) -> float:
        return _cost_of(quick.changed(before, points, at(place), np.stack([start, place])), quick)

    options = {"maxfev": MOVES, "initial_simplex": _simplex(start, low, high)}
    found = minimize(
        cost, start, method="Nelder-Mead", bounds=list(zip(low, high)), options=options
    )
    return at(found.x) if found.fun < cost(start) else anchors


def _simplex(start: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return (4, 3) m places to begin with, half-way to the farther bound along each axis."""
    steps = np.where(high - start >= start - low, high - start, low - start)
    return np.vstack([start, start + 0.5 * np.diag(steps)])


def _with_best_yaws(quick: Hall, points: np.ndarray, anchors: Anchors) -> Anchors:
    """Return Anchors, each turned about the vertical to the least cost."""
    for row in range(len(anchors)):
        before = _judged_everywhere(quick.with_anchors(anchors), points)

        def at(yaw: float, row: int = row) -> Anchors:
            orientations = anchors.orientations.copy()
            orientations[row] = Rotation.from_euler("z", yaw, degrees=True).as_quat().round(4)
            return Anchors(anchors.ids, anchors.positions, orientations, anchors.frame)

        def cost(yaw: float, row: int = row, before: Judged = before) -> float:
            return _cost_of(
                quick.changed(before, points, at(yaw, row), anchors.positions[[row]]), quick
            )

        found = minimize_scalar(
            cost, bounds=(-180.0, 180.0), method="bounded", options={"maxiter": TURNS}
        )
        if found.fun < _cost_of(before, quick):
            anchors = at(round(float(found.x)), row)
    return anchors


def placements(anchors: Anchors) -> list[dict[str, Any]]:
    """Return [{"id", "position" m, "yaw" degrees}] of Anchors that stand upright."""
    yaws = Rotation.from_quat(anchors.orientations).as_euler("ZYX", degrees=True)[:, 0].round()
    return [
        {"id": number, "position": position, "yaw": yaw}
        for number, position, yaw in zip(
            anchors.ids.tolist(), anchors.positions.tolist(), yaws.tolist()
        )
    ]
