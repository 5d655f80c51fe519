# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Group findings for a reader: candidates of one selection step form one entry."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from uwb_tdoa_bias.effects import Effect, LabelEffect
from uwb_tdoa_bias.effects.base import SIGNIFICANT, listed, measured
from uwb_tdoa_ekf.evidence import DELAY

from ..findings import EffectFinding, Refused
from ..over_flights import ALL, course, in_words
from ..regression.confounding import Alternative, Level
from ..result import Diagnosis
from ..validation import LEAST_WORTH

CM = 100.0  # cm per metre
WORTH_DOING = 0.01  # m, smallest gain in position that is worth an action
SMALLEST_DELAY = 0.03  # m; an anchor whose delay differs by less from the others is not named
DEGREES = float(np.degrees(1.0))  # degrees per radian
FORMS = {"arrival": " (of each arrival)", "anchor": " (by anchor)"}
MOVED = 0.7  # smallest share of functions, without their level, that makes an anchor one that moved
SHOWN = 6  # largest number of shown values


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

        An unknown gain counts as a gain, except near the floor, where no error in the air shows it.
        """
        if any(isinstance(finding.effect, LabelEffect) for finding in self.findings):
            return self.added  # a fault is corrected whatever its worth
        if not any(finding.effect.significant() for finding in self.findings):
            return False
        if self.worth is None:
            return self.added and not self.findings[0].on_floor
        return self.added and self.worth >= WORTH_DOING

    @property
    def physics(self) -> str:
        """Return the physical cause, in words."""
        first = self.findings[0]
        if first.declared:
            return first.effect.row.physics
        return "structure that no effect of the catalogue explains"

    @property
    def causes(self) -> tuple[str, ...]:
        """Return the sentences of its advice that other functions without a name may share."""
        nameless = [finding.effect for finding in self.findings if not finding.declared]
        said = (sentence for effect in nameless for sentence in effect.advice()[1:])
        return tuple(dict.fromkeys(said))

    @property
    def levels(self) -> list[str]:
        """Return sentences on anchors that seem farther or nearer on average, by its functions."""
        found = (pair for finding in self.findings for pair in finding.levels.items())
        return [_level_in_words(*pair) for pair in found if abs(pair[1].delay) > SMALLEST_DELAY]

    @property
    def differing(self) -> str:
        """Return in a few words how flights differ; "" if they do not, or are one."""
        shares = self.findings[0].shares
        return "" if course(shares) == ALL else in_words(shares)

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
    for finding in findings_of(diagnosis):
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


def findings_of(diagnosis: Diagnosis) -> list[EffectFinding]:
    """Return the findings of a Diagnosis as reports show them, see `without_common_part`."""
    if any(flight.range is not None for flight in diagnosis.flights):
        return diagnosis.findings  # ranges show the common part of the delays
    ids = diagnosis.flights[0].anchors.ids.tolist()
    return [
        replace(finding, effect=without_common_part(finding.effect, ids))
        for finding in diagnosis.findings
    ]


def without_common_part(effect: Effect, anchors: Iterable[int]) -> Effect:
    """Return delays of anchors relative to their weighted median; other Effects as they are.

    TDOAs show differences of delays only. Anchors that differ by less than SMALLEST_DELAY, or two
    standard deviations, are left out. An anchor without a value has the delay 0.
    """
    if effect.name != DELAY:
        return effect
    names = list(dict.fromkeys([*map(str, anchors), *effect.values]))
    values = np.array([effect.values.get(name, 0.0) for name in names])
    std = np.array([effect.std.get(name) or np.nan for name in names])
    weight = np.nan_to_num(std, nan=np.nanmedian(std) if np.isfinite(std).any() else 1.0) ** -2.0
    order = np.argsort(values)
    share = np.cumsum(weight[order])
    off = values - values[order][np.searchsorted(share, 0.5 * share[-1])]
    named = {
        name: float(value)
        for name, value, its_std in zip(names, off, np.nan_to_num(std))
        if abs(value) > max(SMALLEST_DELAY, SIGNIFICANT * its_std)
    }
    return replace(
        effect,
        values=named,
        std={name: known for name, known in effect.std.items() if name in named},
    )


def _level_in_words(anchor: str, level: Level) -> str:
    """Return a sentence on the Level of an anchor."""
    seems = f"{abs(level.delay):.2f} m {'farther' if level.delay > 0.0 else 'nearer'}"
    how = "as with another antenna delay"
    if level.explained > MOVED and np.linalg.norm(level.shift) > SMALLEST_DELAY:
        move = "({:.2f}, {:.2f}, {:.2f}) m".format(*level.shift)
        how = f"and a move by {move} explains {level.explained:.0%} of the rest"
    return f"On average anchor {anchor} seems {seems} than the others, {how}."


def worth_in_words(entry: Entry) -> str:
    """Return the worth in words, such as "1.5 cm"."""
    if entry.worth is None:
        return "not told by errors in the air" if entry.findings[0].on_floor else "not known"
    if abs(entry.worth) < LEAST_WORTH:
        return "less than 0.1 cm"
    words = f"{entry.worth * CM:.1f} cm"
    return words if entry.worth > 0.0 else f"nothing ({words})"


def doubt_in_words(entry: Entry) -> list[str]:
    """Return sentences on all alternatives, and flights that would decide.

    There is none on an entry that was compared with the catalogue, and that nothing else explains.
    """
    first = entry.findings[0]
    imitators = [other for other in entry.alternatives if other.gap is None]
    if not entry.alternatives and not first.candidates:
        like = first.effect.row.confounded_with
        return [f"not compared; like {listed(like, 'or')}" if like else "not compared"]
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
    if not effect.values:
        return "no anchor differs significantly from the others"
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
