# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fit a BiasMap to measured and true positions and estimate its precision at other places."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.optimize import brentq

from uwb_tdoa_bias.common.errors import InputError

from .bias_map import BiasMap
from .markers import collect, corrected_bias, measured_places

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.anchors import Anchors

    from .markers import Markers

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
    markers. If the covariances of the positions are known, `added` is scaled. The scale makes the
    normalised squared error of the held-out positions d on average. It is 0 if the covariances
    alone are large enough.

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
        except InputError:  # the remaining parts are too few for a map
            continue
        bias_errors.append(_bias_errors(bias_map, held_out, options))
        for part in held_out:
            error, covariance = _position_errors(bias_map, part)
            errors.append(error)
            covariances.append(covariance)
    deviations = np.concatenate(bias_errors)
    # no held-out marker is in a known region: assume the error without a map
    if len(deviations) == 0:
        return _fit(parts, options, whole.bias.T @ whole.bias / len(whole.bias))
    added = deviations.T @ deviations / len(deviations)
    known = [covariance for covariance in covariances if covariance is not None]
    if sum(map(len, errors)) and len(known) == len(covariances):
        added = added * _needed(np.concatenate(errors), np.concatenate(known), added)
    return _fit(parts, options, added)


def _bias_errors(bias_map: BiasMap, parts: list[Part], options: _Options) -> np.ndarray:
    """Return marker biases of held-out parts minus the map, where it is valid, (n, d) m."""
    markers = _markers(parts, options)
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


def _needed(error: np.ndarray, covariance: np.ndarray, added: np.ndarray) -> float:
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
