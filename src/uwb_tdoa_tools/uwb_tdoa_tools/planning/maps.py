# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Judge places: whether a tag can be flown there, and if not, why.

A place hears too few anchors, is imprecise, has two solutions, or can be flown. Measured flights check
the precision. In a hall a tag hears the anchors within the radio's reach; a room in which it hears all is a hall with
an infinite reach.

A design tries regular patterns, from sparse to dense, until the wanted share can be flown.
`scipy.optimize.minimize` chooses margins, stagger and heights. Then anchors are removed one by
one while the share can still be flown, and the neighbours of each are moved.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import minimize, minimize_scalar
from scipy.spatial.transform import Rotation
from scipy.special import expit

from uwb_tdoa_bias.common.anchors import Anchors, FlyableVolume
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import SENSOR_NAMES, Flight

from .. import parallel
from ..checking.coverage import sides_of
from ..choices import ACCURACY
from ..cli import Progress
from ..scoring.evaluation import evaluate
from ..simulation.config import Room, Walls, facing, heard_at
from .precision import (
    CLEAR,
    UNUSABLE,
    Installation,
    Subsets,
    bound,
    information,
    other_solutions,
    position_error,
)

# gives the same items, and prints how many are done
Wrap = Callable[[Iterable[Any]], Iterable[Any]]

# States of a place. OUTSIDE of the hull counts with "pairings" only.
FLYABLE, TWO_SOLUTIONS, IMPRECISE, TOO_FEW, OUTSIDE = range(5)
_EVERYWHERE = Room(np.full(3, -np.inf), np.full(3, np.inf))


@dataclass(frozen=True)
class Demand:
    """What is asked of a place. Raises InputError.

    room : Room in which a second solution counts; accuracy : m, largest bound of one round;
    criterion : of CRITERIA; quick : True to look for no second solution, and to leave out the second
    term of the bound. A search needs no more.
    """

    room: Room = _EVERYWHERE
    accuracy: float = ACCURACY
    criterion: str = "round"
    quick: bool = False

    def __post_init__(self) -> None:
        if not 0.0 < self.accuracy < np.inf:
            raise InputError(
                f"accuracy: {self.accuracy!r} m is none; give the largest bound of one round, "
                "above 0, e.g. 0.3."
            )


@dataclass(frozen=True)
class Judged:
    """States of n places.

    covariance : (n, k, k) m^2, bound of one round; error : (n,) m, root of its trace; status : (n,)
    int, FLYABLE or the reason.
    """

    covariance: np.ndarray
    error: np.ndarray
    status: np.ndarray

    @property
    def flyable(self) -> np.ndarray:
        """Whether each place can be flown: (n,) bool."""
        return self.status == FLYABLE

    def subset(self, rows: np.ndarray) -> Judged:
        """Return the Judged of some of its places."""
        return Judged(self.covariance[rows], self.error[rows], self.status[rows])

    def assign(self, rows: np.ndarray, found: Judged) -> None:
        """Overwrite the states at `rows` (m,) by those of `found`, m places in this order, in place.

        So a map can be judged in groups of places, such as those that hear equally many anchors.
        """
        self.covariance[rows] = found.covariance
        self.error[rows] = found.error
        self.status[rows] = found.status


def unheard(points: np.ndarray, k: int) -> Judged:
    """Return the Judged, in k dimensions, of points (n, 3) m that hear too few anchors."""
    n = len(points)
    return Judged(np.full((n, k, k), np.inf), np.full(n, np.inf), np.full(n, TOO_FEW))


def judge(
    points: np.ndarray,
    installation: Installation,
    demand: Demand,
    columns: np.ndarray | None = None,
) -> Judged:
    """Return the Judged of points (n, 3) m.

    columns : (n, K) rows of the anchors that are heard at each point, in order; None for all.
    """
    heard = len(installation.anchors) if columns is None else columns.shape[1]
    if heard <= installation.unknowns:
        return unheard(points, installation.dimensions)
    covariance = bound(information(points, installation, not demand.quick, columns))
    error = position_error(covariance)
    status = np.where(error <= demand.accuracy, FLYABLE, IMPRECISE)
    if demand.quick:
        pass
    elif demand.criterion == "pairings":
        ambiguous = Subsets(installation.anchors, installation.unknowns).ambiguous(points) > 0.0
        status[ambiguous] = TWO_SOLUTIONS
        status[~installation.inside_hull(points)] = OUTSIDE
    else:
        misfit, _ = other_solutions(points, installation, demand.room, columns)
        status[misfit <= CLEAR] = TWO_SOLUTIONS
    return Judged(covariance, error, status)


MOST_CELLS = 4_000_000


@dataclass(frozen=True)
class Grid:
    """Cubes side by side.

    lower : (3,) m, corner of the first; step : m, size of a cube; shape : (nx, ny, nz).
    """

    lower: np.ndarray
    step: float
    shape: tuple[int, int, int]

    @classmethod
    def box(cls, lower: ArrayLike, upper: ArrayLike, step: float) -> Grid:
        """Return cubes of `step` m that cover the box from lower (3,) to upper (3,), m.

        Raises InputError.
        """
        lower, upper = np.asarray(lower, dtype=float), np.asarray(upper, dtype=float)
        if not 0.0 < step < np.inf:
            raise InputError(
                f"step: {step!r} m is not the size of a cell; give one above 0, e.g. 0.1."
            )
        if not (upper > lower).all():
            raise InputError(
                f"room: {lower.tolist()} to {upper.tolist()} m is empty; give X0 X1 Y0 Y1 (Z0 "
                "Z1), each rising."
            )
        shape = np.ceil((upper - lower) / step - 1e-6)
        if np.prod(shape) > MOST_CELLS:
            raise InputError(
                f"step: {step:g} m makes {np.prod(shape):.0f} cells, more than {MOST_CELLS}; "
                "take it larger."
            )
        return cls(
            0.5 * (lower + upper - step * shape), float(step), tuple(shape.astype(int).tolist())
        )

    @classmethod
    def slice(cls, x: Sequence[float], y: Sequence[float], height: float, step: float) -> Grid:
        """Return one layer of cells, centred on `height`, m. x and y : (lower, upper), m."""
        return cls.box((x[0], y[0], height - 0.5 * step), (x[1], y[1], height + 0.5 * step), step)

    @property
    def axes(self) -> list[np.ndarray]:
        """Centres of the cells along x, y and z, m."""
        return [low + self.step * (np.arange(n) + 0.5) for low, n in zip(self.lower, self.shape)]

    @property
    def points(self) -> np.ndarray:
        """Centres of the cells: (nx ny nz, 3) m, z running fastest."""
        return np.stack(np.meshgrid(*self.axes, indexing="ij"), axis=-1).reshape(-1, 3)

    def layer(self, values: np.ndarray, k: int) -> np.ndarray:
        """Return the layer k of values (n, ...) of all cells, to draw: (ny, nx, ...)."""
        return values.reshape(*self.shape, *values.shape[1:])[:, :, k].swapaxes(0, 1)


@dataclass(frozen=True)
class Chart(Judged):
    """The Judged of all cells of a grid.

    grid : Grid; heard : (n,) number of anchors.
    """

    grid: Grid
    heard: np.ndarray

    @property
    def std(self) -> np.ndarray:
        """Bound along x, y (and z): (n, k) m."""
        return np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2))

    def volume(self, anchors: Anchors, dimensions: int) -> FlyableVolume:
        """Return the FlyableVolume of this chart, among Anchors."""
        return FlyableVolume(
            self.grid.lower,
            np.full(3, self.grid.step),
            self.flyable.reshape(self.grid.shape),
            self.error.reshape(self.grid.shape),
            anchors.ids,
            anchors.positions,
            anchors.frame,
            dimensions == 2,
        )


FEWEST = 20  # estimates; a cell with fewer has no figures


@dataclass(frozen=True)
class ErrorSamples:
    """Estimates against ground truth.

    t : (n,) s; place : (n, 3) m, true; error : (n, 3) m; covariance : (n, 3, 3) m^2, stated by the
    filter.
    """

    t: np.ndarray
    place: np.ndarray
    error: np.ndarray
    covariance: np.ndarray


def error_samples(flight: Flight, sensors: Iterable[str] = ()) -> ErrorSamples:
    """Return the ErrorSamples of a Flight with ground truth. Raises InputError.

    The filter uses TDOAs, IMU and `sensors` (names of SENSOR_NAMES) alone.
    """
    score, _ = evaluate(flight.without(*(name for name in SENSOR_NAMES if name not in sensors)))
    return ErrorSamples(score.t, score.p, score.error, score.covariance)


def pooled(samples: Sequence[ErrorSamples]) -> ErrorSamples:
    """Return one ErrorSamples of several, with their times moved apart."""
    apart = max(s.t[-1] for s in samples) + 10.0
    times = np.concatenate([s.t + k * apart for k, s in enumerate(samples)])
    return ErrorSamples(
        times,
        *(
            np.concatenate([getattr(s, name) for s in samples])
            for name in ("place", "error", "covariance")
        ),
    )


@dataclass(frozen=True)
class AccuracyMap:
    """Errors per cell of a grid; NaN in cells with fewer than FEWEST estimates.

    count : (n,); bias, rmse : (n, 3) m, along x, y, z; bound, claimed : (n, 3) m, roots of the mean
    variances of the bound of one round and of the filter at the same places.
    """

    grid: Grid
    count: np.ndarray
    bias: np.ndarray
    rmse: np.ndarray
    bound: np.ndarray
    claimed: np.ndarray


def accuracy_map(samples: ErrorSamples, installation: Installation, grid: Grid) -> AccuracyMap:
    """Return the AccuracyMap of ErrorSamples. Estimates outside of the grid are left out."""
    variances = np.diagonal(bound(information(samples.place, installation)), axis1=1, axis2=2)
    claimed = np.diagonal(samples.covariance, axis1=1, axis2=2)
    cell = np.floor((samples.place - grid.lower) / grid.step).astype(int)
    inside = ((cell >= 0) & (cell < grid.shape)).all(axis=1)
    index = np.ravel_multi_index(cell[inside].T, grid.shape)
    size = int(np.prod(grid.shape))
    count = np.bincount(index, minlength=size)

    def mean(values: np.ndarray) -> np.ndarray:
        sums = np.stack([np.bincount(index, column, size) for column in values[inside].T], axis=1)
        return np.where(count[:, None] >= FEWEST, sums / np.maximum(count, 1)[:, None], np.nan)

    return AccuracyMap(
        grid,
        count,
        mean(samples.error),
        *(np.sqrt(mean(v)) for v in (samples.error**2, variances, claimed)),
    )


def comparison(samples: ErrorSamples, installation: Installation) -> dict[str, Any]:
    """Return achieved and stated errors against the bound, over all samples: m and ratios.

    rmse, bound, claimed : roots of the mean squares of the 3D error, of the bound of one round, and
        of the filter's standard deviation
    scatter : rmse without the mean error within each second; the bound limits this part
    achieved_over_bound, scatter_over_bound : ratios
    efficiency_claimed : variance of the bound over that of the filter
    efficiency_achieved : variance of the bound over the mean squared error

    The filter uses many rounds and the IMU. An efficiency of n means: as good as n rounds with
    independent errors.
    """
    limits = bound(information(samples.place, installation))
    limit = np.trace(limits, axis1=1, axis2=2).mean()
    claim = np.trace(samples.covariance, axis1=1, axis2=2).mean()
    squared = np.mean(np.sum(samples.error**2, axis=1))
    second = np.unique(np.floor(samples.t).astype(np.int64), return_inverse=True)[1]
    means = (
        np.stack([np.bincount(second, e) for e in samples.error.T], axis=1)
        / np.bincount(second)[:, None]
    )
    scatter = np.mean(np.sum((samples.error - means[second]) ** 2, axis=1))
    return {
        "samples": len(samples.t),
        "rmse": float(np.sqrt(squared)),
        "scatter": float(np.sqrt(scatter)),
        "claimed": float(np.sqrt(claim)),
        "bound": float(np.sqrt(limit)),
        "achieved_over_bound": float(np.sqrt(squared / limit)),
        "scatter_over_bound": float(np.sqrt(scatter / limit)),
        "efficiency_claimed": float(limit / claim),
        "efficiency_achieved": float(limit / squared),
    }


PLANE_NEAREST = 10  # anchors that are looked at for a plane through them
JUDGED_AT_ONCE = 100_000  # times points: anchors that are judged at once, wherever they are


@dataclass(frozen=True)
class Hall:
    """A hall with walls, and its anchors. It can be pickled.

    installation : Installation; demand : Demand; reach : m; walls : Walls, or None
    """

    installation: Installation
    demand: Demand
    reach: float = np.inf
    walls: Walls | None = None

    @property
    def anchors(self) -> Anchors:
        """The Anchors of the installation."""
        return self.installation.anchors

    def heard(self, points: np.ndarray) -> list[np.ndarray]:
        """Return the rows of the anchors that are heard at points (n, 3) m: list of (k,) arrays."""
        return heard_at(points, self.anchors.positions, self.reach, self.walls)

    def chart(self, grid: Grid, jobs: int | None = None) -> Chart:
        """Return the Chart of a Grid. jobs : as for `parallel.over`."""
        points = grid.points
        tiles = self._tiles(points)
        unit = "part of the hall" if len(tiles) > 1 else "map"
        parts = [points[cells] for cells in tiles]
        whole = unheard(points, self.installation.dimensions)
        heard = np.zeros(len(points), int)
        results = parallel.over(self.judge, parts, jobs, unit)
        for cells, (found, counts) in zip(tiles, results):
            whole.assign(cells, found)
            heard[cells] = counts
        return Chart(whole.covariance, whole.error, whole.status, grid, heard)

    def judge(self, points: np.ndarray) -> tuple[Judged, np.ndarray]:
        """Return (Judged, number of anchors heard (n,)) of points (n, 3) m.

        Points near each other hear the same few anchors, which limits time and memory. Points with
        too few anchors stay `unheard`.
        """
        if self.reach == np.inf and self.walls is None:
            found = judge(points, self.installation, self.demand)
            return found, np.full(len(points), len(self.anchors))
        heard = self.heard(points)
        counts = np.array([len(rows) for rows in heard], int)
        whole = unheard(points, self.installation.dimensions)
        heard_somewhere = np.unique(np.concatenate([np.empty(0, int), *heard]))
        # Points with the same number of anchors are judged at once.
        for count in np.unique(counts[counts > self.installation.unknowns]):
            cells = np.flatnonzero(counts == count)
            installation = self.installation.with_anchors(self.anchors.only(heard_somewhere))
            columns = np.searchsorted(heard_somewhere, np.stack([heard[cell] for cell in cells]))
            whole.assign(cells, judge(points[cells], installation, self.demand, columns))
        return whole, counts

    def _tiles(self, points: np.ndarray) -> list[np.ndarray]:
        """Return the rows of points (n, 3) m that are near each other: list of (k,) arrays.

        It is one array if there are few points and anchors, or if all anchors are heard.
        """
        few = len(points) * len(self.anchors) <= JUDGED_AT_ONCE
        if few or self.reach == np.inf:
            return [np.arange(len(points))]
        size = max(0.5 * self.reach, 1e-3)
        at = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / size).astype(int)
        _, tile = np.unique(at, axis=0, return_inverse=True)
        order = np.argsort(tile.ravel(), kind="stable")
        return np.split(order, np.flatnonzero(np.diff(tile.ravel()[order])) + 1)

    def with_anchors(self, anchors: Anchors) -> Hall:
        """Return the same Hall with other Anchors."""
        return replace(self, installation=self.installation.with_anchors(anchors))

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

    def everywhere(self, points: np.ndarray) -> Judged:
        """Return the Judged of points (n, 3) m all over a hall."""
        return self.changed(
            unheard(points, self.installation.dimensions),
            points,
            self.anchors,
            self.anchors.positions,
        )

    def side(self, points: np.ndarray) -> dict[str, Any] | None:
        """Return where the heard anchors lie in a plane: {"share": of points, "tag_side": values}.

        The tag's side must be given there. points : (n, 3) m. None if there is no such point, or if the
        height is known and the anchors have one height.
        """
        needed = []
        unknowns = self.installation.unknowns
        for point, rows in zip(points, self.heard(points)):
            if len(rows) <= unknowns:
                continue
            positions = self.anchors.positions[rows]
            nearest = np.argsort(np.linalg.norm(positions - point, axis=1))[:PLANE_NEAREST]
            sides = sides_of(positions[nearest])
            if len(sides) == 2 or (sides and unknowns == 3):
                needed.append(sides)
        if not needed:
            return None
        most = max(sorted(set(needed)), key=needed.count)
        return {"share": needed.count(most) / len(points), "tag_side": list(most)}


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


def step_of(found: Judged, anchors: Anchors, room: Room) -> dict[str, Any]:
    """Return {"count", "spacing", "share", "median", "most"} of Judged places: a step of a search.

    count : anchors; spacing : m, root of the area over their number; share : that can be flown;
    median, most : m, median and 95 % of the bound there, None if there is none.
    """
    errors = found.error[found.flyable]
    size = room.upper - room.lower
    median, most = np.quantile(errors, [0.5, 0.95]).tolist() if len(errors) else (None, None)
    return {
        "count": len(anchors),
        "spacing": float(np.sqrt(size[0] * size[1] / len(anchors))),
        "share": float(found.flyable.mean()),
        "median": median,
        "most": most,
    }


def design(
    hall: Hall, points: np.ndarray, share: float, progress: Progress
) -> tuple[list[Anchors], list[dict[str, Any]]]:
    """Return (layouts, steps) of the room of a Hall: Anchors, the fewest first, and `step_of` tries.

    points : (n, 3) m, the cells to be flown; hall : Hall, without its anchors. Raises
    InputError if no pattern gives that share.
    """
    points = points[np.sort(np.random.default_rng(0).permutation(len(points))[:SEARCH_CELLS])]
    room, quick = hall.demand.room, _quick(hall)
    steps: list[dict[str, Any]] = []
    anchors: Anchors | None = None
    x = np.array(FIRST)
    for columns, rows in _patterns(room, hall.reach):
        progress(f"layouts of {columns} x {rows} anchors")
        x = _best_pattern(quick, points, columns, rows, x)
        found = _pattern(room, columns, rows, x)
        judged = hall.with_anchors(found).everywhere(points)
        steps.append(step_of(judged, found, room))
        if anchors is not None:
            break  # one pattern more, to say what it costs
        if judged.flyable.mean() >= share:
            anchors = found
    if anchors is None:
        most = max(steps, key=lambda step: step["share"])
        raise InputError(
            f"share: {100.0 * share:.0f} % of the hall cannot be flown at an accuracy of "
            f"{hall.demand.accuracy:g} m; {most['count']} "
            f"anchors give {100.0 * most['share']:.0f} %. Give a larger --accuracy, a smaller "
            "--share, or a known height (--planar, --with height)."
        )
    layouts, more = _without_spare_anchors(hall, points, share, anchors, progress)
    progress("directions of the anchors")
    turned = [_turned(quick, points, each) for each in layouts[:2]]
    return turned + layouts[2:], _best_steps(steps + more)


def _best_steps(steps: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the steps with a larger share than all with fewer anchors, the fewest first."""
    out: list[dict[str, Any]] = []
    for step in sorted(steps, key=lambda step: (step["count"], -step["share"])):
        if not out or step["share"] > out[-1]["share"]:
            out.append(step)
    return out


def _patterns(room: Room, reach: float) -> list[tuple[int, int]]:
    """Return the (columns, rows) of patterns, from sparse to dense."""
    first, last, ratio = SPACINGS
    size = room.upper - room.lower
    least = min(reach, float(size[:2].max()))
    spacing = first * least
    out: list[tuple[int, int]] = []
    while spacing > last * least:
        columns, rows = (max(2, round(side / spacing)) for side in size[:2])
        if columns * rows <= MOST and (columns, rows) not in out:
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
    quick: Hall, points: np.ndarray, columns: int, rows: int, start: np.ndarray
) -> np.ndarray:
    """Return x of the best `_pattern`, from a start."""
    room = quick.demand.room

    def cost(x: np.ndarray) -> float:
        pattern = _pattern(room, columns, rows, np.clip(x, 0.0, 1.0))
        return _cost_of(quick.with_anchors(pattern).everywhere(points), quick)

    simplex = np.vstack([start, start + np.where(start < 0.5, 0.3, -0.3) * np.eye(len(start))])
    found = minimize(
        cost,
        start,
        method="Nelder-Mead",
        bounds=[(0.0, 1.0)] * len(start),
        options={"maxfev": TRIALS, "initial_simplex": simplex},
    )
    return np.clip(found.x, 0.0, 1.0)


def _cost_of(found: Judged, quick: Hall) -> float:
    """Return the cost: a smooth share of imprecise places, and a little of the bound."""
    log = np.log(np.minimum(found.error, UNUSABLE))
    return float(np.mean(expit((log - np.log(quick.demand.accuracy)) / SOFT)) + FINE * log.mean())


def _without_spare_anchors(
    hall: Hall, points: np.ndarray, share: float, anchors: Anchors, progress: Progress
) -> tuple[list[Anchors], list[dict[str, Any]]]:
    """Return layouts with fewer and fewer anchors, and the step of each try.

    Each layout still has the wanted share. The fewest come first.
    """
    layouts, steps, quick = [anchors], [], _quick(hall)
    while len(anchors) > hall.installation.unknowns + 1:
        progress(f"layouts of {len(anchors) - 1} anchors")
        now = quick.with_anchors(anchors).everywhere(points)
        without_one = (
            quick.changed(now, points, _less(anchors, row), anchors.positions[[row]])
            for row in range(len(anchors))
        )
        gone = int(np.argmin([_cost_of(judged, quick) for judged in without_one]))
        fewer = _less(anchors, gone)
        away = np.linalg.norm(fewer.positions - anchors.positions[gone], axis=1)
        for row in np.argsort(away)[:MOVED]:
            fewer = _moved(quick, points, fewer, int(row))
        judged = hall.with_anchors(fewer).everywhere(points)
        steps.append(step_of(judged, fewer, hall.demand.room))
        if judged.flyable.mean() < share:
            break
        anchors = fewer
        layouts.insert(0, anchors)
    return layouts, steps


def _less(anchors: Anchors, row: int) -> Anchors:
    """Return the Anchors without one."""
    return anchors.only(np.delete(np.arange(len(anchors)), row))


def _quick(hall: Hall) -> Hall:
    """Return the same Hall, judged without second solutions."""
    return replace(hall, demand=replace(hall.demand, quick=True))


def _moved(quick: Hall, points: np.ndarray, anchors: Anchors, row: int) -> Anchors:
    """Return Anchors with one moved to the least cost nearby."""
    start, room = anchors.positions[row], quick.demand.room
    lowest = [0.0, 0.0, min(LOWEST, (room.upper - room.lower)[2])]
    low = np.maximum(start - FARTHEST, room.lower + lowest)
    high = np.minimum(start + FARTHEST, room.upper)
    now = quick.with_anchors(anchors).everywhere(points)

    def at(place: np.ndarray) -> Anchors:
        positions = anchors.positions.copy()
        positions[row] = place
        return _facing(positions, room)

    def cost(place: np.ndarray) -> float:
        judged = quick.changed(now, points, at(place), np.stack([start, place]))
        return _cost_of(judged, quick)

    # half-way to the farther bound along each axis
    steps = np.where(high - start >= start - low, high - start, low - start)
    simplex = np.vstack([start, start + 0.5 * np.diag(steps)])
    options = {"maxfev": MOVES, "initial_simplex": simplex}
    bounds = list(zip(low, high))
    found = minimize(cost, start, method="Nelder-Mead", bounds=bounds, options=options)
    return at(found.x) if found.fun < cost(start) else anchors


def _turned(quick: Hall, points: np.ndarray, anchors: Anchors) -> Anchors:
    """Return Anchors, each turned about the vertical to the least cost, one after the other."""
    for row in range(len(anchors)):
        now = quick.with_anchors(anchors).everywhere(points)

        def at(yaw: float) -> Anchors:
            orientations = anchors.orientations.copy()
            orientations[row] = Rotation.from_euler("z", yaw, degrees=True).as_quat().round(4)
            return Anchors(anchors.ids, anchors.positions, orientations, anchors.frame)

        def cost(yaw: float) -> float:
            judged = quick.changed(now, points, at(yaw), anchors.positions[[row]])
            return _cost_of(judged, quick)

        options = {"maxiter": TURNS}
        found = minimize_scalar(cost, bounds=(-180.0, 180.0), method="bounded", options=options)
        if found.fun < _cost_of(now, quick):
            anchors = at(round(float(found.x)))
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
