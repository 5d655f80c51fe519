"""From pairs of measured and true positions to a cloud of markers with a bias each: Grasso et al.
(Sensors 2022, 22, 9136), eqs. 15 - 19 and 22, in two dimensions as published or in three.

Static data (many measurements at each point of a grid) and dynamic data (one at each instant of a
path) go the same way: the markers of a path are the means of what was measured in each cell of a
grid.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

COVERAGE = 3.0  # standard deviations to each side that the integrals of eqs. 17 and 18 cover
_ABSCISSAE = np.linspace(-COVERAGE, COVERAGE, 61)
_WEIGHTS = np.exp(-0.5 * _ABSCISSAE**2)
_WEIGHTS[[0, -1]] *= 0.5  # trapezoidal rule
_WEIGHTS /= _WEIGHTS.sum()


@dataclass(frozen=True)
class Markers:
    """n markers in d = 2 or 3 dimensions, world frame.

    cell : (n, d) int, place in a grid; true : (n, d) m, where they are; bias : (n, d) m, mean of
        measured minus true;
    std : (n, d) m, its standard deviation; count : (n,) measurements.
    """

    cell: np.ndarray
    true: np.ndarray
    bias: np.ndarray
    std: np.ndarray
    count: np.ndarray

    def __len__(self) -> int:
        return len(self.cell)


def collect(measured: np.ndarray, true: np.ndarray, step: float, least: int = 1) -> Markers:
    """Markers of N pairs of positions: one for each cell of a grid of `step` m that holds at least
    `least` pairs.

    measured, true : (N, d) m. The grid starts at the smallest true coordinates, so that points
        surveyed on a grid of
    this step keep a cell each. bias b, standard deviation and mean square as in eq. 22.
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
    """b*, (n, d) m: the bias to expect where a marker was measured, eqs. 17 and 18.

    Along each axis through a marker, cubic splines through the biases of the markers on that line
    are averaged with the Gaussian of the marker's standard deviation along that axis over +-3 of
    them; b* is the mean over the axes (the two of the plane as published, or all three). Here the
    Gaussian's weights add up to one, where the published integral over +-3 standard deviations
    leaves out 0.3 %, and beyond the last marker of a line the spline keeps its value there, of
    which the paper does not speak.
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
    """Where the markers are measured, (n, d) m: the deformed grid of eq. 19, X + b*."""
    return markers.true + bias
