"""Bias and scatter of estimates over places, beside what the bound promises there."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.foundation.flight import AIDS

from ..scoring.evaluation import evaluate
from ..scoring.metrics import position_at
from .precision import bound, information

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from uwb_tdoa_bias.foundation.flight import Flight

    from .installation import Installation
    from .maps import Grid

FEW = 20  # estimates in a cell below which it tells nothing


@dataclass(frozen=True)
class ErrorSamples:
    """Estimates against ground truth. t : (n,) s; place : (n, 3) m, true; error : (n, 3) m;
    covariance : (n, 3, 3) m^2, what the filter claims.
    """

    t: np.ndarray
    place: np.ndarray
    error: np.ndarray
    covariance: np.ndarray


def fly(flight: Flight, aids: Iterable[str] = ()) -> ErrorSamples:
    """ErrorSamples of a Flight with ground truth, static or moving, from its TDOAs, IMU and `aids`,
    names of AIDS, alone. Raises InputError.
    """
    assert flight.truth is not None
    score, _ = evaluate(flight.without(*(name for name in AIDS if name not in aids)))
    return ErrorSamples(score.t, position_at(score.t, flight.truth), score.error, score.covariance)


def together(samples: Sequence[ErrorSamples]) -> ErrorSamples:
    """One ErrorSamples of several, their times moved apart."""
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
    """Errors per cell of a grid; NaN where there are fewer than FEW estimates.

    count : (n,); bias, rmse : (n, 3) m, along x, y, z; bound, claimed : (n, 3) m, root of the mean
        variance that the
    bound of one round and the filter give at the same places.
    """

    grid: Grid
    count: np.ndarray
    bias: np.ndarray
    rmse: np.ndarray
    bound: np.ndarray
    claimed: np.ndarray


def accuracy_map(samples: ErrorSamples, installation: Installation, grid: Grid) -> AccuracyMap:
    """AccuracyMap of ErrorSamples. Estimates outside of the grid are left out."""
    variances = np.diagonal(promised(samples, installation), axis1=1, axis2=2)
    claimed = np.diagonal(samples.covariance, axis1=1, axis2=2)
    cell = np.floor((samples.place - grid.lower) / grid.step).astype(int)
    inside = ((cell >= 0) & (cell < grid.shape)).all(axis=1)
    index = np.ravel_multi_index(cell[inside].T, grid.shape)
    size = int(np.prod(grid.shape))
    count = np.bincount(index, minlength=size)

    def mean(values: np.ndarray) -> np.ndarray:
        sums = np.stack([np.bincount(index, column, size) for column in values[inside].T], axis=1)
        return np.where(count[:, None] >= FEW, sums / np.maximum(count, 1)[:, None], np.nan)

    return AccuracyMap(
        grid,
        count,
        mean(samples.error),
        *(np.sqrt(mean(v)) for v in (samples.error**2, variances, claimed)),
    )


def promised(samples: ErrorSamples, installation: Installation) -> np.ndarray:
    """The bound of one round at the place of every sample: (n, 3, 3) m^2.

    Needs three dimensions.
    """
    return bound(information(samples.place, installation))


def comparison(samples: ErrorSamples, installation: Installation) -> dict[str, Any]:
    """Achieved and claimed errors against the bound, over all samples: a dict of m and ratios.

    rmse, bound, claimed : roots of the mean squares of the 3D error, of the bound of one round, and
        of what the filter
    claims; scatter : rmse without the mean error within each second, which is what the bound speaks
    of; achieved_over_bound, scatter_over_bound; efficiency_claimed : variance of the bound over
    that the filter claims;
    efficiency_achieved : the same over the mean squared error. The filter uses many rounds and the
        inertial sensor: an
    efficiency of n says "as good as n rounds of independent errors", and one round is the unit of
    all of them.
    """
    limit = np.trace(promised(samples, installation), axis1=1, axis2=2).mean()
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
