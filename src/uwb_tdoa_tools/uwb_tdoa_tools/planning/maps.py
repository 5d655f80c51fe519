# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Judge places: whether a tag can be flown there, and if not, why.

A place hears too few anchors, is imprecise, has two solutions, or can be flown. Measured flights check
the precision.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import SENSOR_NAMES, Flight
from uwb_tdoa_bias.common.flyable import FlyableVolume

from ..choices import ACCURACY
from ..scoring.evaluation import evaluate
from ..scoring.metrics import position_at
from ..simulation.config import Room
from .precision import (
    CLEAR,
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
    n, k = len(points), installation.dimensions
    if heard <= installation.unknowns:
        return Judged(np.full((n, k, k), np.inf), np.full(n, np.inf), np.full(n, TOO_FEW))
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
    assert flight.truth is not None
    score, _ = evaluate(flight.without(*(name for name in SENSOR_NAMES if name not in sensors)))
    return ErrorSamples(score.t, position_at(score.t, flight.truth), score.error, score.covariance)


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
