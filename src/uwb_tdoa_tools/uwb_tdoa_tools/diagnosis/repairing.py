"""Wrong ids and signs, which come before physics: undone, and judged like any other effect."""

from dataclasses import replace

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.effects import EffectSet, LabelEffect
from uwb_tdoa_ekf.offline import run_offline

from ..checking.known_path import KnownPath
from ..checking.repairs import repairs
from .detectors import Detection
from .judging import JUDGES, WORSE, Case, score


def repaired(flights, base, config=None, progress=lambda: None):
    """{Detection: m by which the mean 3D RMSE of the filter is larger without it, and those before it} of the LabelEffects that all
    Flights need beyond the EffectSet `base`, and that make the filter better."""
    out, effects, error = {}, base.effects, None
    for effect in _common([repairs(base.correct_streams(flight)) for flight in flights]):
        error = _error(flights, effects, config, progress) if error is None else error
        less = _error(flights, (*effects, effect), config, progress)
        if less < error * (1.0 - WORSE):
            out[Detection(effect, effect.channels[0], _evidence(flights[0], effects, effect))] = error - less
            effects, error = (*effects, effect), less
    return out


def sound(flights, base, found):
    """(Flights without wrong ids and signs, EffectSet of the rest): what `base` and Detections have of these is taken out of the
    flights, so that pairs and anchors are called by their names."""
    labels = [effect for effect in base.effects if isinstance(effect, LabelEffect)]
    undo = EffectSet((*labels, *(detection.effect for detection in found)))
    rest = tuple(effect for effect in base.effects if not isinstance(effect, LabelEffect))
    return tuple(map(undo.correct_streams, flights)), replace(base, effects=rest)


def before_others(attribution, kept, found):
    """(Attribution, Kept) with Detections and what they are worth, as of `repaired`."""
    attribution = replace(attribution, detections=(*found, *attribution.detections))
    return attribution, replace(kept, detections=(*found, *kept.detections), worth={**found, **kept.worth})


def _common(several):
    """Effects with the values that those of every flight have; ids that are not the same in all are left."""
    out = []
    for effect in several[0]:
        same = [next((other for other in others if other.name == effect.name), None) for others in several]
        if None in same:
            continue
        shared = {key: value for key, value in effect.values.items() if all(other.values.get(key) == value for other in same)}
        if shared and (effect.separable or all(other.values == effect.values for other in same)):
            out.append(replace(effect, values=shared, source="diagnose"))
    return out


def _error(flights, effects, config, progress):
    """Mean 3D RMSE, m, of some of the flights."""
    errors = []
    for flight in flights[:: -(-len(flights) // JUDGES)]:
        case = Case(flight, EffectSet(tuple(effects)))
        errors.append(score(case, run_offline(flight, config, Corrector(flight.anchors, case.effects))).row()["rmse_3d"])
        progress()
    return float(np.mean(errors))


def _evidence(flight, effects, effect):
    """Median error, m, at the true place of the TDOAs that the effect changes, with it and without."""
    one = KnownPath(EffectSet(tuple(effects)).correct_streams(flight))
    other = one.without(effect)
    with_it, without = one.d - one.true, other.d - other.true
    changed = with_it != without
    medians = (round(float(np.median(np.abs(each[changed]))), 3) for each in (with_it, without))
    return dict(zip(("median_error", "median_error_without"), medians))
