# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Diagnose errors near the floor in the measured flights.

The search runs alone and with the effect floor_multipath. Then the effect fitted to one set of
flights is applied to another set.
"""

import numpy as np
from tqdm import tqdm

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_tools.diagnosis.attribution import near_floor, on_floor
from uwb_tdoa_tools.diagnosis.channels import residuals
from uwb_tdoa_tools.diagnosis.detectors import DETECTORS
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.diagnosis.refinement import effects_of
from uwb_tdoa_tools.readers import inputs

DAYS = ("0422", "0425", "0426")
HALVED = ("0425", "0426")  # with flights enough for two groups, every other one
AT_REST = 0.045  # m of z, below which the tag stands on the floor
WILD = 6.0  # m that an outlier counts as


def figures(data):
    """dict of figures of all raw flights of DAYS below the folder `data`, and of the other
    flights, where the effect is not visible.
    """
    recordings = inputs.Reading(data / "surveys")
    days = {day: _seen(recordings.flights(_files(data / "flights" / day))) for day in DAYS}
    groups = {
        f"{day} {part}": dict(list(days[day].items())[k::2])
        for day in HALVED
        for k, part in enumerate("ab")
    }
    fits = {
        name: _fitted(seen)
        for name, seen in tqdm((days | groups).items(), unit="fit", disable=None)
    }
    pairs = [(one, other) for one in DAYS for other in DAYS if one != other]
    pairs += [(f"{day} {one}", f"{day} {other}") for day in HALVED for one, other in ("ab", "ba")]
    absent = {}
    for path in tqdm(
        [*_files(data / "util"), *_files(data / "flights" / "0607")], unit="flight", disable=None
    ):
        absent |= {
            name: _words(_found({name: seen}, True))
            for name, seen in _seen(recordings.flights([path])).items()
        }
    return {
        "by the search alone": {day: _words(_found(seen, False)) for day, seen in days.items()},
        "with the effect": {
            name: {key: round(value, 3) for key, value in fit.values.items()}
            for name, fit in fits.items()
        },
        "explained at rest": {
            f"{one} on {other}": _explained(fits[one], (days | groups)[other])
            for one, other in pairs
        },
        "elsewhere": absent,
    }


def _files(folder):
    return sorted(path for path in folder.rglob("*") if path.is_file())


def _seen(flights):
    """{name: {channel: ChannelResidual near the floor}} of Flights."""
    reference = GroundTruth()
    return {
        flight.name: near_floor(residuals(reference.prepare(flight), reference, EffectSet()))
        for flight in flights
    }


def _found(seen, named):
    """Selection of effects near the floor. named : whether floor_multipath is a candidate."""
    return on_floor(list(seen.values()), [DETECTORS["floor_multipath"]] if named else [], True, [])


def _words(selection):
    return [sentence for effect in effects_of(selection) for sentence in effect.advice()[:1]]


def _fitted(seen):
    """The Effect that flights show; one without values if they show none."""
    kind = DETECTORS["floor_multipath"].effect
    return next(
        (effect for effect in effects_of(_found(seen, True)) if effect.name == kind.name), kind()
    )


def _explained(effect, seen):
    """dict of how much of the residuals an Effect explains in other flights at rest on the floor.

    It has the explained share of their power, over all flights and in the worst flight. It also has
    the medians of the residuals, m, before and after.
    """
    sides = []
    for part in (residual["tdoa"] for residual in seen.values()):
        rest = part.fitted & (part.samples.p[:, 2] < AT_REST)
        before = part.residual[rest]
        sides.append((before, before - effect.bias(part.samples)[rest]))
    powers = np.array(
        [[np.sum(np.minimum(np.abs(side), WILD) ** 2) for side in pair] for pair in sides]
    )
    before, after = (float(np.median(np.abs(np.concatenate(some)))) for some in zip(*sides))
    return {
        "share of power": round(float(1.0 - powers[:, 1].sum() / powers[:, 0].sum()), 3),
        "least of a flight": round(float(1.0 - (powers[:, 1] / powers[:, 0]).max()), 3),
        "median before": round(before, 3),
        "after": round(after, 3),
        "share of median": round(1.0 - after / before, 3),
    }
