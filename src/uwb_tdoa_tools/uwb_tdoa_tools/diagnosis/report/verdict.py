# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""State the verdict: the error before and after, why, where errors remain, and the uncertainty."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from uwb_tdoa_bias.effects import SmoothTerm
from uwb_tdoa_bias.effects.base import listed, measured
from uwb_tdoa_bias.effects.smooth_term import causes, described
from uwb_tdoa_ekf.monitoring.finding import Finding as NumbersFinding

from ...scoring.gains import LOSS, NO_DIFFERENCE, clear_change
from ...scoring.phases import TITLES
from ..channels import ChannelResidual
from ..channels.figures import rows_by_value
from ..findings import prefixes_of
from ..regression.table import BLOCK
from ..result import Diagnosis
from ..self_calibration.solve import CLEARLY, CLEARLY_OF_RANGES, LEFT
from ..validation import LEAST_WORTH, SELECTED_ON
from .entries import CM, WORTH_DOING, Entry, entries, for_people

MOST_NAMES = 6  # largest number of named flights
NAMED = 3  # largest number of named reasons, and of named places
WHOLE = 0.995  # share of the values from which it rounds to 100 %
# What other flights show of a diagnosis of FEW flights, measured (docs/notebook/diagnosis.md): their
# gain over the promised one, and how many get worse by 5 %
FEW, OF_OTHERS, WORSE_OF_OTHERS = 2, "0.5 to 0.9", "one in ten"
MOST = 0.5  # share of the gain from which an effect is most of it
POINTS = 60  # at which a function is evaluated
# smallest RMS residual of a named pair over BLOCK s: m, and relative to the RMS of all rows
LARGE, ABOVE = (0.15, 3.0)
FEWEST = 3  # fewest rows of such a pair
ERROR = "The position error (3D RMSE)"
NOTHING_FOUND = "Nothing was found: what the model leaves of the measurements looks like noise."
UNKNOWN = "Without ground truth nobody knows the position error, neither before nor after."


@dataclass(frozen=True)
class Verdict:
    """The verdict of a diagnosis.

    headline : one sentence; more : sentences that qualify it
    kind : "better", "unsure" (chance is possible), "same" (nothing added in the air), "nothing" (no
        finding) or "unknown" (no ground truth)
    """

    headline: str
    more: tuple[str, ...]
    kind: str

    @property
    def sentences(self) -> tuple[str, ...]:
        """Return the headline and the other sentences."""
        return (self.headline, *self.more)


def verdict(diagnosis: Diagnosis) -> Verdict:
    """Return the Verdict of a Diagnosis."""
    added = any(finding.added for finding in diagnosis.findings)
    if diagnosis.after["pooled"].get("rmse_3d") is None:
        return _without_truth(diagnosis, added)
    return _with_errors(diagnosis) if added else _nothing_added(diagnosis)


def faults_in_words(diagnosis: Diagnosis) -> list[str]:
    """Return one sentence per driver, survey or clock error.

    It names the flights, and the evidence of the first flight.
    """
    groups: dict[str, list[tuple[str, NumbersFinding]]] = {}
    for name, found in diagnosis.numbers.items():
        for item in found:
            groups.setdefault(item.cause, []).append((name, item))
    return [
        (
            f"{cause[0].upper()}{cause[1:]} ({listed(name for name, _ in several)}): "
            f"{several[0][1].evidence}; {several[0][1].remedy}."
        )
        for cause, several in groups.items()
    ]


def truth_in_words(diagnosis: Diagnosis) -> list[str]:
    """Return sentences on clock and frame errors of the ground truth."""
    return [
        f"{name}: {sentence}." for name, said in diagnosis.judge_truth.items() for sentence in said
    ]


def centimetres(value: float) -> str:
    """Return a length in m as text, such as "20.2 cm"."""
    return f"{value * CM:.1f} cm"


def percent(interval: Sequence[float]) -> str:
    """Return an interval of shares as text, such as "66 to 72 %"."""
    return f"{interval[0] * 100:.0f} to {interval[1] * 100:.0f} %"


def _bounds(pooled: dict[str, Any]) -> str:
    """Return the 95 % interval of the 3D RMSE as text."""
    interval = pooled["rmse_3d_ci"]
    return f"{interval[0] * CM:.1f} to {interval[1] * CM:.1f}" if interval else "unknown"


def _with_errors(diagnosis: Diagnosis) -> Verdict:
    before, after = diagnosis.before["pooled"], diagnosis.after["pooled"]
    interval = after.get("rmse_3d_gain_ci")
    share = f"{100 * (1.0 - after['rmse_3d'] / before['rmse_3d']):.0f} %"
    sure = f"; gain {share} ({percent(interval)})" if interval else ""
    more = (
        f"95 % intervals: {_bounds(before)} cm before, {_bounds(after)} cm after{sure}.",
        f"Judged on {diagnosis.judged_on}: {_flights(diagnosis)}; {_named(diagnosis)}.",
        *reasons(diagnosis),
        *_worse_phases(diagnosis),
        *_with_noise(diagnosis),
        *_over_phases(diagnosis),
        *_shared(diagnosis),
        *_caveats(diagnosis),
        *_worse_runs(diagnosis),
        *_diverged(diagnosis),
        *left_over(diagnosis),
    )
    change = f"from {centimetres(before['rmse_3d'])} to {centimetres(after['rmse_3d'])}"
    if all(finding.on_floor for finding in diagnosis.findings if finding.added):
        headline = (
            f"{ERROR} stays {centimetres(after['rmse_3d'])}: what is added acts near the floor "
            "alone, where the filter weighs it."
        )
        return Verdict(headline, more, "same")
    if interval and interval[0] > 0.0:
        return Verdict(f"{ERROR} falls {change}: {share} of it is gone.", more, "better")
    # The interval includes zero, but a loss above LOSS is improbable.
    if interval and clear_change(before["rmse_3d"], after["rmse_3d"], interval) > 0:
        headline = (
            f"{ERROR} falls {change}: {share} of it is gone. A loss above {100 * LOSS:.0f} % has a "
            "probability below 2.5 %."
        )
        return Verdict(headline, more, "better")
    unsure = (
        "More flights to judge on (--holdout) make that certain; until then compare before "
        "relying on effects.yaml."
    )
    headline = f"There is {NO_DIFFERENCE}: the position error (3D RMSE) goes {change}."
    if interval and interval[1] < 0.0:
        headline = f"{ERROR} rises {change}."
    return Verdict(headline, (*more, unsure), "unsure")


def _nothing_added(diagnosis: Diagnosis) -> Verdict:
    pooled = diagnosis.before["pooled"]
    error = f"{centimetres(pooled['rmse_3d'])}, 95 % interval {_bounds(pooled)} cm"
    more = (
        f"{ERROR} is {error}: {_flights(diagnosis)}; {_named(diagnosis)}.",
        *(f"Not added: {item.why}." for item in diagnosis.refused if item.what == "all"),
        *_with_noise(diagnosis),
        *_over_phases(diagnosis),
        *_shared(diagnosis),
        *_diverged(diagnosis),
        *left_over(diagnosis),
    )
    found = len({finding.key for finding in diagnosis.findings})
    if not found:
        return Verdict(NOTHING_FOUND, more, "nothing")
    what = "One effect was found, but taking it out does"
    if found > 1:
        what = f"{found} effects were found, but taking them out does"
    return Verdict(
        f"{what} not make the position better; nothing is added to the model.", more, "same"
    )


def _without_truth(diagnosis: Diagnosis, added: bool) -> Verdict:
    before, after = (
        side["pooled"]["residual_spread"] for side in (diagnosis.before, diagnosis.after)
    )
    stream = "TDOAs" if any(len(flight.tdoa) for flight in diagnosis.flights) else "ranges"
    scatter = f"Innovations (measured minus predicted {stream}) scatter by {centimetres(before)}"
    if not diagnosis.findings:
        return Verdict(NOTHING_FOUND, (UNKNOWN, f"{scatter}."), "nothing")
    if not added:
        headline = (
            "Nothing of what was found is added to the model: nobody can tell whether it would "
            "help the position."
        )
        decided = diagnosis.refused[len(diagnosis.attribution.refused) :]
        why = (f"Not added, {item.what}: {item.why}." for item in decided)
        return Verdict(headline, (UNKNOWN, *why, f"{scatter}."), "unknown")
    headline = (
        "What was found makes measurements agree better; what that is worth for the position is "
        "unknown."
    )
    limit = (
        f"{CLEARLY_OF_RANGES:g} times smaller than it was, a limit that was set on simulated "
        "flights"
    )
    if stream == "TDOAs":
        limit = (
            f"not above {CM * LEFT:.1f} cm, or {CLEARLY:g} times smaller than it was, limits that "
            "were set on measured flights"
        )
    validated = (
        "It is added because what is slow in the innovations becomes small: what it leaves is "
        f"{limit}."
    )
    change = f"{scatter} before and {centimetres(after)} after, on {diagnosis.judged_on}."
    return Verdict(headline, (UNKNOWN, validated, change), "unknown")


def _names(diagnosis: Diagnosis) -> list[str]:
    """Return the names of the judged flights, each once."""
    return list(dict.fromkeys(run["flight"] for run in diagnosis.before["runs"]))


def _flights(diagnosis: Diagnosis) -> str:
    # first and last stamp per flight, since judged parts of a flight alternate
    ends: dict[str, list[float]] = {}
    for score in diagnosis.before["scores"]:
        ends.setdefault(score.name, []).extend([score.first, score.last])
    count = len(_names(diagnosis))
    seconds = sum(max(of) - min(of) for of in ends.values())
    parts = " or ".join(sorted({TITLES[score.part] for score in diagnosis.before["scores"]}))
    return f"{count} flight{'s' if count > 1 else ''}, {seconds:.0f} s {parts}"


def _named(diagnosis: Diagnosis) -> str:
    """Return the names of the judged flights, the first few of many."""
    names = _names(diagnosis)
    rest = len(names) - MOST_NAMES
    return listed(names) if rest <= 0 else f"{', '.join(names[:MOST_NAMES])} and {rest} more"


def _worse_phases(diagnosis: Diagnosis) -> list[str]:
    """Return a sentence on phases in which the error grows."""
    worse = "; ".join(_worse(diagnosis).values())
    return [f"Worse: {worse}."] if worse else []


def _worse(diagnosis: Diagnosis) -> dict[str, str]:
    """Return {phase: clause} of the phases in which the error grows; {} if nothing is added."""
    if not any(finding.added for finding in diagnosis.findings):
        return {}
    return _of_worse_phases(diagnosis.before["pooled"], diagnosis.after["pooled"])


def _with_noise(diagnosis: Diagnosis) -> list[str]:
    """Return a sentence on the error with all files as they are written."""
    if diagnosis.written is None or diagnosis.tdoa_std is None:
        refused = (item for item in diagnosis.refused if item.what.startswith("tdoa_std"))
        return [f"{item.what} is not written to ekf_node.yaml: {item.why}." for item in refused]
    after, said = diagnosis.written["pooled"], _worse(diagnosis)
    phases = after.get("phases", {}), diagnosis.after["pooled"].get("phases", {})
    worse = "; ".join(
        clause
        for name, clause in _of_worse_phases(diagnosis.before["pooled"], after).items()
        if name not in said or clear_change(*(side[name]["rmse_3d"] for side in phases))
    )
    also = f"; worse: {worse}" if worse else ""
    return [
        f"With tdoa_std {diagnosis.tdoa_std:.3f} m of ekf_node.yaml too it is "
        f"{centimetres(after['rmse_3d'])}{also}."
    ]


def _over_phases(diagnosis: Diagnosis) -> list[str]:
    """Return a sentence on errors in the other phases, which the first sentence leaves out."""
    before, after = (
        side["pooled"].get("phases", {}) for side in (diagnosis.before, diagnosis.after)
    )
    said = {score.part for score in diagnosis.before["scores"]} | set(_worse(diagnosis))
    parts = []
    for name in (name for name in TITLES if name in before and name not in said):
        sides = [_of_phase(side[name]) for side in (before, after)]
        parts.append(f"{TITLES[name]} {' to '.join(dict.fromkeys(sides))}")
    return [f"Outside of that, before and after: {'; '.join(parts)}."] if parts else []


def worse_phases(before: dict[str, Any], after: dict[str, Any]) -> Iterator[str]:
    """Yield one clause per phase in which the error grows.

    before, after : pooled figures of a side of `compare`
    """
    yield from _of_worse_phases(before, after).values()


def _of_worse_phases(before: dict[str, Any], after: dict[str, Any]) -> dict[str, str]:
    """Return {phase: clause} as of `worse_phases`."""
    out = {}
    sides = before.get("phases", {}), after.get("phases", {})
    for name in (name for name in TITLES if name in sides[0] and name in sides[1]):
        first, second = (side[name] for side in sides)
        known = first["rmse_3d"] is not None and second["rmse_3d"] is not None
        if known and clear_change(first["rmse_3d"], second["rmse_3d"]) < 0:  # it rises
            out[name] = f"{TITLES[name]} from {_of_phase(first)} to {_of_phase(second)}"
    return out


def _of_phase(figures: dict[str, Any]) -> str:
    """Return the 3D RMSE and the NEES of a phase, as text."""
    if figures["rmse_3d"] is None:
        return "unknown"
    nees = "" if figures["nees_mean"] is None else f" (NEES {figures['nees_mean']:.1f})"
    return f"{centimetres(figures['rmse_3d'])}{nees}"


def _shared(diagnosis: Diagnosis) -> list[str]:
    """Return a caveat if the reference knows only a part of the path."""
    if all(diagnosis.reference.positions_known):
        return []
    return [
        f"Errors are against {diagnosis.reference.words}: an error that both share is not in them."
    ]


def _caveats(diagnosis: Diagnosis) -> list[str]:
    out = []
    base = len(diagnosis.effects) - sum(finding.added for finding in diagnosis.findings)
    if base > 0:
        effects = "effects" if base > 1 else "effect"
        out.append(f"Before is with the {base} {effects} that the model held already.")
    count = len(diagnosis.flights)
    if diagnosis.share < WHOLE:
        shows = "these show" if count > 1 else "this one shows"
        out.append(
            f"Other flights have less of what {shows}, so {100.0 * diagnosis.share:.0f} % of each "
            "fitted value is applied."
        )
    own = not {flight.name for flight in diagnosis.flights}.isdisjoint(_names(diagnosis))
    if own and SELECTED_ON not in diagnosis.judged_on:
        out.append("Some of the judged flights are flights of the fit.")
    if own and diagnosis.share < WHOLE and count <= FEW:
        out.append(
            f"On other flights, expect {OF_OTHERS} of this gain, and {WORSE_OF_OTHERS} to get "
            "worse by 5 % or more. Diagnose three flights or more together to avoid that."
        )
    if len(_names(diagnosis)) == 1:
        out.append("One flight does not tell how much flights differ.")
    return out


def _worse_runs(diagnosis: Diagnosis) -> list[str]:
    runs = [
        (after["rmse_3d"] - before["rmse_3d"], before["rmse_3d"], after["rmse_3d"], after["flight"])
        for before, after in zip(diagnosis.before["runs"], diagnosis.after["runs"])
    ]
    worse = [run for run in runs if run[0] > 0.0]
    if not worse or len(runs) == 1:
        return []
    _, before, after, name = max(worse, key=lambda run: run[0])
    much = f"most on {name}, from {centimetres(before)} to {centimetres(after)}"
    return [f"On {len(worse)} of {len(runs)} runs the error grows, {much}."]


def _diverged(diagnosis: Diagnosis) -> list[str]:
    before, after = (
        sum(run["diverged"] for run in side["runs"]) for side in (diagnosis.before, diagnosis.after)
    )
    if not before and not after:
        return []
    return [f"Of {len(diagnosis.before['runs'])} runs, {before} diverged before and {after} after."]


def reasons(diagnosis: Diagnosis) -> list[str]:
    """Return sentences on the added effects that make the error before, the largest worth first.

    There are NAMED at most. The worth is in m of 3D RMSE, so ground truth is needed: without it the
    result is []. A fitted function, which is no declared effect, is described by its largest part,
    with its most likely causes, unless these are said already.
    """
    before, after = (side["pooled"]["rmse_3d"] for side in (diagnosis.before, diagnosis.after))
    out: list[str] = []
    said: set[str] = set()
    for entry in entries(diagnosis):
        worth = entry.worth or 0.0
        if len(out) < NAMED and entry.added and worth >= (WORTH_DOING if out else LEAST_WORTH):
            sentence, likely = _sentence(entry, len(out), before - after), _causes(entry)
            out.append(sentence if likely in said else f"{sentence}{likely}")
            said.add(likely)
    return out


def _causes(entry: Entry) -> str:
    """Return the most likely causes of a function without a name, after a space; "" for others."""
    if entry.findings[0].declared:
        return ""
    others = [other.effect for other in entry.undecided[:1]]
    return f" Likely causes: {listed([causes(_largest(entry)[0])[0], *others], 'or')}."


def _sentence(entry: Entry, place: int, gain: float) -> str:
    worth = entry.worth or 0.0
    begin = "Then" if place else "Mostly" if worth >= MOST * gain > 0.0 else "In part"
    much = f"{CM * worth:.1f} cm"
    if worth > gain:
        much += " beside the others"
    elif not place:
        much = f"{CM * worth:.1f} of {CM * gain:.1f} cm"
    return f"{begin} {cause(entry)}, worth {much}."


def cause(entry: Entry) -> str:
    """Return what is wrong, as a clause; for a fitted function its largest part."""
    if not entry.findings[0].declared:
        said = described(*_largest(entry))
        terms = _functions(entry)
        if sum(len(prefixes_of(term)) for term in terms) == 1:
            return said
        covariates = listed(
            dict.fromkeys(name.replace("_", " ") for term in terms for name in term.arguments)
        )
        return f"errors that depend on {covariates}, anchor by anchor; at most {said}"
    effect = entry.findings[0].effect
    what, key = effect.physics.partition(":")[0], effect.largest_size()
    if key is None:
        return f"{what} ({effect.name})"
    unit, factor = for_people(effect.unit_of(key))
    std = effect.std.get(key)
    largest = measured(factor * effect.values[key], std and factor * std, unit)
    sizes = sum(not effect.is_condition(name) for name in effect.values)
    most = "largest " if sizes > 1 else ""
    if not effect.significant_sizes():
        values = f"none of its {sizes} values is" if sizes > 1 else "its value is not"
        means = f", {effect.if_undetermined}" if effect.if_undetermined else ""
        return (
            f"a fitted correction ({effect.name}; {most}{key} = {largest}): {values} twice the "
            f"standard deviation{means}"
        )
    return f"{what} ({effect.name}; {most}{key} = {largest})"


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
    return (f"The largest residuals that nothing explains: {'; '.join(places)}.",) if places else ()


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
