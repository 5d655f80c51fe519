# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""How far a map can be off: covariance of its anchors under errors that last."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .least_squares import Fit, Linear

LENGTH = 1.2  # m, of the smooth error of each anchor, as in `survey`
DRAWS = 150  # of the errors
TILT, TILT_TIME = 0.1, 10.0  # m/s^2 and s, of accelerations by errors of roll and pitch
SHAKEN = 0.15  # m/s^2, of the acceleration of a bin
# Factor on the variance that lasting errors make: the fit is linear here, and their size is
# estimated from the residuals. Set on simulated halls other than those of the study.
MARGIN = 2.0
LEAST = 0.01  # m, of a coordinate


def covariance(linear: Linear, fit: Fit, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Return the covariance of the anchors, (3N, 3N) m^2, and the size of lasting errors, m.

    Independent errors and the priors give the covariance of the fit. Each anchor also has a smooth
    error of the place of the tag, and accelerations have a slow error. Draws of these errors pass
    through the linear problem. The residuals give the size of the smooth errors: most of an error
    disappears in the map, so the errors are larger than the residuals.
    """
    problem = linear.problem
    seen, size = problem.seen, 3 * len(problem.seen.ids)
    out: np.ndarray = linear.covariance[:size, :size] + LEAST**2 * np.eye(size)
    if not len(seen.t):
        return out, 0.0
    root = _root(fit.path)
    draws = rng.standard_normal((len(seen.ids), root.shape[1], DRAWS))
    smooth = np.einsum("jr,nrs->njs", root, draws)
    errors = smooth[seen.b, seen.bin]
    errors -= np.where(problem.two[:, None], smooth[problem.first, seen.bin], 0.0)
    still = np.zeros((len(problem.middle), 3, DRAWS))
    columns, left = linear.response(errors, still)
    std = _scale(linear.residual) / max(_scale(left), 1e-6)
    slow, _ = linear.response(np.zeros_like(errors), _accelerations(linear, rng))
    total = std * columns[:size] + slow[:size]
    return out + MARGIN * total @ total.T / DRAWS, std


def _root(path: np.ndarray) -> np.ndarray:
    """Return (J, r) whose product with normal numbers is a smooth function along a path (J, 3) m."""
    apart = np.sum((path[:, None] - path) ** 2, axis=2)
    values, vectors = np.linalg.eigh(np.exp(-0.5 * apart / LENGTH**2))
    kept = values > 1e-6 * values[-1]
    out: np.ndarray = vectors[:, kept] * np.sqrt(values[kept])
    return out


def _accelerations(linear: Linear, rng: np.random.Generator) -> np.ndarray:
    """Return draws of the errors of accelerations, (m, 3, s) m/s^2."""
    problem = linear.problem
    flight, t = problem.seen.flight[problem.middle], problem.seen.t[problem.middle]
    together = flight[:, None] == flight
    slow = TILT**2 * together * np.exp(-np.abs(t[:, None] - t) / TILT_TIME)
    root = np.linalg.cholesky(slow + SHAKEN**2 * np.eye(len(t)))
    draws = rng.standard_normal((3, len(t), DRAWS))
    return np.einsum("ij,kjs->iks", root, draws)


def _scale(values: np.ndarray) -> float:
    """Return the robust standard deviation of values about zero."""
    return 1.4826 * float(np.median(np.abs(values)))
