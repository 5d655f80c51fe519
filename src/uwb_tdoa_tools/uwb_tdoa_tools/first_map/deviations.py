# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""How far a map can be off: covariance of its anchors under errors that last."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .least_squares import MOTION

if TYPE_CHECKING:
    from .least_squares import Equations, Fit

LENGTH = 1.2  # m, of the smooth error of each anchor, as in `survey`
DRAWS = 300  # of the errors
TILT, TILT_TIME = 0.1, 10.0  # m/s^2 and s, of accelerations by errors of roll and pitch
SHAKEN = 0.15  # m/s^2, of the acceleration of a bin
# Factor on the variance that lasting errors make: the fit is linear here, and their size is
# estimated from the residuals. Set on simulated halls other than those of the study.
MARGIN = 1.5
NEAR = 5  # bins, at most between two measurements whose common error lasts
CLIPPED = 3.0  # robust standard deviations beyond which a residual is an outlier
LEAST_SHARE = 0.1  # of the variance of residuals that lasts at least
LEAST = 0.01  # m, of a coordinate


def covariance(linear: Equations, fit: Fit, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Return the covariance of the anchors, (3N, 3N) m^2, and the size of lasting errors, m.

    Draws of all errors pass through the linear problem. Each anchor has a smooth error of the place of
    the tag. Successive residuals of a pair give its size by what they share. Most of such an error
    disappears in the map, so the errors are larger than the residuals. Accelerations have a slow error.
    The rest is independent.
    """
    problem = linear.problem
    seen, size = problem.seen, 3 * len(problem.seen.ids)
    least = LEAST**2 * np.eye(size)
    if not len(seen.t):
        return linear.covariance[:size, :size] + least, 0.0
    root = _root(fit.path)
    draws = rng.standard_normal((len(seen.ids), root.shape[1], DRAWS))
    smooth = np.einsum("jr,nrs->njs", root, draws)
    radio = smooth[seen.b, seen.bin]
    radio -= np.where(problem.two[:, None], smooth[problem.first, seen.bin], 0.0)
    still = np.zeros((len(problem.middle), 3, DRAWS))
    nothing = np.zeros((problem.layout.size, DRAWS)), np.zeros((3 * problem.bins, DRAWS))
    lasting, left = linear.response(radio, still, nothing)
    scale = _scale(linear.state.radio)
    pairs = _neighbours(linear)
    clipped = np.clip(linear.state.radio, -CLIPPED * scale, CLIPPED * scale)
    together = max(_lasting(clipped[:, None], pairs), LEAST_SHARE * scale**2)
    std = float(np.sqrt(together / max(_lasting(left, pairs), 1e-9)))
    noise = scale * rng.standard_normal(radio.shape)
    rest = linear.others(rng, DRAWS)
    independent, _ = linear.response(noise, _accelerations(linear, rng), rest)
    total = std * lasting[:size] + independent[:size]
    return least + MARGIN * total @ total.T / DRAWS, std


def _neighbours(linear: Equations) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (k,) of measurements, and of the next one of the same anchors within NEAR bins."""
    seen = linear.problem.seen
    order = np.lexsort((seen.bin, seen.b, seen.a))
    first, second = order[:-1], order[1:]
    same = (seen.a[first] == seen.a[second]) & (seen.b[first] == seen.b[second])
    near = same & (seen.bin[second] - seen.bin[first] <= NEAR)
    return first[near], second[near]


def _lasting(residual: np.ndarray, pairs: tuple[np.ndarray, np.ndarray]) -> float:
    """Return the variance of the part of residuals (n, s) that two successive ones share, m^2."""
    first, second = pairs
    return float(np.mean(residual[first] * residual[second])) if len(first) else 0.0


def _root(path: np.ndarray) -> np.ndarray:
    """Return (J, r) whose product with normal numbers is a smooth function along a path (J, 3) m."""
    apart = np.sum((path[:, None] - path) ** 2, axis=2)
    values, vectors = np.linalg.eigh(np.exp(-0.5 * apart / LENGTH**2))
    kept = values > 1e-6 * values[-1]
    return vectors[:, kept] * np.sqrt(values[kept])


def _accelerations(linear: Equations, rng: np.random.Generator) -> np.ndarray:
    """Return draws of the errors of accelerations, (m, 3, s) m/s^2."""
    problem = linear.problem
    flight, t = problem.seen.flight[problem.middle], problem.seen.t[problem.middle]
    together = flight[:, None] == flight
    together = together & problem.measured & problem.measured[:, None]
    slow = TILT**2 * together * np.exp(-np.abs(t[:, None] - t) / TILT_TIME)
    quick = np.where(problem.measured, SHAKEN, MOTION)
    root = np.linalg.cholesky(slow + np.diag(quick**2))
    draws = rng.standard_normal((3, len(t), DRAWS))
    return np.einsum("ij,kjs->iks", root, draws)


def _scale(values: np.ndarray) -> float:
    """Return the robust standard deviation of values about zero."""
    return 1.4826 * float(np.median(np.abs(values)))
