# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""List parameters that the data do not determine, and data that would determine them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS
from uwb_tdoa_bias.effects.base import listed

from ..channels import CHANNELS
from ..regression.confounding import Unobservable
from ..result import Diagnosis

# largest contribution of a combination that cancels, relative to its parts
NOTHING = 1e-9
NAMED = 6  # largest number of named parameters of a combination
GROUND_TRUTH = "ground truth, from motion capture for example"
ATTITUDE = "ground truth of the attitude"
ORIENTATIONS = "orientations of the anchors in the survey"
AND = ", and "  # separates the sensor and the ground truth in `Channel.needs`
CANCELS = "nothing: it cancels in every measurement, and hence does no harm"


@dataclass(frozen=True)
class Undetermined:
    """An undetermined effect or combination of its parameters.

    effect : name; what : parameters, in words, "" for the whole effect
    remedy : flight, mark or sensor that would determine it, in words; CANCELS if it does no harm
    """

    effect: str
    what: str
    remedy: str


def undetermined(diagnosis: Diagnosis) -> list[Undetermined]:
    """Return one Undetermined per entry of diagnosis.unobservable."""
    return [
        Undetermined(item.effect, _what(item.direction or {}), _remedy(item, diagnosis))
        for item in diagnosis.unobservable
    ]


def by_remedy(items: Iterable[Undetermined]) -> dict[str, list[str]]:
    """Return {remedy: [effect and parameters, in words]} of items that are not harmless."""
    groups: dict[str, dict[str, list[str]]] = {}
    for item in items:
        if item.remedy != CANCELS:
            groups.setdefault(item.remedy, {}).setdefault(item.effect, []).append(item.what)
    return {remedy: [_few(*each) for each in effects.items()] for remedy, effects in groups.items()}


def _few(effect: str, whats: list[str]) -> str:
    if whats == [""]:
        return effect
    words = "; ".join(whats)
    if len(whats) > 2 or "combination" in whats[0]:
        plural = "s" if len(whats) > 1 else ""
        words = f"{len(whats)} combination{plural} of its parameters"
    return f"{effect} ({words})"


def _what(direction: dict[str, float]) -> str:
    """Return a combination of parameters in words.

    direction : {key: weight}
    """
    if len(direction) <= 1:
        return "".join(direction)
    if len(direction) > NAMED and len({abs(weight) for weight in direction.values()}) > 1:
        return f"a combination of {len(direction)} parameters"
    sides = [[key for key, weight in direction.items() if weight * sign > 0.0] for sign in (1, -1)]
    first, second = sorted(sides, key=len, reverse=True)
    together = f"{listed(first)} together" if len(first) > 1 else first[0]
    return f"{together} against {listed(second)}" if second else together


def _remedy(item: Unobservable, diagnosis: Diagnosis) -> str:
    effect = EFFECTS[item.effect]
    path_known = all(diagnosis.reference.positions_known)
    if item.direction is None:
        if effect.needs_reference and not path_known:
            return GROUND_TRUTH
        wanted = (*effect.corroborating_channels, *effect.channels)
        shown = {name for flight in diagnosis.attribution.residuals for name in flight}
        return _lacking(next((name for name in wanted if name not in shown), wanted[0]), diagnosis)
    table = diagnosis.attribution.selection.table
    columns = {(column.effect[0], column.key): column for column in table.columns}
    x = table.matrix([columns[item.effect, key] for key in item.direction])
    size, parts = np.abs(x @ list(item.direction.values())).max(), np.abs(x).max()
    if parts > 0.0 and size <= NOTHING * parts:
        return CANCELS
    if parts == 0.0 and effect.uses_attitude:
        return ORIENTATIONS if _knows_attitude(diagnosis) else ATTITUDE
    if not path_known:
        return GROUND_TRUTH
    return "a flight through other places, headings, heights and speeds"


def _knows_attitude(diagnosis: Diagnosis) -> bool:
    """Return whether the reference has attitudes in each flight."""
    truths = [flight.truth for flight in diagnosis.flights]
    return diagnosis.reference.attitude_known and all(
        truth is not None and np.isfinite(truth.q).any() for truth in truths
    )


def _lacking(channel: str, diagnosis: Diagnosis) -> str:
    """Return the missing input of a channel: its sensor, its ground truth, or both."""
    sensor, _, truth = CHANNELS[channel].needs.partition(AND)
    stream = CHANNELS[channel].stream or channel
    if truth and _knows_attitude(diagnosis) and all(diagnosis.reference.positions_known):
        return sensor
    if truth and any(getattr(flight, stream) is not None for flight in diagnosis.flights):
        return truth
    return CHANNELS[channel].needs
