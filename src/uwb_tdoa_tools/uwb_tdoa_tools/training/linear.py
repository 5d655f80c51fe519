"""Robust Bayesian regression with a design of a sparse and a dense part.

A row says: y = w[site_b] . phi - w[site_a] . phi + dense . v + noise, with Gaussian priors on the
weights. A site is one anchor at one place and has weights of its own on features phi that depend on
the tag alone, so that only the blocks of two sites meet in a row and the normal equations are
summed up block by block.
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
DEGREES = 3.0  # of freedom of the Student t errors that the weights belong to


@dataclass(frozen=True)
class Design:
    """phi : (n, m); a, b : (n,) site of either end; dense : (n, q); y : (n,) m; looks : (n,)
    independent looks of a row.
    """

    phi: np.ndarray
    a: np.ndarray
    b: np.ndarray
    dense: np.ndarray
    y: np.ndarray
    sample_weight: np.ndarray


@dataclass(frozen=True)
class Posterior:
    """site : (sites, m) weights; dense : (q,); site_covariance : (m, m), mean over the sites;
    dense_covariance : (q, q);
    site_std, dense_std : standard deviations of the priors that the data called for.
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
    """Posterior of the weights of `sites` sites and of the dense ones.

    The priors are N(0, s^2): the last dense weights have the standard deviations known_std; the
    others share one s, the sites' another, which maximise the evidence (MacKay, Neural Computation
    4, 1992). Iteratively re-weighted least squares for Student t errors of scale `noise`, m (Lange,
    Little and Taylor, JASA 84, 1989).
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
                determined = np.sum(
                    1.0 - prior[block] * variance[block]
                )  # number of weights the data determine
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
    """Diagonal (k,) of the inverse of a matrix, of its upper Cholesky factor (k, k), whose place is
    taken: half the work of the whole inverse.
    """
    inverse, _ = dtrtri(factor, overwrite_c=True)
    return np.array([row[k:] @ row[k:] for k, row in enumerate(inverse)])


def _normal_equations(
    design: Design, groups: Sequence[tuple[int, int, np.ndarray]], size: int, row: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Left (k, k) and right (k,) side of the weighted least squares of all rows, weights of the
    rows (n,).
    """
    m, q = design.phi.shape[1], design.dense.shape[1]
    left, right = np.zeros((size + q, size + q)), np.zeros(size + q)
    for a, b, rows in groups:
        phi, w = design.phi[rows], row[rows, None]
        square, one, both = (
            phi.T @ (w * phi),
            phi.T @ (w[:, 0] * design.y[rows]),
            phi.T @ (w * design.dense[rows]),
        )
        at, bt = slice(a * m, (a + 1) * m), slice(b * m, (b + 1) * m)
        left[at, at] += square
        left[bt, bt] += square
        left[at, bt] -= square
        left[bt, at] -= square
        for part, sign in ((at, -1.0), (bt, 1.0)):
            right[part] += sign * one
            left[part, size:] += sign * both
    left[size:, :size] = left[:size, size:].T
    left[size:, size:] = design.dense.T @ (row[:, None] * design.dense)
    right[size:] = design.dense.T @ (row * design.y)
    return left, right


def predict(design: Design, weights: np.ndarray, dense: np.ndarray) -> np.ndarray:
    """What weights (sites, m) and dense (q,) say for every row: (n,)."""
    return (
        np.einsum("nm,nm->n", design.phi, weights[design.b] - weights[design.a])
        + design.dense @ dense
    )


def _groups(a: np.ndarray, b: np.ndarray, sites: int) -> list[tuple[int, int, np.ndarray]]:
    pair = a * sites + b
    order = np.argsort(pair, kind="stable")
    starts = np.flatnonzero(np.diff(pair[order], prepend=-1))
    return [
        (int(pair[rows[0]] // sites), int(pair[rows[0]] % sites), rows)
        for rows in np.split(order, starts[1:])
    ]
