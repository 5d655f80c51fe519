# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find the physical effects of the training flights, as `diagnose` does."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.effects import EFFECTS, RADIO, EffectSet, Samples

from ..diagnosis.attribution import Attribution, attribute
from ..diagnosis.comparison import Baseline
from ..diagnosis.findings import usable
from ..diagnosis.references import GroundTruth
from ..diagnosis.refinement import effects_of
from ..diagnosis.regression.fit import refit
from ..diagnosis.regression.terms import columns_of
from ..diagnosis.validation import select_by_error
from .labels import constellations, with_level_attitude

# effects of the tag, the vehicle and the anchor modules, valid in another installation
PORTABLE = tuple(name for name, effect in EFFECTS.items() if effect.portable)


@dataclass(frozen=True)
class Physics:
    """Hold the effects that were found.

    Parameters
    ----------
    effects : EffectSet
        Fitted to all flights.
    attribution : Attribution or None
        Its regression, or None to keep the values.
    """

    effects: EffectSet
    attribution: Attribution | None = None

    def fitted_to(self, flights: Iterable[int]) -> EffectSet:
        """Return the same effects with values fitted to the flights of these numbers.

        Effects of detectors keep their values.
        """
        if self.attribution is None:
            return self.effects
        selection = self.attribution.selection
        rows = np.isin(selection.table.flight, list(flights))
        model = refit(selection.table, columns_of(selection.chosen), selection.fit, rows)
        detected = (detection.effect for detection in self.attribution.detections)
        return usable([*effects_of(replace(selection, fit=model)), *detected])


def split_linear(effects: EffectSet) -> tuple[EffectSet, EffectSet]:
    """Return (effects whose parameters change a TDOA linearly, other effects)."""
    linear = [
        bool(
            effect.fitted
            and "tdoa" in effect.channels
            and set(effect.channels) <= RADIO.keys()
            and effect.values
        )
        for effect in effects.effects
    ]
    linear_ones, others = (
        tuple(e for e, one in zip(effects.effects, linear) if one is kind) for kind in (True, False)
    )
    return EffectSet(linear_ones), EffectSet(others)


def regressors(effects: EffectSet, samples: Samples) -> np.ndarray:
    """Return the derivatives (n, k) of the errors by all parameters of linear effects, at zero."""
    parts = [type(effect)().regressors(samples, list(effect.values)) for effect in effects.effects]
    return np.concatenate([np.zeros((len(samples), 0)), *parts], axis=1)


def prior_stds(effects: EffectSet) -> np.ndarray:
    """Return the standard deviations (k,) of the priors of all parameters, each in its unit."""
    return np.array(
        [effect.prior_std_of(key) for effect in effects.effects for key in effect.values]
    )


def with_values(effects: EffectSet, values: np.ndarray, covariance: np.ndarray) -> EffectSet:
    """Return the effects with new values (k,) of all parameters, and their covariance (k, k)."""
    std, out, first = np.sqrt(np.diag(covariance)), [], 0
    for effect in effects.effects:
        rows = slice(first, first + len(effect.values))
        fitted, errors = (
            dict(zip(effect.values, numbers[rows].tolist())) for numbers in (values, std)
        )
        out.append(type(effect)(fitted, errors, "train"))
        first = rows.stop
    return EffectSet(tuple(out))


def find_effects(flights: Sequence[Flight]) -> Physics:
    """Find the effects of flights with ground truth.

    Flights of one constellation can have all effects of `diagnose`. Flights of several constellations can
    have the PORTABLE ones. An effect stays if it improves the likelihood and the filter error on flights
    that were excluded from its fit.

    Parameters
    ----------
    flights : sequence of Flight

    Returns
    -------
    Physics
    """
    flights, reference = [with_level_attitude(flight) for flight in flights], GroundTruth()
    kinds = PORTABLE if len(constellations(flights)) > 1 else None
    attribution = attribute(flights, reference, kinds=kinds, undeclared=False)
    validated = select_by_error(attribution, flights, Baseline(EffectSet()))
    model = validated.applied(attribution)
    return Physics(usable(model.effects), model)
