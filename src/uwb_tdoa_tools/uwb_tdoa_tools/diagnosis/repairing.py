# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Correct wrong ids and signs before the fit, and validate them like any other effect."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace

import numpy as np

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.effects import Effect, EffectSet, LabelEffect
from uwb_tdoa_ekf.core.config import FilterConfig

from ..checking.pair_rules import KnownPath, repairs
from .attribution import Attribution, residuals_of
from .comparison import Baseline, ValidationCase, score
from .detectors import Detection, switching
from .references import Reference
from .refinement import effects_of
from .regression.fit import fit
from .regression.select import Selection, select
from .regression.table import table_of
from .regression.terms import Candidate, columns_of
from .validation import TRIAL_FLIGHTS, WORSE, ValidatedSelection


def repaired(
    flights: Sequence[Flight],
    base: EffectSet,
    config: FilterConfig | None = None,
    progress: Callable[[], object] = lambda: None,
) -> dict[Detection, float]:
    """Return the LabelEffects that all Flights need beyond `base`, and that improve the filter.

    The result is {Detection: increase of the mean 3D RMSE without it, m, given the earlier ones}.
    """
    out, effects, error = {}, base.effects, None
    for effect in _common([repairs(base.correct_streams(flight)) for flight in flights]):
        error = _error(flights, effects, config, progress) if error is None else error
        less = _error(flights, (*effects, effect), config, progress)
        if less < error * (1.0 - WORSE):
            out[Detection(effect, effect.channels[0], _evidence(flights[0], effects, effect))] = (
                error - less
            )
            effects, error = (*effects, effect), less
    return out


def sound(
    flights: Sequence[Flight], base: EffectSet, found: Iterable[Detection]
) -> tuple[tuple[Flight, ...], EffectSet]:
    """Return (Flights with correct ids and signs, EffectSet of the other effects of `base`).

    Corrections by `base` and the Detections are applied to the flights, so pairs and anchors have
    correct names.
    """
    labels = [effect for effect in base.effects if isinstance(effect, LabelEffect)]
    undo = EffectSet((*labels, *(detection.effect for detection in found)))
    rest = tuple(effect for effect in base.effects if not isinstance(effect, LabelEffect))
    corrected = tuple(map(undo.correct_streams, flights)) if len(undo) else tuple(flights)
    return corrected, replace(base, effects=rest)


def without_switching(
    flights: Sequence[Flight],
    reference: Reference,
    base: EffectSet,
    config: FilterConfig | None = None,
    progress: Callable[[], object] = lambda: None,
) -> tuple[tuple[Flight, ...], tuple[tuple[str, Selection], ...]]:
    """Return Flights without what switches, and ((name of a flight, Selection of it), ...).

    An anchor switches between two levels at times of each flight, or in pulses. Other flights do
    not have it, but it hides what they have. It is taken out if that improves the
    filter in this flight.
    """
    out, found = list(flights), []
    tables = [table_of([one]) for one in residuals_of(flights, reference, base, progress)]
    # sparse: with many anchors
    some = [k for k, table in enumerate(tables) if table.tdoa_parts and not table.sparse]
    several = switching([part for k in some for part in tables[k].tdoa_parts])
    for k, switch in zip(some, several):
        if not switch:
            continue
        table, less = tables[k].with_terms([one.terms[0] for one in switch]), flights[k]
        inflation = fit(table, columns_of(switch), covariance=False).inflation
        selection = select(table, [], inflation, start=switch)
        for effect in effects_of(selection):
            # The level, c0, is a delay, which other flights have too.
            values = {key: -v for key, v in effect.values.items() if not key.endswith("c0")}
            less = replace(effect, values=values).inject(less)
        errors = [_error([one], base.effects, config, progress) for one in (flights[k], less)]
        if errors[1] < errors[0] * (1.0 - WORSE):
            found.append((less.name, selection))
            out[k] = less
    return tuple(out), tuple(found)


def before_others(
    attribution: Attribution, validated: ValidatedSelection, found: dict[Detection, float]
) -> tuple[Attribution, ValidatedSelection]:
    """Return the Attribution and ValidatedSelection with Detections of `repaired` first."""
    worth: dict[Candidate | Detection, float] = dict(found.items())
    return (
        replace(attribution, detections=(*found, *attribution.detections)),
        replace(
            validated, detections=(*found, *validated.detections), worth=worth | validated.worth
        ),
    )


def _common(several: Sequence[Sequence[LabelEffect]]) -> list[LabelEffect]:
    """Return Effects with the values on which all flights agree; other values are dropped."""
    out = []
    for effect in several[0]:
        same = [
            next((other for other in others if other.name == effect.name), None)
            for others in several
        ]
        known = [other for other in same if other is not None]
        if len(known) < len(same):
            continue
        keys = [
            key
            for key, value in effect.values.items()
            if all(one.values.get(key) == value for one in known)
        ]
        shared = {key: effect.values[key] for key in keys}
        if shared and (effect.separable or all(other.values == effect.values for other in known)):
            out.append(replace(effect, values=shared, source="diagnose"))
    return out


def _error(
    flights: Sequence[Flight],
    effects: Iterable[Effect],
    config: FilterConfig | None,
    progress: Callable[[], object],
) -> float:
    """Return the mean 3D RMSE, m, of at most TRIAL_FLIGHTS flights."""
    model, errors = Baseline(EffectSet(tuple(effects)), config), []
    for flight in flights[:: -(-len(flights) // TRIAL_FLIGHTS)]:
        case = ValidationCase(flight, model.base)
        errors.append(score(case, model.run(flight)).rmse_3d)
        progress()
    return float(np.mean(errors))


def _evidence(flight: Flight, effects: Iterable[Effect], effect: LabelEffect) -> dict[str, float]:
    """Return the median error, m, of TDOAs that the effect changes, with it and without it.

    The errors are relative to the ground truth.
    """
    one = KnownPath(EffectSet(tuple(effects)).correct_streams(flight))
    other = one.without(effect)
    with_it, without = one.d - one.true, other.d - other.true
    changed = with_it != without
    medians = (round(float(np.median(np.abs(each[changed]))), 3) for each in (with_it, without))
    return dict(zip(("median_error", "median_error_without"), medians))
