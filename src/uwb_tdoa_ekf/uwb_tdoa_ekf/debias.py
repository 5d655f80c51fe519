# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Correct estimated positions with a map of their bias.

`fit` fits a BiasMap to measured and true positions, and estimates its precision at other places. The method
follows Grasso et al., *Analysis and Accuracy Improvement of UWB-TDoA-Based Indoor Positioning System* (Sensors 2022, 22, 9136)::

    from uwb_tdoa_ekf.debias import BiasMap, Part, fit
    bias_map = fit([Part(odometry.p, truth_p, odometry.covariance[:, :3, :3])], step=0.35)
    bias_map.save("map.npz")
    p, covariance, validity = BiasMap.load("map.npz").correct(p, covariance)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline, RBFInterpolator
from scipy.optimize import brentq
from scipy.spatial import ConvexHull, QhullError, cKDTree

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import MAP_MARKERS, InputError
from uwb_tdoa_bias.common.files import read_arrays, write_filled

FORMAT, VERSION = "uwb_tdoa position bias map", 4
UNITS = (
    "metres, square metres for added, in the world frame named by frame; bias is measured minus "
    "true"
)
# of the thin plate through the biases: a larger one follows them less. Chosen on the nine flights of
# 0426, each left out once.
SMOOTHING = 0.1
# m beyond the known region over which the correction fades to 0; see docs/notebook/debiasing.md
FADE = 1.0
LARGEST = 1e5  # m; a larger number is an error
_ARRAYS = {"at": "f", "bias": "f", "added": "f", "ids": "i", "positions": "f"}
_NUMBERS, _TEXTS = {"version": "i", "step": "f"}, ("format", "units", "frame", "source")


@dataclass(frozen=True)
class BiasMap:
    """Store biases at n markers in the plane and interpolate between them by a thin plate.

    A position is known inside the convex hull of the markers and within one step of the nearest
    marker. Beyond that region, the correction fades to 0 over FADE.

    Attributes
    ----------
    at : (n, 2) array
        Measured places of the markers in the world frame, in m, eq. 19.
    bias : (n, 2) array
        Bias b*, measured minus true, in m, eqs. 17 and 18.
    added : (2, 2) array
        Covariance to add to that of a corrected position, in m^2; see `fit`.
    step : float
        Cell size of the grid, in m.
    frame : str
        Name of the world frame.
    source : str
        Origin of the map, free text.
    ids, positions : (N,) and (N, 3) array
        Ids and positions, in m, of the anchors of the map. Without any, the map belongs to no
        anchors.
    """

    at: np.ndarray
    bias: np.ndarray
    added: np.ndarray
    step: float
    frame: str = "map"
    source: str = ""
    ids: np.ndarray = field(default_factory=lambda: np.empty(0, int))
    positions: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    _hull: np.ndarray = field(init=False, repr=False, compare=False)
    _tree: cKDTree = field(init=False, repr=False, compare=False)
    _plate: RBFInterpolator = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        """Check the fields, raise InputError, and prepare hull and thin plate."""
        n, anchors = len(self.at), len(self.ids)
        shapes = [array.shape for array in (self.at, self.bias, self.added)]
        if shapes != [(n, 2), (n, 2), (2, 2)] or self.positions.shape != (anchors, 3):
            raise InputError("bias map: its arrays do not fit together.")
        if n > MAP_MARKERS:
            raise InputError(
                f"bias map: {n} markers are more than {MAP_MARKERS}; map with a larger step."
            )
        arrays = (self.at, self.bias, self.added, self.positions)
        numbers = np.concatenate([[self.step], *(array.ravel() for array in arrays)])
        if not (np.abs(numbers) <= LARGEST).all():
            raise InputError(
                f"bias map: it holds a number that is not finite or above {LARGEST:g}."
            )
        if self.step <= 0.0:
            raise InputError(f"bias map: its step is {self.step:g} m; it must be above 0.")
        if (
            not np.allclose(self.added, self.added.T)
            or np.linalg.eigvalsh(self.added).min() < -1e-9
        ):
            raise InputError("bias map: added is no covariance.")
        try:
            hull = ConvexHull(self.at).equations
        except (QhullError, ValueError) as error:
            raise InputError(
                f"bias map: its {n} markers are too few, or lie on one line; measure more places."
            ) from error
        plate = RBFInterpolator(self.at, self.bias, smoothing=SMOOTHING)
        object.__setattr__(self, "_hull", hull)
        object.__setattr__(self, "_tree", cKDTree(self.at))
        object.__setattr__(self, "_plate", plate)

    @property
    def mean_square(self) -> np.ndarray:
        """Return the mean square of all biases, (2, 2) m^2."""
        return self.bias.T @ self.bias / len(self.bias)

    def belongs_to(self, anchors: Anchors) -> bool:
        """Return whether the map was made for these Anchors."""
        return bool(len(self.ids)) and anchors.stand_at(self.ids, self.positions, self.frame)

    def scaled(self, share: float) -> BiasMap:
        """Return a BiasMap with all biases scaled by `share`, 0 to 1.

        The uncorrected part of the bias is included in `added`.
        """
        added = share**2 * self.added + (1.0 - share) ** 2 * self.mean_square
        return replace(self, bias=share * self.bias, added=added)

    def validity(self, p: np.ndarray) -> np.ndarray:
        """Return the validity of the map at positions p (m, 2), in m: (m,), 0 to 1.

        The validity is 1 in the known region and 0 from a distance of FADE.
        """
        outside = (p @ self._hull[:, :2].T + self._hull[:, 2]).max(axis=1)
        far_from_markers = self._tree.query(p)[0] - self.step
        return np.clip(1.0 - np.maximum(outside, far_from_markers) / FADE, 0.0, 1.0)

    def bias_at(self, p: np.ndarray) -> np.ndarray:
        """Return the faded bias beta of eq. 20 at measured positions p (m, 2), in m: (m, 2) m."""
        return self.validity(p)[:, None] * self._plate(p)

    def correct(
        self, p: np.ndarray, covariance: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return positions without their bias (eq. 21) and the covariance of the remaining error.

        At validity w, the covariance increases by two terms. The term w^2 `added` covers errors of
        the map. The term (1 - w)^2 times the mean square of all biases covers the uncorrected bias.

        Parameters
        ----------
        p : (m, 3) array
            Positions in the world frame, in m. z stays.
        covariance : (m, 3, 3) array
            Their covariance, in m^2.

        Returns
        -------
        p : (m, 3) array
            Corrected positions, in m.
        covariance : (m, 3, 3) array
            Their covariance, in m^2.
        validity : (m,) array
            Validity of the map, 0 to 1.
        """
        validity, p, covariance = self.validity(p[:, :2]), p.copy(), covariance.copy()
        p[:, :2] -= self.bias_at(p[:, :2])
        known, unknown = validity[:, None, None] ** 2, (1.0 - validity[:, None, None]) ** 2
        covariance[:, :2, :2] += known * self.added + unknown * self.mean_square
        return p, covariance, validity

    def save(self, path: Path) -> None:
        """Write the map to a numpy .npz file that states its format, version and units."""
        names = (*_ARRAYS, "step", "frame", "source")
        content = {name: getattr(self, name) for name in names}
        content |= {"format": FORMAT, "version": VERSION, "units": UNITS}
        write_filled(path, lambda file: np.savez_compressed(file, **content))

    @classmethod
    def load(cls, path: str | Path) -> BiasMap:
        """Read a file that `save` wrote.

        Raises InputError if the file is damaged, of another version, or no valid map.
        """
        what, remedy = f"position bias map of version {VERSION}", "make one with `debias`"
        kinds = _ARRAYS | _NUMBERS | dict.fromkeys(_TEXTS, "U")
        content = read_arrays(path, kinds, what, remedy)
        try:
            if str(content["format"]) != FORMAT or int(content["version"]) != VERSION:
                raise ValueError(f"format {content['format']}, version {content['version']}")
            return cls(
                **{name: content[name] for name in _ARRAYS},
                step=float(content["step"]),
                frame=str(content["frame"]),
                source=str(content["source"]),
            )
        except (TypeError, ValueError, OverflowError) as error:  # InputError is a ValueError
            raise InputError(f"{path}: is no {what} ({error}); {remedy}.") from error


COVERAGE = 3.0  # standard deviations on each side in the integrals of eqs. 17 and 18
_ABSCISSAE = np.linspace(-COVERAGE, COVERAGE, 61)
_WEIGHTS = np.exp(-0.5 * _ABSCISSAE**2)
_WEIGHTS[[0, -1]] *= 0.5  # trapezoidal rule
_WEIGHTS /= _WEIGHTS.sum()
FOLDS = 5  # folds for cross-validation, if there are more parts
LOST = 1.0  # m; a pair with a larger error does not measure a bias
MOST_ADDED = 1e4  # largest factor of `added`


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
    return BiasMap(at, bias, np.zeros((2, 2)), step)


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
    return brentq(excess, 0.0, MOST_ADDED, rtol=1e-3) if excess(MOST_ADDED) < 0.0 else MOST_ADDED
