# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compute how precise a position can be.

Fisher information, the Cramer-Rao bound, dilution of precision and ellipses.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uwb_tdoa_bias.common.geometry import ranges

from .installation import FixedNoise, Installation, Pairing, variance_gradient

# standard deviations of a normal variable that hold 99 %, as rounded in Grasso et al., sec. 2.2.3
NORMAL_99 = 2.58
_CHUNK = 200_000  # numbers in the largest array of one step: what a processor cache holds


def information(
    points: np.ndarray,
    installation: Installation,
    correction: bool = True,
    columns: np.ndarray | None = None,
) -> np.ndarray:
    """Return the Fisher information of one round about the position: (n, k, k) 1/m^2.

    A round holds TDOAs or ranges and, if the tag measures it, a height. points : (n, 3) m; k : the
    dimensions of the installation. correction : True adds the second term of eq. 1, the information
    in the size of the errors. columns : (n, K) rows of the anchors that are heard at each point,
    None for all.
    Source: eq. 1 of Grasso et al. (Sensors 2022, 22, 9136).
    """
    anchors = installation.anchors
    if columns is None:
        columns = np.broadcast_to(np.arange(len(anchors)), (len(points), len(anchors)))
    size = len(points) * max(columns.shape[1] ** 2, 9 * len(anchors))
    parts = [
        _information(points[rows], installation, correction, columns[rows])
        for rows in np.array_split(np.arange(len(points)), max(1, size // _CHUNK))
    ]
    return installation.with_height(np.concatenate(parts))


def _information(
    points: np.ndarray, installation: Installation, correction: bool, columns: np.ndarray
) -> np.ndarray:
    anchors, k = installation.anchors, installation.dimensions
    variances = installation.noise.variance(points, anchors)
    variance = np.take_along_axis(variances, columns, axis=1)
    unit = ranges(points[:, None, :], anchors.positions[columns])[1][..., :k]
    gradient: np.ndarray = np.empty(0)
    if correction:
        gradient = variance_gradient(installation.noise, points, anchors, variances, k)
        gradient = np.take_along_axis(gradient, columns[..., None], axis=1)
    total = np.zeros((len(points), k, k))
    for part in installation.round(columns.shape[1]):
        weights = range_weights(variance, part)
        total += weigh(unit, weights)
        if correction:
            total += 0.5 * weigh(gradient, _weights_of_sizes(weights, part))
    return total


def weigh(change: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the information change' weights change about k unknowns: (n, k, k).

    change : (n, N, k) derivatives of the ranges to all N anchors; weights : (n, N, N), of
    `range_weights`. For derivatives by the position it is the first term of eq. 1, in 1/m^2.
    """
    return change.swapaxes(1, 2) @ (weights @ change)


def round_weights(variance: np.ndarray, installation: Installation) -> np.ndarray:
    """Return the weights of the ranges in a whole round: (n, N, N) 1/m^2. variance : (n, N) m^2."""
    parts = installation.round(variance.shape[1])
    return np.sum([range_weights(variance, part) for part in parts], axis=0)


def range_weights(variance: np.ndarray, part: Pairing) -> np.ndarray:
    """Return D' F^-1 D, the weights of the ranges in a part of a round: (n, N, N) 1/m^2.

    D (M, N) has -1 at anchor a and +1 at anchor b of each pair; it is the identity for ranges. F = D S D'
    is the covariance of the measurements, S = diag(variance).

    If the anchors share one reception each and the pairs connect all of them, the result does not
    depend on the pairs: with W = S^-1 and w its diagonal, D' (D S D')^-1 D = W - w w' / sum(w).
    That is the information of N ranges with one unknown offset, the tag's clock. A closed ring,
    whose D S D' is singular, has the same information. Only independent TDOAs have `times`.

    variance : (n, N) m^2, of the receptions; part : Pairing
    Source: eqs. 4 and 5 of Grasso et al. (Sensors 2022, 22, 9136); A18 for a common reference.
    """
    each = np.eye(variance.shape[1])
    if part.ranges:
        return each / variance[:, None]
    if part.shared:
        w = 1.0 / variance
        return each * w[:, None] - w[:, :, None] * (w / w.sum(axis=1, keepdims=True))[:, None]
    between = np.zeros((len(variance), *each.shape))
    between[:, part.a, part.b] = part.times / (variance[:, part.a] + variance[:, part.b])
    between += between.swapaxes(1, 2)
    return each * between.sum(axis=1)[:, None] - between


def _weights_of_sizes(weights: np.ndarray, part: Pairing) -> np.ndarray:
    """Return the weights of the variances in the second term of eq. 1, times 2: (n, N, N) 1/m^4.

    weights : P, of `range_weights`. With dF_i = D diag(g_i) D', the trace of eq. 1 is g_i' (P o P)
    g_j. If the errors are independent, F is diagonal, and a pair adds (g_a + g_b)^2 / F^2.
    """
    squared = weights**2
    if part.shared or part.ranges:
        return squared
    each = np.eye(weights.shape[1])
    squared *= 1.0 - each
    return (squared + each * squared.sum(axis=1)[:, None]) / part.times


def bound(information: np.ndarray) -> np.ndarray:
    """Return the Cramer-Rao bound: (n, k, k) m^2; inf where the information is singular."""
    finite = np.isfinite(information).all(axis=(1, 2))
    checked = np.where(finite[:, None, None], information, 0.0)
    values, vectors = np.linalg.eigh(checked)
    lost = values[:, 0] <= 1e-12 * np.maximum(values[:, -1], 1e-300)
    covariance = (vectors / np.where(lost[:, None], 1.0, values)[:, None, :]) @ vectors.swapaxes(
        1, 2
    )
    return np.where(lost[:, None, None], np.inf, covariance)


def position_error(covariance: np.ndarray) -> np.ndarray:
    """Return the root of the summed variances of x, y (and z): (n,) m."""
    return np.sqrt(np.trace(covariance, axis1=1, axis2=2))


def dilution(points: np.ndarray, installation: Installation) -> np.ndarray:
    """Return the dilution of precision along each axis: (n, k).

    The error along an axis is the dilution times the error of one reception, if all have the same. k
    is the number of coordinates that TDOAs must determine. Root sums of squares give the horizontal dilution (x
    and y) and the position dilution, PDOP (all).
    """
    unit_noise = replace(
        installation,
        noise=FixedNoise(1.0),
        dimensions=installation.unknowns,
        height_std=np.inf,
    )
    covariance = bound(information(points, unit_noise, correction=False))
    return np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))


def ellipses(covariance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the 99 % ellipses in the xy plane: (semi-axes (n, 2) m, angle (n,) rad).

    The longer semi-axis comes first; the angle is from x to it.
    """
    values, vectors = np.linalg.eigh(covariance[:, :2, :2])
    axes = np.sqrt(-2.0 * np.log(1.0 - 0.99) * values[:, ::-1])
    return axes, np.arctan2(vectors[:, 1, 1], vectors[:, 0, 1])
