"""Physical effects: what `diagnose` finds among the declared ones in the flights to train on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS, RADIO, EffectSet

from ..diagnosis.attribution import Attribution, attribute
from ..diagnosis.comparison import Baseline
from ..diagnosis.findings import usable
from ..diagnosis.references import GroundTruth
from ..diagnosis.refinement import effects_of
from ..diagnosis.regression.fit import refit
from ..diagnosis.regression.terms import columns_of
from ..diagnosis.validation import select_by_error
from .labels import constellations, with_level_attitude

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence

    from uwb_tdoa_bias.effects import Samples
    from uwb_tdoa_bias.foundation.flight import Flight

# What goes with the tag, the vehicle and the modules of the anchors to another installation.
PORTABLE = tuple(name for name, effect in EFFECTS.items() if effect.portable)


@dataclass(frozen=True)
class Physics:
    """effects : EffectSet, fitted to all flights; attribution : where they come from, None where
    their values are to stay.
    """

    effects: EffectSet
    attribution: Attribution | None = None

    def fitted_to(self, flights: Iterable[int]) -> EffectSet:
        """EffectSet of the same effects, fitted to the flights with these numbers alone; what
        detectors found stays as it is.
        """
        if self.attribution is None:
            return self.effects
        selection = self.attribution.selection
        rows = np.isin(selection.table.flight, list(flights))
        model = refit(selection.table, columns_of(selection.chosen), selection.fit, rows)
        detected = (detection.effect for detection in self.attribution.detections)
        return usable([*effects_of(replace(selection, fit=model)), *detected])


def split_linear(effects: EffectSet) -> tuple[EffectSet, EffectSet]:
    """(EffectSet of those with parameters in which the error of a TDOA is linear, EffectSet of the
    others).
    """
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
    """Derivatives of the error of Samples by all parameters of linear effects, at zero: (n, k)."""
    parts = [type(effect)().regressors(samples, list(effect.values)) for effect in effects.effects]
    return np.concatenate([np.zeros((len(samples), 0)), *parts], axis=1)


def prior_stds(effects: EffectSet) -> np.ndarray:
    """Plausible sizes of all parameters, (k,), each in its unit: standard deviations of their
    priors.
    """
    return np.array(
        [effect.prior_std_of(key) for effect in effects.effects for key in effect.values]
    )


def with_values(effects: EffectSet, values: np.ndarray, covariance: np.ndarray) -> EffectSet:
    """The same effects with values (k,) of all parameters in turn, and their covariance (k, k)."""
    std, out, first = np.sqrt(np.diag(covariance)), [], 0
    for effect in effects.effects:
        rows = slice(first, first + len(effect.values))
        fitted, errors = (
            dict(zip(effect.values, numbers[rows].tolist())) for numbers in (values, std)
        )
        out.append(type(effect)(fitted, errors, "train"))
        first = rows.stop
    return EffectSet(tuple(out))


def find_effects(
    flights: Sequence[Flight], progress: Callable[[], object] = lambda: None
) -> Physics:
    """Physics of Flights with ground truth. progress() is called now and then.

    Of flights in one constellation, all that `diagnose` can name; of several, what goes from one to
    the other (PORTABLE). An effect stays if it helps the likelihood of flights that it was not
    fitted to, and the filter's error on them.
    """
    flights, reference = [with_level_attitude(flight) for flight in flights], GroundTruth()
    kinds = PORTABLE if len(constellations(flights)) > 1 else None
    attribution = attribute(flights, reference, kinds=kinds, undeclared=False, progress=progress)
    validated = select_by_error(attribution, flights, Baseline(EffectSet()), progress)
    model = validated.applied(attribution)
    return Physics(usable(model.effects), model)
