# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Say in words of the field why the estimate is off, and where errors remain."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects.base import listed, measured
from uwb_tdoa_bias.effects.smooth_term import causes, described

from ..channels.figures import rows_by_value
from ..findings import prefixes_of
from ..regression.table import BLOCK
from .entries import CM, LEAST_WORTH, WORTH_DOING, entries, for_people

if TYPE_CHECKING:
    from collections.abc import Iterator

    from uwb_tdoa_bias.effects import SmoothTerm

    from ..channels import ChannelResidual
    from ..result import Diagnosis
    from .entries import Entry

NAMED = 3  # largest number of named reasons, and of named places
MOST = 0.5  # share of the gain from which an effect is most of it
POINTS = 60  # at which a function is evaluated
# smallest RMS residual of a named pair over BLOCK s: m, and relative to the RMS of all rows
LARGE, ABOVE = (0.15, 3.0)
FEWEST = 3  # fewest rows of such a pair


def reasons(diagnosis: Diagnosis) -> list[str]:
    """Return sentences on what makes the error, the largest worth first; [] if nothing is known.

    An effect without a name is described by its largest part, with its most likely causes.
    """
    before, after = (side["pooled"]["rmse_3d"] for side in (diagnosis.before, diagnosis.after))
    out: list[str] = []
    for entry in entries(diagnosis):
        worth = entry.worth or 0.0
        if entry.added and worth >= (WORTH_DOING if out else LEAST_WORTH):
            out.append(_sentence(entry, len(out), before - after))
    return out[:NAMED]


def _sentence(entry: Entry, place: int, gain: float) -> str:
    worth = entry.worth or 0.0
    begin = "Then" if place else "Mostly" if worth >= MOST * gain else "In part"
    much = f"{CM * worth:.1f} cm"
    if not place and worth <= gain:
        much = f"{CM * worth:.1f} of {CM * gain:.1f} cm"
    sentence = f"{begin} {cause(entry)}, worth {much}."
    if entry.findings[0].declared:
        return sentence
    others = [other.effect for other in entry.undecided[:1]]
    return f"{sentence} Likely causes: {listed([causes(_largest(entry)[0])[0], *others], 'or')}."


def cause(entry: Entry) -> str:
    """Return what is wrong, as a clause: for a function without a name its largest part."""
    if not entry.findings[0].declared:
        said = described(*_largest(entry))
        terms = _functions(entry)
        if sum(len(prefixes_of(term)) for term in terms) == 1:
            return said
        covariates = listed(dict.fromkeys(term.covariate.replace("_", " ") for term in terms))
        return f"errors that depend on {covariates}, anchor by anchor; at most {said}"
    effect = entry.findings[0].effect
    significant = effect.significant() or effect.values
    key = max(significant, key=lambda name: abs(significant[name]))
    unit, factor = for_people(effect.unit, key)
    std = effect.std.get(key)
    largest = measured(factor * effect.values[key], std and factor * std, unit)
    most = "largest " if len(effect.values) > 1 else ""
    return f"{effect.physics.partition(':')[0]} ({effect.name}; {most}{key} = {largest})"


def _functions(entry: Entry) -> list[SmoothTerm]:
    return [finding.function for finding in entry.findings if finding.function]


def _largest(entry: Entry) -> tuple[SmoothTerm, str]:
    """Return the function with the largest swing, and its anchor or pair."""
    parts = []
    for term in _functions(entry):
        at = np.linspace(term.knots[0], term.knots[-1], POINTS)
        for prefix in prefixes_of(term):
            parts.append((np.ptp(term.curve(at, prefix)), term, prefix.rstrip(".")))
    _, term, part = max(parts, key=lambda each: each[0])
    return term, part


def left_over(diagnosis: Diagnosis) -> tuple[str, ...]:
    """Return sentences on the pairs, times and places of the largest remaining residuals.

    It is () if none stands out.
    """
    found: list[tuple[float, str]] = []
    for flight, residuals in zip(diagnosis.flights, diagnosis.remaining):
        of = f" of {flight.name}" if len(diagnosis.flights) > 1 else ""
        for part in residuals.values():
            found += _left_over(part, of)
    places = [f"{said} ({CM * size:.0f} cm)" for size, said in sorted(found, reverse=True)[:NAMED]]
    return (f"What is left is largest for {'; '.join(places)}.",) if places else ()


def _left_over(part: ChannelResidual, of: str) -> Iterator[tuple[float, str]]:
    """Yield (RMS residual m, pair, time and place, in words)."""
    rows = part.rows()
    block = (rows.t / BLOCK).astype(int)
    # the median of squares is 0.455 of their mean, for Gaussian noise
    usual = np.sqrt(np.median(rows.y**2) / 0.455)
    count = int(block.max()) + 1
    for label, mine in rows_by_value(rows.series * count + block):
        series, number = divmod(label, count)
        size = float(np.sqrt(np.mean(rows.y[mine] ** 2)))
        name = part.place_in_room(series)
        if name and len(mine) >= FEWEST and size > max(LARGE, ABOVE * usual):
            x, y, z = rows.place[mine].mean(axis=0)
            when = f"{number * BLOCK:.0f} to {(number + 1) * BLOCK:.0f} s"
            yield size, f"{name} from {when}{of}, around ({x:.1f}, {y:.1f}, {z:.1f}) m"
