# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Group findings for a reader: candidates of one selection step form one entry."""

from __future__ import annotations

from dataclasses import dataclass
import re
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import LabelEffect
from uwb_tdoa_bias.effects.base import listed, measured

from ..over_flights import ALL, course, in_words

if TYPE_CHECKING:
    from collections.abc import Hashable, Iterable, Sequence

    from uwb_tdoa_bias.effects import Effect

    from ..findings import EffectFinding, Refused
    from ..regression.confounding import Alternative
    from ..result import Diagnosis

CM = 100.0  # cm per metre
OR = "or"
LEAST_WORTH = 0.0005  # m, smallest difference
WORTH_DOING = 0.005  # m, smallest gain in position that is worth an action
DEGREES = float(np.degrees(1.0))  # degrees per radian
FORMS = {"arrival": " (of each arrival)", "anchor": " (by anchor)"}
SHOWN = 6  # largest number of shown values
LONGEST = 8.0  # em, longest bar


@dataclass(frozen=True)
class Entry:
    """Findings that entered the model together.

    title : of all findings; values : significant values, in words
    why_not : reason for not being in the model, "" if added; alternatives : (Alternative, ...)
    """

    findings: tuple[EffectFinding, ...]
    title: str
    values: str
    why_not: str
    alternatives: tuple[Alternative, ...]

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
        fault = any(
            isinstance(finding.effect, LabelEffect) for finding in self.findings
        )  # a fault is corrected whatever its worth
        return self.added and (fault or self.worth is None or self.worth >= WORTH_DOING)

    @property
    def physics(self) -> str:
        """Return the physical cause, in words."""
        first = self.findings[0]
        return (
            first.effect.physics
            if first.declared
            else "structure that no effect of the catalogue explains"
        )

    @property
    def over_flights(self) -> str:
        """Return a sentence on differences between flights; "" for a single flight."""
        return in_words(self.findings[0].shares)

    @property
    def shared(self) -> str:
        """Return in a few words how flights differ; "" for a single flight."""
        words = self.over_flights
        return "the same in all flights" if course(self.findings[0].shares) == ALL else words

    @property
    def undecided(self) -> list[Alternative]:
        """Return the alternatives that fit nearly equally well, the nearest first."""
        gaps = [(other.gap, other) for other in self.alternatives if other.gap is not None]
        return [other for _, other in sorted(gaps, key=lambda pair: pair[0])]

    @property
    def imitators(self) -> list[Alternative]:
        """Return the alternatives that explain as much with more, or less plausible, values."""
        return [other for other in self.alternatives if other.gap is None]


def entries(diagnosis: Diagnosis) -> list[Entry]:
    """Return the entries of a Diagnosis: added ones by their worth, then the others.

    Without a known worth the most prominent comes first.
    """
    groups: dict[Hashable, list[EffectFinding]] = {}
    for finding in diagnosis.findings:
        key = finding.key if finding.declared or not finding.candidates else finding.candidates[0]
        groups.setdefault(key, []).append(finding)
    out = [_entry(tuple(group), diagnosis.refused) for group in groups.values()]

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
    return (
        f"{entry.worth * CM:.1f} cm"
        if entry.worth > 0.0
        else f"nothing ({entry.worth * CM:.1f} cm)"
    )


def undecided_in_words(entry: Entry) -> list[str]:
    """Return one sentence per flight that would decide between alternatives."""
    return [
        f"Could as well be {names}; to tell: {flight}."
        for names, flight in by_flight(entry.undecided)
    ]


def doubt_in_words(entry: Entry) -> list[str]:
    """Return sentences on all alternatives, and flights that would decide."""
    imitated = by_flight(entry.imitators)
    return undecided_in_words(entry) + [
        f"Could be imitated by {names}, less plausibly; to tell: {flight}."
        for names, flight in imitated
    ]


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
            sentences = [f"not compared{f'; like {listed(like, OR)}' if like else ''}"]
        told = [
            sentence if sentence not in first else f"as {first[sentence]}" for sentence in sentences
        ]
        out[entry.title] = list(dict.fromkeys(told))
        for sentence in sentences:
            first.setdefault(sentence, entry.title)
    return out


def known_with(entry: Entry) -> list[str]:
    """Return sentences that qualify its advice: worth and doubt."""
    together = ", together" * (len(entry.advice) > 1)
    worth = [] if entry.worth is None else [f"Worth {worth_in_words(entry)} of position{together}."]
    doubt = " ".join(undecided_in_words(entry))
    return worth + ([f"Make sure first: this {doubt[0].lower()}{doubt[1:]}"] if doubt else [])


def bar(entry: Entry, found: Iterable[Entry]) -> float:
    """Return the length of the bar of its worth, em; 0 for none.

    The largest worth of the added entries has length LONGEST.
    """
    largest = max((other.worth or 0.0 for other in found if other.added), default=0.0)
    return (
        LONGEST * entry.worth / largest
        if entry.worth and entry.worth >= LEAST_WORTH and largest > 0.0
        else 0.0
    )


def by_flight(alternatives: Iterable[Alternative]) -> list[tuple[str, str]]:
    """Return [(names of effects, flight that decides between them)]."""
    groups: dict[str, list[str]] = {}
    for other in alternatives:
        groups.setdefault(other.tell_apart, []).append(other.effect)
    return [(listed(names, "or"), flight) for flight, names in groups.items()]


def for_people(unit: str, key: str = "") -> tuple[str, float]:
    """Return (unit, factor) that show a value of an effect: angles in degrees.

    key : parameter, which decides between several units
    """
    if unit == "m, rad":
        unit = "m" if key in ("x", "y", "z") else "rad"
    return (unit.replace("rad", "degrees"), DEGREES) if unit in ("rad", "rad/s") else (unit, 1.0)


def by_anchor(effect: Effect) -> dict[int, dict[str, tuple[float, float | None]]]:
    """Return the significant values of an Effect per anchor, in the order of anchors.

    The form is {anchor: {"x", "y", "z" or "": (value, std or None)}}. It is {} if a value is not of
    one anchor.
    """
    out: dict[int, dict[str, tuple[float, float | None]]] = {}
    for key in effect.significant():
        parts = re.fullmatch(r"(\d+)(?:\.([xyz]))?", key)
        if not parts:
            return {}
        out.setdefault(int(parts[1]), {})[parts[2] or ""] = effect.values[key], effect.std.get(key)
    return dict(sorted(out.items()))


def _entry(findings: tuple[EffectFinding, ...], refused: Sequence[Refused]) -> Entry:
    first = findings[0]
    others = {other.effect: other for finding in findings for other in finding.alternatives}
    return Entry(
        findings, _title(findings), _values(first), _why_not(first, refused), tuple(others.values())
    )


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
    significant = effect.significant()
    fitted_first = sorted(effect.values.items(), key=lambda item: not effect.std.get(item[0]))
    unit, factors = (
        effect.unit.replace("rad", "degrees"),
        {key: for_people(effect.unit, key)[1] for key in effect.values},
    )
    vague = len(effect.values) - len(significant)
    if not significant and vague > SHOWN:
        return f"{vague} values, none twice its standard deviation"
    named = significant or effect.values  # without significant values, all are named
    shown = [
        f"{key} = {measured(value * factors[key], (effect.std.get(key) or 0.0) * factors[key])}"
        for key, value in fitted_first
        if key in named
    ]
    rest = shown[SHOWN:]
    words = ", ".join(shown[:SHOWN] + ([f"{len(rest)} more"] if rest else []))
    if not significant:
        return f"{words} ({unit}); not twice the standard deviation"
    return f"{words} ({unit})" + (f"; {vague} not significant" if vague else "")


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
