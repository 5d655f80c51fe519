# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Say in words of the field why the estimate is off."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects.base import listed, measured
from uwb_tdoa_bias.effects.smooth_term import causes, described

from .entries import CM, LEAST_WORTH, WORTH_DOING, entries, for_people

if TYPE_CHECKING:
    from uwb_tdoa_bias.effects import SmoothTerm

    from ..result import Diagnosis
    from .entries import Entry

NAMED = 3  # largest number of named reasons
MOST = 0.5  # share of the gain from which an effect is most of it
POINTS = 60  # at which a function is evaluated


def reasons(diagnosis: Diagnosis) -> list[str]:
    """Return sentences on what makes the error, the largest worth first; [] if nothing is known.

    An effect without a name is described by its largest part, with its most likely causes.
    """
    found = [
        entry
        for entry in entries(diagnosis)
        if entry.added and entry.worth is not None and entry.worth >= LEAST_WORTH
    ]
    worth = [entry.worth or 0.0 for entry in found]
    before, after = (side["pooled"]["rmse_3d"] for side in (diagnosis.before, diagnosis.after))
    return [
        _sentence(entry, k, before - after)
        for k, entry in enumerate(found[:NAMED])
        if k == 0 or worth[k] >= WORTH_DOING
    ]


def _sentence(entry: Entry, place: int, gain: float) -> str:
    worth = entry.worth or 0.0
    begin = "Then" if place else "Mostly" if worth >= MOST * gain else "In part"
    much = f"{CM * worth:.1f} cm"
    if not place and worth <= gain:
        much = f"{CM * worth:.1f} of {CM * gain:.1f} cm"
    return f"{begin} {cause(entry)}, worth {much}.{likely(entry)}"


def cause(entry: Entry) -> str:
    """Return what is wrong, as a clause: for a function without a name its largest part."""
    if not entry.findings[0].declared:
        parts = _parts(entry)
        _, term, part = max(parts, key=lambda each: each[0])
        several = f"errors that depend on {_covariates(entry)}, anchor by anchor; at most "
        return f"{several if len(parts) > 1 else ''}{described(term, part)}"
    effect = entry.findings[0].effect
    significant = effect.significant() or effect.values
    key = max(significant, key=lambda name: abs(significant[name]))
    unit, factor = for_people(effect.unit, key)
    std = effect.std.get(key)
    largest = measured(factor * effect.values[key], std and factor * std, unit)
    most = "largest " if len(effect.values) > 1 else ""
    return f"{effect.physics.partition(':')[0]} ({effect.name}; {most}{key} = {largest})"


def _covariates(entry: Entry) -> str:
    """Return what the functions of an Entry depend on."""
    functions = [finding.function for finding in entry.findings if finding.function]
    return listed(dict.fromkeys(one.covariate.replace("_", " ") for one in functions))


def likely(entry: Entry) -> str:
    """Return a sentence on the likely causes of a function without a name; "" for other effects."""
    if entry.findings[0].declared:
        return ""
    _, term, _ = max(_parts(entry), key=lambda each: each[0])
    others = [other.effect for other in entry.undecided[:1]]
    return f" Likely causes: {listed([causes(term)[0], *others], 'or')}."


def _parts(entry: Entry) -> list[tuple[float, SmoothTerm, str]]:
    """Return (swing, function, anchor or pair) of each function of an Entry."""
    out = []
    for term in (finding.function for finding in entry.findings):
        if term is None:
            continue
        at = np.linspace(term.knots[0], term.knots[-1], POINTS)
        for prefix in sorted({key.rpartition("c")[0] for key in term.values}):
            out.append((float(np.ptp(term.curve(at, prefix))), term, prefix.rstrip(".")))
    return out
