"""Making a BiasMap out of measured and true positions, and saying how far it can be believed elsewhere."""

import numpy as np
from scipy.optimize import brentq

from uwb_tdoa_bias.foundation.errors import InputError

from .bias_map import BiasMap
from .markers import collect, corrected_bias, measured_places

FOLDS = 5  # into which parts are shared out, if there are more
LOST = 1.0  # m; what is further off is no measurement of a bias
LARGEST = 1e4  # times the map's own error that may be added to a covariance


class Part:
    """What was measured in one go: a flight, or the stay at one point of a grid.

    measured, true : (N, 3) m, world frame; covariance : (N, 3, 3) m^2 of measured, or None where nobody knows it. Pairs
    that are more than LOST apart, or not finite, are left out.
    """

    def __init__(self, measured, true, covariance=None):
        usable = np.linalg.norm(measured - true, axis=1) <= LOST
        self.measured, self.true = measured[usable], true[usable]
        self.covariance = None if covariance is None else covariance[usable]

    def __len__(self):
        return len(self.measured)


def fit(parts, step, least=1, planar=False, interpolator="thin_plate", frame="map", source=""):
    """BiasMap of a list of Part. Raises InputError where they hold too little.

    step : m, of the grid; least : measurements that make a marker; planar : map x and y only.
    `added` comes from maps that were fitted without some of the parts and asked about them (without stretches of it, if
    there is one part only): their mean squared error at markers. If the covariances of the measured positions are
    known, as much of it is added as makes the normalised squared error of the corrected positions d on average there,
    nothing if they are honest as they are; else all of it.
    """
    grid = (step, least, planar, interpolator, frame, source)
    whole = _fit(parts, *grid, np.zeros((2, 2) if planar else (3, 3)))
    folds, d = _folds(parts), whole.at.shape[1]
    wrong, left, covariances = [], [], []
    for k, held in enumerate(folds):
        others = [part for i, fold in enumerate(folds) if i != k for part in fold]
        try:
            found = _fit(others, *grid, whole.added)
        except InputError:  # the rest alone makes no map
            continue
        markers = _markers(held, *grid[:3])
        at = _in_space(measured_places(markers, markers.bias))
        known = found.trust(at) == 1.0
        wrong.append((markers.bias - found.bias_at(at)[:, :d])[known])
        for part in held:
            known = found.trust(part.measured) == 1.0
            p = part.measured[known]
            left.append((p - found.bias_at(p) - part.true[known])[:, :d])
            covariances.append(None if part.covariance is None else part.covariance[known, :d, :d])
    wrong = np.concatenate(wrong) if wrong else np.empty((0, d))
    if len(wrong) == 0:  # nothing was known elsewhere: as unsure as without a map
        added = whole.bias.T @ whole.bias / len(whole.bias)
    else:
        added = wrong.T @ wrong / len(wrong)
        if sum(map(len, left)) and all(covariance is not None for covariance in covariances):
            added = added * _needed(np.concatenate(left), np.concatenate(covariances), added)
    return _fit(parts, *grid, added)


def _needed(error, covariance, added):
    """The factor of `added` with which the mean of e' (P + factor added)^-1 e is d, the number of dimensions; 0 or
    more."""

    def excess(factor):
        solved = np.linalg.solve(covariance + factor * added, error[:, :, None])[:, :, 0]
        return np.mean(np.einsum("nd,nd->n", error, solved)) - error.shape[1]

    if excess(0.0) <= 0.0:
        return 0.0
    return brentq(excess, 0.0, LARGEST, rtol=1e-3) if excess(LARGEST) < 0.0 else LARGEST


def _fit(parts, step, least, planar, interpolator, frame, source, added):
    markers = _markers(parts, step, least, planar)
    bias = corrected_bias(markers)
    at = measured_places(markers, bias)
    return BiasMap(markers.cell, at, bias, markers.std, markers.count, added, step, interpolator, frame, source)


def _markers(parts, step, least, planar):
    parts = [part for part in parts if len(part)]
    if not parts:
        raise InputError(
            f"positions: none is within {LOST:g} m of the truth; is it in the same frame, by the same clock?"
        )
    d = 2 if planar else 3
    markers = collect(
        *(np.concatenate([getattr(part, name)[:, :d] for part in parts]) for name in ("measured", "true")), step, least
    )
    if len(markers) == 0:
        raise InputError(f"step: no cell of {step:g} m holds {least} positions; give a larger step, or more data.")
    return markers


def _folds(parts):
    """Lists of parts to be left out together; stretches of it, if there is only one."""
    if len(parts) > 1:
        return [parts[k::FOLDS] for k in range(min(FOLDS, len(parts)))]
    columns = [np.array_split(column, FOLDS) for column in (parts[0].measured, parts[0].true)]
    covariance = parts[0].covariance
    covariances = [None] * FOLDS if covariance is None else np.array_split(covariance, FOLDS)
    return [[Part(*stretch)] for stretch in zip(*columns, covariances)]


def _in_space(p):
    """(n, 3) of (n, 2) or (n, 3)."""
    return np.pad(p, ((0, 0), (0, 3 - p.shape[1])))
