"""Making a BiasMap out of measured and true positions, and saying how precise it is elsewhere."""

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

FOLDS = 5  # into which parts are shared out, if there are more
LOST = 1.0  # m; what is further off is no measurement of a bias
LARGEST = 1e4  # times the map's own error that may be added to a covariance


class Part:
    """What was measured in one go: a flight, or the stay at one point of a grid.

    measured, true : (N, 3) m, world frame; covariance : (N, 3, 3) m^2 of measured, or None where
        nobody knows it. Pairs
    that are more than LOST apart, or not finite, are left out.
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
    """Arguments of `fit`."""

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
    """BiasMap of a list of Part. Raises InputError where they hold too little.

    step : m, of the grid; least : measurements that make a marker; planar : map x and y only;
        anchors : Anchors that
    the map is for. `added` comes from maps that were fitted without some of the parts and asked
    about them (without stretches of it, if there is one part only): their mean squared error at
    markers. If the covariances of the measured positions are known, as much of it is added as makes
    the normalised squared error of the corrected positions d on average there, nothing if they are
    honest as they are; else all of it.
    """
    options = _Options(step, least, planar, interpolator, anchors, source)
    whole = _fit(parts, options, np.zeros((2, 2) if planar else (3, 3)))
    folds = _folds(parts)
    bias_errors, errors, covariances = [np.empty((0, whole.at.shape[1]))], [], []
    for k, held_out in enumerate(folds):
        others = [part for i, fold in enumerate(folds) if i != k for part in fold]
        try:
            bias_map = _fit(others, options, whole.added)
        except InputError:  # the rest alone makes no map
            continue
        bias_errors.append(_bias_errors(bias_map, held_out, options))
        for part in held_out:
            error, covariance = _position_errors(bias_map, part)
            errors.append(error)
            covariances.append(covariance)
    deviations = np.concatenate(bias_errors)
    if len(deviations) == 0:  # nothing was known elsewhere: as unsure as without a map
        return _fit(parts, options, whole.bias.T @ whole.bias / len(whole.bias))
    added = deviations.T @ deviations / len(deviations)
    known = [covariance for covariance in covariances if covariance is not None]
    if sum(map(len, errors)) and len(known) == len(covariances):
        added = added * _needed(np.concatenate(errors), np.concatenate(known), added)
    return _fit(parts, options, added)


def _bias_errors(bias_map: BiasMap, parts: list[Part], options: _Options) -> np.ndarray:
    """Biases of the markers that parts make, less what a map of others says where it is valid: (n,
    d) m.
    """
    markers = _markers(parts, options)
    at = _in_space(measured_places(markers, markers.bias))
    error = markers.bias - bias_map.bias_at(at)[:, : markers.bias.shape[1]]
    return error[bias_map.validity(at) == 1.0]


def _position_errors(bias_map: BiasMap, part: Part) -> tuple[np.ndarray, np.ndarray | None]:
    """What a map of others leaves of the errors of a Part where it is valid, (n, d) m; their
    covariances or None.
    """
    d, valid = bias_map.at.shape[1], bias_map.validity(part.measured) == 1.0
    p = part.measured[valid]
    error = (p - bias_map.bias_at(p) - part.true[valid])[:, :d]
    return error, None if part.covariance is None else part.covariance[valid, :d, :d]


def _needed(error: np.ndarray, covariance: np.ndarray, added: np.ndarray) -> float:
    """The factor of `added` with which the mean of e' (P + factor added)^-1 e is d, the number of
    dimensions; 0 or more.
    """

    def excess(factor: float) -> float:
        solved = np.linalg.solve(covariance + factor * added, error[:, :, None])[:, :, 0]
        return np.mean(np.einsum("nd,nd->n", error, solved)) - error.shape[1]

    if excess(0.0) <= 0.0:
        return 0.0
    return brentq(excess, 0.0, LARGEST, rtol=1e-3) if excess(LARGEST) < 0.0 else LARGEST


def _fit(parts: list[Part], options: _Options, added: np.ndarray) -> BiasMap:
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
    """Lists of parts to be left out together; stretches of it, if there is only one."""
    if len(parts) > 1:
        return [parts[k::FOLDS] for k in range(min(FOLDS, len(parts)))]
    columns = [np.array_split(column, FOLDS) for column in (parts[0].measured, parts[0].true)]
    covariance = parts[0].covariance
    covariances = [None] * FOLDS if covariance is None else np.array_split(covariance, FOLDS)
    return [[Part(*stretch)] for stretch in zip(*columns, covariances)]


def _in_space(p: np.ndarray) -> np.ndarray:
    """(n, 3) of (n, 2) or (n, 3)."""
    return np.pad(p, ((0, 0), (0, 3 - p.shape[1])))
