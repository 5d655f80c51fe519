# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compute markers with a bias each from pairs of measured and true positions.

The method is Grasso et al. (Sensors 2022, 22, 9136), eqs. 15 - 19 and 22, in two dimensions as
published or in three.

Static data have many measurements at each point of a grid. Dynamic data have one at each instant of
a path. Both are treated the same way: a marker is the mean of the measurements in one cell of a
grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

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
