# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Group findings for a reader: candidates of one selection step form one entry."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from uwb_tdoa_bias.effects import LabelEffect
from uwb_tdoa_bias.effects.base import listed, measured

from ..findings import EffectFinding, Refused
from ..over_flights import ALL, course, in_words
from ..regression.confounding import Alternative
from ..result import Diagnosis
from ..validation import LEAST_WORTH

CM = 100.0  # cm per metre
WORTH_DOING = 0.005  # m, smallest gain in position that is worth an action
DEGREES = float(np.degrees(1.0))  # degrees per radian
FORMS = {"arrival": " (of each arrival)", "anchor": " (by anchor)"}
SHOWN = 6  # largest number of shown values
NAMED = 3  # largest number of entries that are named as alike
LONGEST = 8.0  # em, longest bar


@dataclass(frozen=True)
class Entry:
    """Findings that entered the model together.

    title : of all findings; values : significant values, in words
    why_not : reason for not being in the model, "" if added
    """

    findings: tuple[EffectFinding, ...]
    title: str
    values: str
    why_not: str

    @property
    def added(self) -> bool:
        """Return whether the written model contains it."""
        return self.findings[0].added

    @property
    def worth(self) -> float | None:
        """Return the increase of the 3D RMSE without it, m; None if not tried."""
        return self.findings[0].worth

    @property
    def advice(self) -> tuple[str, ...]:
        """Return sentences with advice."""
        return tuple(sentence for finding in self.findings for sentence in finding.effect.advice())

    @property
    def matters(self) -> bool:
        """Return whether a user should act: for a fault, or if the position gains.

        An unknown gain counts as a gain.
        """
        # a fault is corrected whatever its worth
        fault = any(isinstance(finding.effect, LabelEffect) for finding in self.findings)
        return self.added and (fault or self.worth is None or self.worth >= WORTH_DOING)

    @property
    def physics(self) -> str:
        """Return the physical cause, in words."""
        first = self.findings[0]
        if first.declared:
            return first.effect.physics
        return "structure that no effect of the catalogue explains"

    @property
    def causes(self) -> tuple[str, ...]:
        """Return the sentences of its advice that other functions without a name may share."""
        nameless = [finding.effect for finding in self.findings if not finding.declared]
        said = (sentence for effect in nameless for sentence in effect.advice()[1:])
        return tuple(dict.fromkeys(said))

    @property
    def alike(self) -> bool:
        """Return whether all flights show the same of it."""
        return course(self.findings[0].shares) == ALL

    @property
    def differing(self) -> str:
        """Return in a few words how flights differ; "" if they do not, or are one."""
        return "" if self.alike else in_words(self.findings[0].shares)

    @property
    def alternatives(self) -> list[Alternative]:
        """Return the alternatives of all findings."""
        several = [other for finding in self.findings for other in finding.alternatives]
        return list({other.effect: other for other in several}.values())

    @property
    def undecided(self) -> list[Alternative]:
        """Return the alternatives that fit nearly equally well, the nearest first."""
        gaps = [(other.gap, other) for other in self.alternatives if other.gap is not None]
        return [other for _, other in sorted(gaps, key=lambda pair: pair[0])]


def entries(diagnosis: Diagnosis) -> list[Entry]:
    """Return the entries of a Diagnosis: added ones by their worth, then the others.

    Without a known worth the most prominent comes first.
    """
    groups: dict[Hashable, list[EffectFinding]] = {}
    for finding in diagnosis.findings:
        key = finding.key if finding.declared or not finding.candidates else finding.candidates[0]
        groups.setdefault(key, []).append(finding)
    out = [
        Entry(
            tuple(group),
            _title(group),
            _values(group[0]),
            _why_not(group[0], diagnosis.refused),
        )
        for group in groups.values()
    ]

    def place(entry: Entry) -> tuple[bool, float, float]:
        worth = entry.worth or 0.0
        return not entry.added, -worth if entry.added else 0.0, -entry.findings[0].prominence

    return sorted(out, key=place)


def worth_in_words(entry: Entry) -> str:
    """Return the worth in words, such as "1.5 cm"."""
    if entry.worth is None:
        return "not told by errors in the air" if entry.findings[0].on_floor else "not known"
    if abs(entry.worth) < LEAST_WORTH:
        return "less than 0.1 cm"
    words = f"{entry.worth * CM:.1f} cm"
    return words if entry.worth > 0.0 else f"nothing ({words})"


def doubt_in_words(entry: Entry) -> list[str]:
    """Return sentences on all alternatives, and flights that would decide."""
    imitators = [other for other in entry.alternatives if other.gap is None]
    return [
        *_doubts("Could as well be {}; to tell: {}.", entry.undecided),
        *_doubts("Could be imitated by {}, less plausibly; to tell: {}.", imitators),
    ]


def _doubts(sentence: str, alternatives: Iterable[Alternative]) -> list[str]:
    """Return one sentence per flight that would decide between alternatives."""
    groups: dict[str, list[str]] = {}
    for other in alternatives:
        groups.setdefault(other.tell_apart, []).append(other.effect)
    return [sentence.format(listed(names, "or"), flight) for flight, names in groups.items()]


def agreement(found: Sequence[Entry]) -> str:
    """Return which entries all flights show alike, as a sentence; "" for none."""
    alike = [entry.title for entry in found if entry.alike]
    if not alike:
        return ""
    if len(alike) == len(found) > 1:
        return "All of it is the same in all flights."
    several = listed(alike) if len(alike) <= NAMED else f"{len(alike)} of {len(found)} findings"
    return f"The same in all flights: {several}."


def doubts(found: Iterable[Entry]) -> dict[str, list[str]]:
    """Return {title: what else an entry could be}; a repeated doubt refers to the first entry.

    Nothing stands for an entry that was compared with the catalogue, and that nothing else explains.
    """
    out: dict[str, list[str]] = {}
    first: dict[str, str] = {}
    for entry in found:
        sentences = doubt_in_words(entry)
        if not sentences and not entry.findings[0].candidates:
            like = entry.findings[0].effect.confounded_with
            sentences = [f"not compared; like {listed(like, 'or')}" if like else "not compared"]
        told = [f"as {first[one]}" if one in first else one for one in sentences]
        out[entry.title] = list(dict.fromkeys(told))
        for sentence in sentences:
            first.setdefault(sentence, entry.title)
    return out


def known_with(entry: Entry) -> list[str]:
    """Return sentences that qualify its advice: worth and doubt."""
    together = ", together" if len(entry.advice) > 1 + len(entry.causes) else ""
    out = []
    if entry.worth is not None:
        out.append(f"Worth {worth_in_words(entry)} of position{together}.")
    doubt = " ".join(_doubts("could as well be {}; to tell: {}.", entry.undecided))
    if doubt:
        out.append(f"Make sure first: this {doubt}")
    return out


def bar(entry: Entry, found: Iterable[Entry]) -> float:
    """Return the length of the bar of its worth, em; 0 for none.

    The largest worth of the added entries has length LONGEST.
    """
    largest = max((other.worth or 0.0 for other in found if other.added), default=0.0)
    if not entry.worth or entry.worth < LEAST_WORTH or largest <= 0.0:
        return 0.0
    return LONGEST * entry.worth / largest


def for_people(unit: str) -> tuple[str, float]:
    """Return (unit, factor) that show a value of an effect: angles in degrees."""
    if unit in ("rad", "rad/s"):
        return unit.replace("rad", "degrees"), DEGREES
    return "" if unit == "1" else unit, 1.0


def _title(findings: Sequence[EffectFinding]) -> str:
    function = findings[0].function
    if function is None:
        return findings[0].effect.name
    subject, _, first = function.label.rpartition(" over ")
    others = (finding.function.covariate for finding in findings[1:] if finding.function)
    covariates = listed(name.replace("_", " ") for name in (first, *others))
    several = subject == function.channel
    return f"{subject} over {covariates}{FORMS.get(function.form, '') if several else ''}"


def _values(finding: EffectFinding) -> str:
    effect = finding.effect
    if finding.function:
        return f"a function without a name ({finding.function.shape})"
    significant = effect.significant() if effect.significant_sizes() else {}
    vague = len(effect.values) - len(significant)
    if not significant and vague > SHOWN:
        means = f", {effect.if_undetermined}" if effect.if_undetermined else ""
        return f"{vague} values, none twice its standard deviation: a fitted correction{means}"
    shown = []
    units = {for_people(effect.unit_of(key))[0] for key in effect.values}
    one_unit = units.pop() if len(units) == 1 else ""
    for key, value in sorted(effect.values.items(), key=lambda item: not effect.std.get(item[0])):
        if key in (significant or effect.values):  # without significant values, all are named
            unit, factor = for_people(effect.unit_of(key))
            std = factor * (effect.std.get(key) or 0.0)
            shown.append(f"{key} = {measured(factor * value, std, '' if one_unit else unit)}")
    if len(shown) > SHOWN:
        shown[SHOWN:] = [f"{len(shown) - SHOWN} more"]
    words = ", ".join(shown) + (f" ({one_unit})" if one_unit else "")
    if not significant:
        means = f": {effect.if_undetermined}" if effect.if_undetermined else ""
        return f"{words}; not twice the standard deviation{means}"
    return f"{words}; {vague} not significant" if vague else words


def _why_not(finding: EffectFinding, refused: Sequence[Refused]) -> str:
    if finding.added:
        return ""
    if finding.flight:
        return f"belongs to {finding.flight} alone"
    if finding.on_floor:
        return "a function that was found near the floor is told, and not taken out"
    label = finding.candidates[0].label if finding.candidates else finding.effect.label
    reasons = {item.what: item.why for item in reversed(refused)}
    if label in reasons:
        return reasons[label]
    if not finding.effect.usable:
        return finding.effect.why_unusable
    if any(f" + {label} + " in f" + {what} + " for what in reasons):
        return "judged together with others: see the verdict"
    return reasons.get("all", "the filter does as well without it")
