# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find the physical effects of the training flights, as `diagnose` does."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.distance import cdist

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.effects import EFFECTS, RADIO, EffectSet

from ..diagnosis.attribution import Attribution, attribute
from ..diagnosis.comparison import Baseline
from ..diagnosis.findings import usable
from ..diagnosis.references import GroundTruth
from ..diagnosis.refinement import effects_of
from ..diagnosis.regression.fit import refit
from ..diagnosis.regression.terms import columns_of
from ..diagnosis.validation import select_by_error
from .labels import Labels, by_constellation, labels, with_level_attitude

# effects of the tag, the vehicle and the anchor modules, valid in another installation
PORTABLE = tuple(name for name, effect in EFFECTS.items() if effect.portable)


# Errors that belong to a place, of one anchor: standard deviation, m, of a short and of a long part of
# them, and over how many m of x, y and z these change. Chosen on the validation flights of
# docs/notebook/bias.md, as the standard deviation, m, of the mean error of a pair over a second.
PLACE_STD, LENGTH, LONG = 0.1, (1.0, 1.0, 0.6), 4.0
NOISE = 0.1
MOST_MEANS = 3000  # of a constellation: the time of the fit grows with the cube


@dataclass(frozen=True)
class Physics:
    """Hold the effects that were found.

    Parameters
    ----------
    effects : EffectSet
        Fitted to all flights.
    attribution : Attribution or None
        Its regression, or None to keep the values.
    labels : sequence of Labels
        Of all flights of several constellations. Errors that belong to a place are fitted to them.
    """

    effects: EffectSet
    attribution: Attribution | None = None
    labels: Sequence[Labels] = ()

    def fitted_to(self, flights: Sequence[int]) -> EffectSet:
        """Return the same effects with values fitted to the flights of these numbers.

        Effects of detectors keep their values.
        """
        if self.attribution is None:
            return self.effects
        selection = self.attribution.selection
        rows = np.isin(selection.table.flight, flights)
        model = refit(selection.table, columns_of(selection.chosen), selection.fit, rows)
        detected = (detection.effect for detection in self.attribution.detections)
        effects = usable([*effects_of(replace(selection, fit=model)), *detected])
        return beside_places(effects, [self.labels[k] for k in flights]) if self.labels else effects


def find_effects(flights: Sequence[Flight]) -> Physics:
    """Find the effects of flights with ground truth.

    Flights of one constellation can have all effects of `diagnose`. Flights of several constellations can
    have the PORTABLE ones, with values of `beside_places`. An effect stays if it improves the likelihood
    and the filter error on flights that were excluded from its fit.

    Parameters
    ----------
    flights : sequence of Flight

    Returns
    -------
    Physics
    """
    flights, reference = [with_level_attitude(flight) for flight in flights], GroundTruth()
    several = len(by_constellation(flights)) > 1
    kinds = PORTABLE if several else None
    attribution = attribute(flights, reference, kinds=kinds, undeclared=False)
    model = select_by_error(attribution, flights, Baseline(EffectSet())).applied(attribution)
    effects = usable(model.effects)
    if not several:
        return Physics(effects, model)
    known = [labels(flight) for flight in flights]
    return Physics(beside_places(effects, known), model, known)


def beside_places(effects: EffectSet, known: Sequence[Labels]) -> EffectSet:
    """Return effects with values fitted together with errors that belong to places.

    Such an error of an anchor is a smooth function of the position of the tag, a Gaussian process. It is
    marginalized. Otherwise the effects absorb it, and do harm in another constellation. Effects that do
    not change a TDOA linearly keep their values.
    """
    fitted = [
        effect
        for effect in effects
        if effect.fitted
        and effect.values
        and "tdoa" in effect.channels
        and set(effect.channels) <= RADIO.keys()
    ]
    if not fitted:
        return effects
    others = effects.where(lambda effect: effect not in fitted)
    prior = [effect.prior_std_of(key) for effect in fitted for key in effect.values]
    gram, vector = np.diag(np.array(prior) ** -2.0), np.zeros(len(prior))
    for group in by_constellation(known):
        parts = []
        for one in group:
            slopes = [type(effect)().regressors(one.samples, [*effect.values]) for effect in fitted]
            left = one.error - others.bias(one.samples)
            table = np.column_stack([*slopes, left, one.samples.p])
            parts.append(_over_seconds(one, group[0].anchors, table))
        ends, means = (np.concatenate(columns) for columns in zip(*parts))
        some = np.random.default_rng(0).permutation(len(ends))[:MOST_MEANS]
        covariance = _of_places(ends[some], means[some, -3:])
        x, y = means[some, :-4], means[some, -4]
        solved = cho_solve(cho_factor(covariance), np.column_stack([x, y]))
        gram += x.T @ solved[:, :-1]
        vector += x.T @ solved[:, -1]
    posterior = np.linalg.inv(gram)
    values, std = iter((posterior @ vector).tolist()), iter(np.sqrt(np.diag(posterior)).tolist())
    beside = [
        type(effect)(
            {key: next(values) for key in effect.values},
            {key: next(std) for key in effect.values},
            "train",
        )
        for effect in fitted
    ]
    return EffectSet((*beside, *others))


def _over_seconds(
    one: Labels, anchors: Anchors, table: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return ends (m, N) of the pairs, and means (m, c) of a table (n, c), for each pair and second.

    The ends are 1 for anchor b, -1 for anchor a, and 0 for the other ones of `anchors`.
    """
    row = anchors.index(one.anchors.ids)
    second = np.floor(one.samples.t - one.samples.start).astype(int)
    key = np.column_stack([second, row[one.samples.a], row[one.samples.b]])
    kinds, of, count = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    sums = [np.bincount(of.ravel(), column) for column in table.T]
    each = np.eye(len(anchors))
    return each[kinds[:, 2]] - each[kinds[:, 1]], np.stack(sums, axis=1) / count[:, None]


def _of_places(ends: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Return the covariance (m, m), m^2, of errors of pairs with `ends` (m, N) at positions p (m, 3), m."""
    far = cdist(p / LENGTH, p / LENGTH)
    of_one = PLACE_STD**2 * (np.exp(-far) + np.exp(-far / LONG))
    return (ends @ ends.T) * of_one + NOISE**2 * np.eye(len(p))
