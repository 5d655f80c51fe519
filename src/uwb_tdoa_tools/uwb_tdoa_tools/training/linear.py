# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Robust Bayesian regression with a sparse and a dense design.

The model of a row is y = w[site_b] . phi - w[site_a] . phi + dense . v + noise, with Gaussian priors
on the weights. A site is one anchor at one place. It has its own weights on features phi of the tag.
Only the blocks of two sites meet in a row, so the normal equations are summed block by block.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.linalg.lapack import dpotri, dtrtri

if TYPE_CHECKING:
    from collections.abc import Sequence

ITERATIONS = 8
PRECISION = (1e-1, 1e4)  # limits of 1 / s^2
DEGREES = 3.0  # of freedom of the Student t errors


@dataclass(frozen=True)
class Design:
    """Hold the rows of a regression.

    Parameters
    ----------
    phi : numpy.ndarray
        Features of the tag (n, m).
    a, b : numpy.ndarray
        Site of each end (n,).
    dense : numpy.ndarray
        Dense columns (n, q).
    y : numpy.ndarray
        Errors (n,), m.
    sample_weight : numpy.ndarray
        Independent observations per row (n,).
    """

    phi: np.ndarray
    a: np.ndarray
    b: np.ndarray
    dense: np.ndarray
    y: np.ndarray
    sample_weight: np.ndarray


@dataclass(frozen=True)
class Posterior:
    """Hold the fitted weights.

    Parameters
    ----------
    site, dense : numpy.ndarray
        Weights (sites, m) and (q,).
    site_covariance, dense_covariance : numpy.ndarray
        Covariances (m, m), the mean over the sites, and (q, q).
    site_std, dense_std : float
        Standard deviations of the fitted priors.
    """

    site: np.ndarray
    dense: np.ndarray
    site_covariance: np.ndarray
    dense_covariance: np.ndarray
    site_std: float
    dense_std: float


def fit(
    design: Design, sites: int, noise: float, known_std: Sequence[float] | np.ndarray = ()
) -> Posterior:
    """Fit the weights.

    The priors are N(0, s^2). The last dense weights have the standard deviations `known_std`. The other
    dense weights share one s, and the sites share another. Both maximize the evidence (MacKay, Neural
    Computation 4, 1992). Iteratively re-weighted least squares give the weights for Student t errors
    (Lange, Little and Taylor, JASA 84, 1989).

    Parameters
    ----------
    design : Design
    sites : int
        Number of sites.
    noise : float
        Scale of the errors, m.
    known_std : sequence of float

    Returns
    -------
    Posterior
    """
    m, q = design.phi.shape[1], design.dense.shape[1]
    size = sites * m
    blocks = (slice(0, size), slice(size, size + q - len(known_std)))
    prior = np.concatenate([np.ones(blocks[1].stop), np.asarray(known_std, dtype=float) ** -2.0])
    robust, groups = np.ones(len(design.y)), _groups(design.a, design.b, sites)
    for iteration in range(ITERATIONS):
        left, right = _normal_equations(
            design, groups, size, robust * design.sample_weight / noise**2
        )
        left[np.diag_indices_from(left)] += prior
        factor, _ = cho_factor(left, overwrite_a=True)
        solution = cho_solve((factor, False), right)
        weights, dense = solution[:size].reshape(sites, m), solution[size:]
        residual = design.y - predict(design, weights, dense)
        robust = (DEGREES + 1.0) / (DEGREES + (residual / noise) ** 2)
        if iteration < ITERATIONS - 1:
            variance = _inverse_diagonal(factor)
            for block in blocks:
                # number of well-determined weights
                determined = np.sum(1.0 - prior[block] * variance[block])
                prior[block] = np.clip(
                    determined / max(np.sum(solution[block] ** 2), 1e-12), *PRECISION
                )
    covariance, _ = dpotri(factor, overwrite_c=True)  # its upper triangle
    covariance = np.triu(covariance) + np.triu(covariance, 1).T
    site_covariance = np.zeros((m, m))
    for k in range(sites):
        site_covariance += covariance[k * m : (k + 1) * m, k * m : (k + 1) * m] / sites
    std = [float(prior[block][0] ** -0.5) if prior[block].size else 0.0 for block in blocks]
    return Posterior(weights, dense, site_covariance, covariance[size:, size:], *std)


def _inverse_diagonal(factor: np.ndarray) -> np.ndarray:
    """Return the diagonal (k,) of an inverse from the upper Cholesky factor (k, k).

    The factor is overwritten. This takes half the time of the whole inverse.
    """
    inverse, _ = dtrtri(factor, overwrite_c=True)
    return np.array([row[k:] @ row[k:] for k, row in enumerate(inverse)])


def _normal_equations(
    design: Design, groups: Sequence[tuple[int, int, np.ndarray]], size: int, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return both sides of the normal equations, (size + q, size + q) and (size + q,).

    They lack the priors. groups : of `_groups`; size : sites * m; weight : (n,) 1/m^2, of the rows
    """
    m, q = design.phi.shape[1], design.dense.shape[1]
    left, right = np.zeros((size + q, size + q)), np.zeros(size + q)
    for a, b, rows in groups:
        phi, w = design.phi[rows], weight[rows, None]
        gram = phi.T @ (w * phi)
        vector = phi.T @ (w[:, 0] * design.y[rows])
        cross = phi.T @ (w * design.dense[rows])
        of_a, of_b = slice(a * m, (a + 1) * m), slice(b * m, (b + 1) * m)
        left[of_a, of_a] += gram
        left[of_b, of_b] += gram
        left[of_a, of_b] -= gram
        left[of_b, of_a] -= gram
        for block, sign in ((of_a, -1.0), (of_b, 1.0)):
            right[block] += sign * vector
            left[block, size:] += sign * cross
    left[size:, :size] = left[:size, size:].T
    left[size:, size:] = design.dense.T @ (weight[:, None] * design.dense)
    right[size:] = design.dense.T @ (weight * design.y)
    return left, right


def predict(design: Design, weights: np.ndarray, dense: np.ndarray) -> np.ndarray:
    """Return the prediction (n,) of weights (sites, m) and dense (q,)."""
    return (
        np.einsum("nm,nm->n", design.phi, weights[design.b] - weights[design.a])
        + design.dense @ dense
    )


def _groups(a: np.ndarray, b: np.ndarray, sites: int) -> list[tuple[int, int, np.ndarray]]:
    """Return [(site a, site b, rows with these sites)]."""
    pair = a * sites + b
    order = np.argsort(pair, kind="stable")
    starts = np.flatnonzero(np.diff(pair[order], prepend=-1))
    return [
        (int(pair[rows[0]] // sites), int(pair[rows[0]] % sites), rows)
        for rows in np.split(order, starts[1:])
    ]
