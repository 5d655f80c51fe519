# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compute how precise a position can be.

Fisher information, the Cramer-Rao bound, dilution of precision and ellipses.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.geometry import ranges

from .installation import FixedNoise, variance_gradient

if TYPE_CHECKING:
    from .installation import Installation, Pairing

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
    None for all; the pairing of the installation is of K anchors.
    Source: eq. 1 of Grasso et al. (Sensors 2022, 22, 9136).
    """
    anchors, pairing = len(installation.anchors), installation.pairing
    width = (
        len(pairing.a) * (anchors if pairing.shared and installation.link_std else 3) + 9 * anchors
    )
    chunks = np.array_split(np.arange(len(points)), max(1, len(points) * width // _CHUNK))
    parts = [
        _information(
            points[rows], installation, correction, None if columns is None else columns[rows]
        )
        for rows in chunks
    ]
    return installation.with_height(np.concatenate(parts))


def _information(
    points: np.ndarray, installation: Installation, correction: bool, columns: np.ndarray | None
) -> np.ndarray:
    anchors, k = installation.anchors, installation.dimensions
    unit = ranges(points[:, None, :], anchors.positions)[1]
    variance = installation.noise.variance(points, anchors)
    gradient = (
        variance_gradient(installation.noise, points, anchors, variance, k)
        if correction
        else np.empty(0)
    )
    if columns is not None:
        unit, variance = (
            np.take_along_axis(unit, columns[..., None], axis=1),
            np.take_along_axis(variance, columns, axis=1),
        )
        gradient = (
            np.take_along_axis(gradient, columns[..., None], axis=1) if correction else gradient
        )
    total = weigh(unit[..., :k], variance, installation.pairing, installation.link_std)
    if correction:
        for part in installation.pairing.parts:
            total += _from_sizes(gradient, variance, part, installation.link_std)
    return total


def weigh(
    change: np.ndarray, variance: np.ndarray, pairing: Pairing, link_std: float = 0.0
) -> np.ndarray:
    """Return the information V' F^-1 V of one round about k unknowns, (n, k, k).

    V are the derivatives of the measurements of the round: D `change` for TDOAs, `change` for
    ranges. D (M, N) has -1 at anchor a and +1 at anchor b of each pair. F = D S D' + link_std^2 I
    is the covariance of the measurements, S = diag(variance). For derivatives by the position the
    result is the first term of eq. 1, in 1/m^2.

    If the anchors share one reception each and the pairs connect all of them, the result does not
    depend on the pairs: with W = S^-1 and w its diagonal, D' (D S D')^-1 D = W - w w' / sum(w).
    That is the information of N ranges with one unknown offset, the tag's clock. A closed ring,
    whose D S D' is singular, has the same information. Only independent TDOAs have `times`.

    change : (n, N, k) derivatives of the ranges to all N anchors; variance : (n, N) m^2, of the
    receptions; pairing : Pairing; link_std : m, as for Installation
    """
    if pairing.beside:
        return np.sum([weigh(change, variance, part, link_std) for part in pairing.parts], axis=0)
    link_variance = link_std**2
    if pairing.ranges:
        return _product(change, change / (variance + link_variance)[..., None])
    if not pairing.shared:
        v = change[:, pairing.b] - change[:, pairing.a]
        weight = pairing.times / (variance[:, pairing.a] + variance[:, pairing.b] + link_variance)
        return _product(v, weight[..., None] * v)
    if link_variance > 0.0:
        return _product(change, _inverse(variance, pairing, link_std) @ change)
    w = 1.0 / variance[..., None]
    centred = change - (w * change).sum(axis=1, keepdims=True) / w.sum(axis=1, keepdims=True)
    return _product(centred, w * centred)


def range_weights(variance: np.ndarray, pairing: Pairing, link_std: float = 0.0) -> np.ndarray:
    """Return D' F^-1 D, the weights of the ranges in a round: (n, N, N) 1/m^2.

    variance : (n, N) m^2.
    """
    n, anchors = variance.shape
    if pairing.beside or pairing.shared or pairing.ranges:
        if pairing.beside:
            return np.sum(
                [range_weights(variance, part, link_std) for part in pairing.parts], axis=0
            )
        return weigh(
            np.broadcast_to(np.eye(anchors), (n, anchors, anchors)), variance, pairing, link_std
        )
    weight = pairing.times / (variance[:, pairing.a] + variance[:, pairing.b] + link_std**2)
    out = np.zeros((anchors, anchors, n))
    for one, other in ((pairing.a, pairing.b), (pairing.b, pairing.a)):
        np.add.at(out, (one, one), weight.T)
        np.add.at(out, (one, other), -weight.T)
    return np.ascontiguousarray(out.transpose(2, 0, 1))


def _from_sizes(
    gradient: np.ndarray, variance: np.ndarray, pairing: Pairing, link_std: float
) -> np.ndarray:
    """Return the second term of eq. 1, for the derivatives (n, N, k) m of the variances.

    With F = D S D' + link_std^2 I, dF_i = D diag(g_i) D' and P = D' F^-1 D, half the trace is g_i' (P o P)
    g_j / 2.
    """
    link_variance = link_std**2
    if pairing.ranges:
        g = gradient / (variance + link_variance)[..., None]
        return 0.5 * _product(g, g)
    if not pairing.shared:
        weight = 1.0 / (variance[:, pairing.a] + variance[:, pairing.b] + link_variance)
        g = (gradient[:, pairing.a] + gradient[:, pairing.b]) * weight[..., None]
        return 0.5 * pairing.times * _product(g, g)
    if link_variance > 0.0:
        return 0.5 * _product(gradient, _inverse(variance, pairing, link_std) ** 2 @ gradient)
    w = 1.0 / variance[..., None]
    total, g = w.sum(axis=1, keepdims=True), w * gradient
    mean = (w * g).sum(axis=1, keepdims=True) / total
    return 0.5 * (_product(g, (1.0 - 2.0 * w / total) * g) + _product(mean, mean))


def _inverse(variance: np.ndarray, pairing: Pairing, link_std: float) -> np.ndarray:
    """Return D' F^-1 D: (n, N, N) 1/m^2."""
    d = pairing.incidence()
    return d.T @ np.linalg.inv(pairing.covariance(variance, link_std)) @ d


def _product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    return left.swapaxes(1, 2) @ right


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
        link_std=0.0,
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
