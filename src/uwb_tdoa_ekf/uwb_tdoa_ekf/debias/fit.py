# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fit a BiasMap to measured and true positions and estimate its precision at other places."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.optimize import brentq

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError

from .bias_map import BiasMap

COVERAGE = 3.0  # standard deviations on each side in the integrals of eqs. 17 and 18
_ABSCISSAE = np.linspace(-COVERAGE, COVERAGE, 61)
_WEIGHTS = np.exp(-0.5 * _ABSCISSAE**2)
_WEIGHTS[[0, -1]] *= 0.5  # trapezoidal rule
_WEIGHTS /= _WEIGHTS.sum()


@dataclass(frozen=True)
class Markers:
    """Store n markers in d = 2 or 3 dimensions, in the world frame.

    Attributes
    ----------
    cell : (n, d) int array
        Place in a grid.
    true : (n, d) array
        True places, in m.
    bias : (n, d) array
        Mean of measured minus true, in m.
    std : (n, d) array
        Standard deviation of measured minus true, in m.
    count : (n,) int array
        Number of measurements.
    """

    cell: np.ndarray
    true: np.ndarray
    bias: np.ndarray
    std: np.ndarray
    count: np.ndarray

    def __len__(self) -> int:
        return len(self.cell)


def collect(measured: np.ndarray, true: np.ndarray, step: float, least: int = 1) -> Markers:
    """Return the Markers of N pairs of positions, one for each cell with enough pairs.

    The grid starts at the smallest true coordinates. Points that were surveyed on a grid of this
    step therefore have a cell each. Bias b, standard deviation and mean square follow eq. 22.

    Parameters
    ----------
    measured, true : (N, d) array
        Positions, in m.
    step : float
        Cell size of the grid, in m.
    least : int
        Smallest number of pairs of a marker.
    """
    cell = np.floor((true - true.min(axis=0)) / step + 0.5).astype(int)
    cells, of, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    of = of.ravel()

    def mean(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(of, column) for column in values.T], axis=1) / count[:, None]

    error = measured - true
    bias = mean(error)
    std = np.sqrt(np.maximum(mean(error**2) - bias**2, 0.0))
    keep = count >= least
    return Markers(cells[keep], mean(true)[keep], bias[keep], std[keep], count[keep])


def corrected_bias(markers: Markers) -> np.ndarray:
    """Return b*, (n, d) m: the bias expected where a marker was measured, eqs. 17 and 18.

    Cubic splines interpolate the biases of the markers on each axis-parallel line. A Gaussian with
    the marker's standard deviation along that axis averages the spline over +-3 standard
    deviations. b* is the mean over the axes: the two of the plane as published, or all three.

    Two details differ from the paper. The weights of the Gaussian sum to 1 here, whereas the
    published integral omits 0.3 %. Beyond the last marker of a line the spline keeps its last
    value, a case that the paper does not define.
    """
    d = markers.true.shape[1]
    total = np.zeros_like(markers.bias)
    for axis in range(d):
        line = np.delete(markers.cell, axis, axis=1)
        _, of = np.unique(line, axis=0, return_inverse=True)
        of = of.ravel()
        order = np.lexsort((markers.cell[:, axis], of))
        for rows in np.split(order, np.flatnonzero(np.diff(of[order])) + 1):
            at = markers.true[rows, axis]
            if len(rows) == 1:
                total[rows] += markers.bias[rows]
                continue
            spline = CubicSpline(at, markers.bias[rows], bc_type="natural")
            around = at[:, None] + markers.std[rows, axis, None] * _ABSCISSAE
            total[rows] += np.einsum("k,nkd->nd", _WEIGHTS, spline(np.clip(around, at[0], at[-1])))
    return total / d


def measured_places(markers: Markers, bias: np.ndarray) -> np.ndarray:
    """Return where the markers are measured, (n, d) m: the deformed grid X + b* of eq. 19."""
    return markers.true + bias


FOLDS = 5  # folds for cross-validation, if there are more parts
LOST = 1.0  # m; a pair with a larger error does not measure a bias
LARGEST = 1e4  # largest factor of `added`


class Part:
    """Store the measurements of one flight, or of one point of a grid.

    Pairs that are not finite, or more than LOST apart, are dropped.

    Parameters
    ----------
    measured, true : (N, 3) array
        Positions in the world frame, in m.
    covariance : (N, 3, 3) array or None
        Covariance of `measured`, in m^2; None if unknown.
    """

    def __init__(
        self, measured: np.ndarray, true: np.ndarray, covariance: np.ndarray | None = None
    ) -> None:
        usable = np.linalg.norm(measured - true, axis=1) <= LOST
        self.measured, self.true = measured[usable], true[usable]
        self.covariance = None if covariance is None else covariance[usable]

    def __len__(self) -> int:
        return len(self.measured)


class _Options(NamedTuple):
    """Store the arguments of `fit`."""

    step: float
    least: int
    planar: bool
    interpolator: str
    anchors: Anchors | None
    source: str


def fit(
    parts: list[Part],
    step: float,
    least: int = 1,
    planar: bool = False,
    interpolator: str = "thin_plate",
    anchors: Anchors | None = None,
    source: str = "",
) -> BiasMap:
    """Return the BiasMap of several Parts; raise InputError if they hold too few measurements.

    The covariance `added` comes from cross-validation. Maps are fitted without some of the parts,
    or without stretches of a single part. `added` is their mean squared error at the held-out
    markers. Held-out parts without a marker are left out of these figures. If the covariances of
    the positions are known, `added` is scaled. The scale makes the normalised squared error of the
    held-out positions d on average. It is 0 if the covariances alone are large enough.

    Parameters
    ----------
    parts : list of Part
        Measurements.
    step : float
        Cell size of the grid, in m.
    least : int
        Smallest number of measurements of a marker.
    planar : bool
        Map x and y only.
    interpolator : str
        One of INTERPOLATORS.
    anchors : Anchors or None
        Anchors of the map.
    source : str
        Origin of the map, free text.
    """
    options = _Options(step, least, planar, interpolator, anchors, source)
    whole = _fit(parts, options, np.zeros((2, 2) if planar else (3, 3)))
    folds = _folds(parts)
    bias_errors, errors, covariances = [np.empty((0, whole.at.shape[1]))], [], []
    for k, held_out in enumerate(folds):
        others = [part for i, fold in enumerate(folds) if i != k for part in fold]
        try:
            bias_map = _fit(others, options, whole.added)
            markers = _markers(held_out, options)
        except InputError:  # too few others for a map, or no marker in the held-out parts
            continue
        bias_errors.append(_bias_errors(bias_map, markers))
        for part in held_out:
            error, covariance = _position_errors(bias_map, part)
            errors.append(error)
            covariances.append(covariance)
    deviations = np.concatenate(bias_errors)
    # no held-out marker is in a known region: assume the error without a map
    if len(deviations) == 0:
        mean_square = whole.bias.T @ whole.bias / len(whole.bias)
        return _fit(parts, options, mean_square)
    added = deviations.T @ deviations / len(deviations)
    known = [covariance for covariance in covariances if covariance is not None]
    if sum(map(len, errors)) and len(known) == len(covariances):
        added = added * _needed_factor(np.concatenate(errors), np.concatenate(known), added)
    return _fit(parts, options, added)


def _bias_errors(bias_map: BiasMap, markers: Markers) -> np.ndarray:
    """Return the raw mean bias of held-out markers minus the map, where it is valid, (n, d) m.

    It uses the raw means, not the smoothed biases of `corrected_bias`.
    """
    at = _in_space(measured_places(markers, markers.bias))
    error = markers.bias - bias_map.bias_at(at)[:, : markers.bias.shape[1]]
    return error[bias_map.validity(at) == 1.0]


def _position_errors(bias_map: BiasMap, part: Part) -> tuple[np.ndarray, np.ndarray | None]:
    """Return the corrected errors of a held-out Part where the map is valid, and their covariances.

    Returns
    -------
    error : (n, d) array
        Errors, in m.
    covariance : (n, d, d) array or None
        Stated covariances, in m^2.
    """
    d, valid = bias_map.at.shape[1], bias_map.validity(part.measured) == 1.0
    p = part.measured[valid]
    error = (p - bias_map.bias_at(p) - part.true[valid])[:, :d]
    return error, None if part.covariance is None else part.covariance[valid, :d, :d]


def _needed_factor(error: np.ndarray, covariance: np.ndarray, added: np.ndarray) -> float:
    """Return the factor, at least 0, that makes the normalised squared error d on average.

    The normalised squared error is e' (P + factor added)^-1 e, and d is the number of dimensions.
    """

    def excess(factor: float) -> float:
        solved = np.linalg.solve(covariance + factor * added, error[:, :, None])[:, :, 0]
        return np.mean(np.einsum("nd,nd->n", error, solved)) - error.shape[1]

    if excess(0.0) <= 0.0:
        return 0.0
    return brentq(excess, 0.0, LARGEST, rtol=1e-3) if excess(LARGEST) < 0.0 else LARGEST


def _fit(parts: list[Part], options: _Options, added: np.ndarray) -> BiasMap:
    # Return the BiasMap of parts with a given `added`.
    markers = _markers(parts, options)
    bias = corrected_bias(markers)
    at = measured_places(markers, bias)
    made = BiasMap(
        markers.cell,
        at,
        bias,
        markers.std,
        markers.count,
        added,
        options.step,
        options.interpolator,
        source=options.source,
    )
    anchors = options.anchors
    return (
        replace(made, frame=anchors.frame, ids=anchors.ids, positions=anchors.positions)
        if anchors is not None
        else made
    )


def _markers(parts: list[Part], options: _Options) -> Markers:
    # Return the Markers of parts; raise InputError if there are none.
    parts = [part for part in parts if len(part)]
    if not parts:
        raise InputError(
            f"positions: none is within {LOST:g} m of the truth; is it in the same frame, by "
            "the same clock?"
        )
    d, step, least = 2 if options.planar else 3, options.step, options.least
    measured, true = (
        np.concatenate([getattr(part, name)[:, :d] for part in parts])
        for name in ("measured", "true")
    )
    markers = collect(measured, true, step, least)
    if len(markers) == 0:
        raise InputError(
            f"step: no cell of {step:g} m holds {least} positions; give a larger step, or "
            "more data."
        )
    return markers


def _folds(parts: list[Part]) -> list[list[Part]]:
    """Return lists of parts that are held out together; stretches if there is one part only."""
    if len(parts) > 1:
        return [parts[k::FOLDS] for k in range(min(FOLDS, len(parts)))]
    columns = [np.array_split(column, FOLDS) for column in (parts[0].measured, parts[0].true)]
    covariance = parts[0].covariance
    covariances = [None] * FOLDS if covariance is None else np.array_split(covariance, FOLDS)
    return [[Part(*stretch)] for stretch in zip(*columns, covariances)]


def _in_space(p: np.ndarray) -> np.ndarray:
    """Return (n, 3) of (n, 2) or (n, 3), with z = 0 if missing."""
    return np.pad(p, ((0, 0), (0, 3 - p.shape[1])))
