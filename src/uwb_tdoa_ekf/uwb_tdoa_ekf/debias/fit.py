# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fit a BiasMap to measured and true positions and estimate its precision at other places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from uwb_tdoa_bias.common.errors import InputError

from .bias_map import BiasMap

COVERAGE = 3.0  # standard deviations on each side in the integrals of eqs. 17 and 18
_ABSCISSAE = np.linspace(-COVERAGE, COVERAGE, 61)
_WEIGHTS = np.exp(-0.5 * _ABSCISSAE**2)
_WEIGHTS[[0, -1]] *= 0.5  # trapezoidal rule
_WEIGHTS /= _WEIGHTS.sum()
FOLDS = 5  # folds for cross-validation, if there are more parts
LOST = 1.0  # m; a pair with a larger error does not measure a bias
LARGEST = 1e4  # largest factor of `added`


class Part:
    """Store the measurements of one flight, or of one point of a grid, in the plane.

    Pairs that are not finite, or more than LOST apart, are dropped.

    Parameters
    ----------
    measured, true : (N, 2) or (N, 3) array
        Positions in the world frame, in m.
    covariance : (N, 3, 3) array or None
        Covariance of `measured`, in m^2; None if unknown.
    """

    def __init__(
        self, measured: np.ndarray, true: np.ndarray, covariance: np.ndarray | None = None
    ) -> None:
        usable = np.linalg.norm(measured - true, axis=1) <= LOST
        self.measured, self.true = measured[usable, :2], true[usable, :2]
        self.covariance = None if covariance is None else covariance[usable, :2, :2]

    def __len__(self) -> int:
        return len(self.measured)


@dataclass(frozen=True)
class Markers:
    """Store n markers in the plane, in the world frame.

    Attributes
    ----------
    cell : (n, 2) int array
        Place in a grid.
    true : (n, 2) array
        True places, in m.
    bias : (n, 2) array
        Mean of measured minus true, in m.
    std : (n, 2) array
        Standard deviation of measured minus true, in m.
    """

    cell: np.ndarray
    true: np.ndarray
    bias: np.ndarray
    std: np.ndarray


def collect(parts: Sequence[Part], step: float, least: int = 1) -> Markers:
    """Return the Markers of Parts, one for each cell with enough pairs of positions.

    The grid starts at the smallest true coordinates. Points that were surveyed on a grid of this
    step therefore have a cell each. Bias b, standard deviation and mean square follow eq. 22.

    Raises InputError if no cell has enough pairs.

    Parameters
    ----------
    parts : sequence of Part
    step : float
        Cell size of the grid, in m.
    least : int
        Smallest number of pairs of a marker.
    """
    if not sum(map(len, parts)):
        raise InputError(
            f"positions: none is within {LOST:g} m of the truth; is it in the same frame, by "
            "the same clock?"
        )
    true = np.concatenate([part.true for part in parts])
    error = np.concatenate([part.measured for part in parts]) - true
    cell = np.floor((true - true.min(axis=0)) / step + 0.5).astype(int)
    cells, of, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    keep = count >= least
    if not keep.any():
        raise InputError(
            f"step: no cell of {step:g} m holds {least} positions; give a larger step, or "
            "more data."
        )

    def mean(values: np.ndarray) -> np.ndarray:
        sums = [np.bincount(of.ravel(), column) for column in values.T]
        return (np.stack(sums, axis=1) / count[:, None])[keep]

    bias = mean(error)
    std = np.sqrt(np.maximum(mean(error**2) - bias**2, 0.0))
    return Markers(cells[keep], mean(true), bias, std)


def corrected_bias(markers: Markers) -> np.ndarray:
    """Return b*, (n, 2) m: the bias expected where a marker was measured, eqs. 17 and 18.

    Cubic splines interpolate the biases of the markers on each axis-parallel line. A Gaussian with
    the marker's standard deviation along that axis averages the spline over +-3 standard
    deviations. b* is the mean over both axes.

    Two details differ from the paper. The weights of the Gaussian sum to 1 here, whereas the
    published integral omits 0.3 %. Beyond the last marker of a line the spline keeps its last
    value, a case that the paper does not define.
    """
    total = np.zeros_like(markers.bias)
    for axis in range(2):
        for line in np.unique(markers.cell[:, 1 - axis]):
            rows = np.flatnonzero(markers.cell[:, 1 - axis] == line)  # sorted along the axis
            at = markers.true[rows, axis]
            if len(rows) == 1:
                total[rows] += markers.bias[rows]
                continue
            spline = CubicSpline(at, markers.bias[rows], bc_type="natural")
            around = at[:, None] + markers.std[rows, axis, None] * _ABSCISSAE
            total[rows] += np.einsum("k,nkd->nd", _WEIGHTS, spline(np.clip(around, at[0], at[-1])))
    return total / 2


def fit(parts: Sequence[Part], step: float, least: int = 1) -> BiasMap:
    """Return the BiasMap of several Parts; raise InputError if they hold too few measurements.

    The covariance `added` comes from cross-validation. Maps are fitted without some of the parts,
    or without stretches of a single part. `added` is their mean squared error at the held-out
    markers. Held-out parts without a marker are left out of these figures. If the covariances of
    the positions are known, `added` is scaled. The scale makes the normalised squared error of the
    held-out positions 2 on average. It is 0 if the covariances alone are large enough.

    Parameters
    ----------
    parts : sequence of Part
        Measurements.
    step : float
        Cell size of the grid, in m.
    least : int
        Smallest number of measurements of a marker.
    """
    whole = _fit(parts, step, least)
    parts = parts if len(parts) > 1 else _stretches(parts[0])
    of_markers, errors, covariances = [np.empty((0, 2))], [], []
    for k in range(min(FOLDS, len(parts))):
        held_out = parts[k::FOLDS]
        others = [part for i, part in enumerate(parts) if i % FOLDS != k]
        try:
            bias_map, markers = _fit(others, step, least), collect(held_out, step, least)
        except InputError:  # too few others for a map, or no marker in the held-out parts
            continue
        of_markers.append(_known_errors(bias_map, markers.true + markers.bias, markers.true)[0])
        for part in held_out:
            error, known = _known_errors(bias_map, part.measured, part.true)
            errors.append(error)
            if part.covariance is not None:
                covariances.append(part.covariance[known])
    deviations = np.concatenate(of_markers)
    # no held-out marker is in a known region: assume the error without a map
    if len(deviations) == 0:
        return replace(whole, added=whole.mean_square)
    added = deviations.T @ deviations / len(deviations)
    if sum(map(len, errors)) and len(covariances) == len(errors):
        added = added * _needed_factor(np.concatenate(errors), np.concatenate(covariances), added)
    return replace(whole, added=added)


def _fit(parts: Sequence[Part], step: float, least: int) -> BiasMap:
    """Return the BiasMap of Parts, with `added` 0."""
    markers = collect(parts, step, least)
    bias = corrected_bias(markers)
    at = markers.true + bias  # the deformed grid X + b* of eq. 19
    return BiasMap(markers.cell, at, bias, np.zeros((2, 2)), step)


def _stretches(part: Part) -> list[Part]:
    """Return a Part cut into FOLDS."""
    rows = np.array_split(np.arange(len(part)), FOLDS)
    known = part.covariance
    return [
        Part(part.measured[some], part.true[some], None if known is None else known[some])
        for some in rows
    ]


def _known_errors(
    bias_map: BiasMap, measured: np.ndarray, true: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return errors after the map where it is fully valid, (n, 2) m, and whether it is, (m,)."""
    known = bias_map.validity(measured) == 1.0
    return (measured - bias_map.bias_at(measured) - true)[known], known


def _needed_factor(error: np.ndarray, covariance: np.ndarray, added: np.ndarray) -> float:
    """Return the factor, at least 0, that makes the normalised squared error 2 on average.

    The normalised squared error is e' (P + factor added)^-1 e, in two dimensions.
    """

    def excess(factor: float) -> float:
        solved = np.linalg.solve(covariance + factor * added, error[:, :, None])[:, :, 0]
        return np.mean(np.einsum("nd,nd->n", error, solved)) - error.shape[1]

    if excess(0.0) <= 0.0:
        return 0.0
    return brentq(excess, 0.0, LARGEST, rtol=1e-3) if excess(LARGEST) < 0.0 else LARGEST
