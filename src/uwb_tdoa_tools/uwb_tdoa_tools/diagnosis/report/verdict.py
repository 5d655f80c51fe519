# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""State the verdict: the error before and after, why, what to do, and what to fly next."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from uwb_tdoa_bias.effects import SmoothTerm
from uwb_tdoa_bias.effects.base import SIGNIFICANT, counted, listed, measured
from uwb_tdoa_bias.effects.smooth_term import described, in_brief
from uwb_tdoa_ekf.monitoring.finding import Finding as NumbersFinding

from ...readers.streams import protocol
from ...scoring.metrics import LOSS, NO_DIFFERENCE, clear_change, gain
from ...scoring.phases import NEAR_THE_FLOOR, TITLES
from ..channels import ChannelResidual
from ..channels.figures import rows_by_value
from ..findings import prefixes_of
from ..regression.table import BLOCK
from ..result import Diagnosis
from ..self_calibration.solve import CLEARLY, CLEARLY_OF_RANGES, LEFT
from ..validation import LEAST_WORTH, SELECTED_ON
from .entries import CM, WORTH_DOING, Entry, entries, for_people
from .tables import tasks

MOST_NAMES = 3  # largest number of named flights
MOST_ACTIONS = 3  # largest number of actions
NAMED = 3  # largest number of named reasons, and of named places
SURE = 5.0  # standard deviations from which a cause is called sure
WHOLE = 0.995  # share of the values from which it rounds to 100 %
# What other flights show of a diagnosis of FEW flights, measured (docs/notebook/diagnosis.md): their
# gain over the promised one, and how many get worse by 5 %
FEW, OF_OTHERS, WORSE_OF_OTHERS = 2, "0.5 to 0.9", "one in ten"
POINTS = 60  # at which a function is evaluated
# smallest RMS residual of a named pair over BLOCK s: m, and relative to the RMS of all rows
LARGE, ABOVE = (0.15, 3.0)
FEWEST = 3  # fewest rows of such a pair
ERROR = "The position error (3D RMSE)"
LITTLE = "Nothing is wrong that costs 1 cm. "
NOTHING_MORE = "Nothing before a change in the hall or the survey. Then fly and diagnose again."
NOTHING_FOUND = "Nothing was found: what the model leaves of the measurements looks like noise."
UNKNOWN = "Without ground truth, the position error is not known."


@dataclass(frozen=True)
class Verdict:
    """The verdict of a diagnosis, for the person who has to act.

    headline : the position error before and after, and on which flights
    cause : what is wrong, and how sure that is
    actions : at most MOST_ACTIONS sentences, the most worth first
    fly : what to fly next
    apply : whether to apply effects.yaml; applies : the same as bool
    details : sentences that qualify it
    kind : "better", "little" (better by less than WORTH_DOING), "unsure" (chance is possible), "same"
        (nothing added in the air), "nothing" (no finding) or "unknown" (no ground truth)
    """

    headline: str
    cause: str
    actions: tuple[str, ...]
    fly: str
    apply: str
    applies: bool
    details: tuple[str, ...]
    kind: str

    @property
    def sentences(self) -> tuple[str, ...]:
        """Return all sentences but the details."""
        return (self.headline, self.cause, *self.actions, self.fly, self.apply)


def verdict(diagnosis: Diagnosis) -> Verdict:
    """Return the Verdict of a Diagnosis."""
    found = entries(diagnosis)
    added = [entry for entry in found if entry.added]
    kind = _kind(diagnosis, found)
    if diagnosis.after["pooled"].get("rmse_3d") is None:
        headline, details = _without_truth(diagnosis, kind, bool(added))
    else:
        headline, details = _headline(diagnosis, kind), _details(diagnosis, bool(added))
    applies, apply = _application(diagnosis, kind, added)
    return Verdict(
        headline,
        _cause_and_doubt(diagnosis, found),
        _actions(found),
        _next_flight(diagnosis, added, kind, applies),
        apply,
        applies,
        details,
        kind,
    )


def _kind(diagnosis: Diagnosis, found: Sequence[Entry]) -> str:
    """Return the kind of a Verdict."""
    before, after = (side["pooled"].get("rmse_3d") for side in (diagnosis.before, diagnosis.after))
    if not found:
        return "nothing"
    if after is None:
        return "unknown"
    if all(entry.findings[0].on_floor for entry in found if entry.added):
        return "same"
    interval = diagnosis.after["pooled"].get("rmse_3d_gain_ci")
    if not interval or clear_change(before, after, interval) <= 0:
        return "unsure"
    little = before - after < WORTH_DOING and not any(entry.matters for entry in found)
    return "little" if little else "better"


def _headline(diagnosis: Diagnosis, kind: str) -> str:
    """Return the position error before and after, and on which flights."""
    before, after = (side["pooled"]["rmse_3d"] for side in (diagnosis.before, diagnosis.after))
    interval = diagnosis.after["pooled"].get("rmse_3d_gain_ci")
    on = f"on {_judged(diagnosis)}"
    change = f"from {CM * before:.1f} to {centimetres(after)}"
    if kind in ("same", "nothing"):
        return f"{ERROR} stays {centimetres(after)} {on}."
    if kind in ("better", "little"):
        share = f"{100 * gain(before, after):.0f} % (95 % interval {percent(interval)})"
        begin = LITTLE if kind == "little" else ""
        return f"{begin}{ERROR} falls {change}, by {share}, {on}."
    if interval and interval[1] < 0.0:
        return f"{ERROR} rises {change} {on}."
    return f"There is {NO_DIFFERENCE}: the position error (3D RMSE) goes {change} {on}."


def _judged(diagnosis: Diagnosis) -> str:
    """Return the names of the judged and of the fitted flights."""
    fitted = [flight.name for flight in diagnosis.flights]
    names = _names(diagnosis)
    if not set(names).isdisjoint(fitted):
        parts = "each flight" if len(fitted) > 1 else "every other 5 s"
        return f"{_few(names)}, {parts} corrected with values fitted to the rest"
    flights = "hold-out flights" if len(names) > 1 else "the hold-out flight"
    return f"{flights} {_few(names)}, fitted to {_few(fitted)}"


def _few(names: Sequence[str]) -> str:
    """Return the first few of many names."""
    rest = len(names) - MOST_NAMES
    return listed(names) if rest <= 0 else f"{', '.join(names[:MOST_NAMES])} and {rest} more"


def _cause_and_doubt(diagnosis: Diagnosis, found: Sequence[Entry]) -> str:
    """Return what is wrong, and how sure that is."""
    added = [entry for entry in found if entry.added]
    if not found:
        return NOTHING_FOUND
    if not added:
        what = "What was found is" if len(found) > 1 else f"{found[0].title} was found. It is"
        return f"{what} not added to the model: {found[0].why_not}."
    first, *others = added
    told = (side["pooled"].get("rmse_3d") for side in (diagnosis.before, diagnosis.after))
    before, after = (error or 0.0 for error in told)
    what = cause(first, in_brief)
    if first.worth is not None and first.worth >= LEAST_WORTH:
        of = f" of {CM * (before - after):.1f}" if first.worth <= before - after else ""
        what = f"{what}, worth {CM * first.worth:.1f}{of} cm"
    more = [
        f"{entry.title} ({centimetres(entry.worth)})"
        for entry in others
        if entry.worth and entry.worth >= WORTH_DOING
    ]
    rest = f" Also {listed(more)}; what they share is not counted." if more else ""
    return " ".join([f"{what[0].upper()}{what[1:]}. {_doubt(first)}{rest}", *first.levels])


def _doubt(entry: Entry) -> str:
    """Return how sure the cause of an Entry is."""
    first = entry.findings[0]
    if first.declared and entry.undecided:
        others = [other.effect for other in entry.undecided[:NAMED]]
        return f"Not sure: {listed(others, 'or')} explains these flights as well."
    if first.declared and not first.candidates and not entry.alternatives:
        return "It was not compared with other causes."
    deviations = max(
        (
            abs(value) / (one.effect.std.get(key) or np.inf)
            for one in entry.findings
            for key, value in one.effect.significant_sizes().items()
        ),
        default=None,
    )
    if deviations is None:
        return "Not sure."
    sure = "Sure" if deviations >= SURE else "Likely"
    by = f" ({deviations:.0f} standard deviations)" if deviations else ""
    if not first.declared:
        return f"{sure} that it is there{by}, but not why."
    return f"{sure}{by}: no other effect explains these flights as well."


def _actions(found: Sequence[Entry]) -> tuple[str, ...]:
    """Return what to do in the hall, the most worth first."""
    out = []
    for task in tasks(entry for entry in found if entry.matters and entry.advice)[:MOST_ACTIONS]:
        (first, said), *others = task
        worth = [f"Worth {centimetres(first.worth)}."] if first.worth else []
        parts = [part for entry, _ in others for term in _functions(entry) for part in term.parts]
        noun = "pair" if "-" in "".join(parts) else "anchor"
        then = [f"Then the same for {counted(dict.fromkeys(parts), noun)}."] if parts else []
        out.append(" ".join([*said, *worth, *then]))
    return tuple(out)


def _next_flight(diagnosis: Diagnosis, added: Sequence[Entry], kind: str, applies: bool) -> str:
    """Return what to fly next, as a sentence."""
    if diagnosis.next_flight:
        return diagnosis.next_flight.sentences[0]
    modes = [f"TDoA{protocol(one.tdoa)[4:]}" for one in diagnosis.flights if len(one.tdoa)]
    alone = sorted(mode for mode in set(modes) if modes.count(mode) == 1)
    if not applies and len(alone) > 1:
        return (
            f"Fly again in {listed(alone, 'or')}, and diagnose all flights together: a flight in "
            "each mode cannot confirm what the other shows."
        )
    if kind == "little":
        return NOTHING_MORE
    for entry in added:
        for rival in entry.undecided[:1]:
            fly = f"{rival.tell_apart[0].upper()}{rival.tell_apart[1:]}"
            return f"{fly}: it distinguishes {entry.title} from {rival.effect}."
    if len(diagnosis.flights) == 1:
        return (
            "Fly once more, where you will fly later, and diagnose both flights together: one may show "
            "what others lack."
        )
    if not set(_names(diagnosis)).isdisjoint(flight.name for flight in diagnosis.flights):
        return "Fly once more, and give that flight with --holdout: it took no part in the choice."
    return NOTHING_MORE


def _application(diagnosis: Diagnosis, kind: str, added: Sequence[Entry]) -> tuple[bool, str]:
    """Return (whether to apply effects.yaml, the same as a sentence)."""
    if not added:
        return False, "Do not apply effects.yaml: it corrects nothing that was not given."
    if kind == "unknown":
        return True, "Apply effects.yaml: innovations fall. The position error is not known."
    if kind in ("better", "little"):
        worse = "; ".join(worse_phases(diagnosis.before, diagnosis.after))
        or_not = ", or leave it" if kind == "little" else ""
        return True, f"Apply effects.yaml{or_not}{f'. It makes worse: {worse}' if worse else ''}."
    if kind == "unsure":
        return False, "Do not apply effects.yaml: these flights do not show that it helps."
    changes = _changes_of_phases(diagnosis.before, diagnosis.after)
    near = [changes[name] for name in NEAR_THE_FLOOR if name in changes]
    figures = f" ({'; '.join(words for _, words in near)})" if near else ""
    floor = f"it affects the floor only{figures}"
    if near and min(change for change, _ in near) > 0:
        return True, f"Apply effects.yaml to ekf_node: {floor}."
    return False, f"Do not apply effects.yaml: {floor}, and the error there does not fall."


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
    each = [
        f"{name}: {sentence}." for name, said in diagnosis.judge_truth.items() for sentence in said
    ]
    found = diagnosis.truth_transform
    return each + ([f"{_few(found.flights)}: {found.in_words()}"] if found else [])


def centimetres(value: float) -> str:
    """Return a length in m as text, such as "20.2 cm"."""
    return f"{value * CM:.1f} cm"


def percent(interval: Sequence[float]) -> str:
    """Return an interval of shares as text, such as "66 to 72 %"."""
    return f"{interval[0] * 100:.0f} to {interval[1] * 100:.0f} %"


def _details(diagnosis: Diagnosis, added: bool) -> tuple[str, ...]:
    """Return the sentences that qualify the errors."""
    before, after = (side["pooled"]["rmse_3d"] for side in (diagnosis.before, diagnosis.after))
    interval = diagnosis.after["pooled"].get("rmse_3d_gain_ci")
    risk = interval and interval[0] <= 0.0 < clear_change(before, after, interval)
    return (
        f"Judged on {diagnosis.judged_on}.",
        *([f"A loss above {100 * LOSS:.0f} % has a probability below 2.5 %."] if risk else []),
        *(f"Not added: {item.why}." for item in diagnosis.refused if item.what == "all"),
        *_with_noise(diagnosis),
        *_shared(diagnosis),
        *(_caveats(diagnosis) if added else []),
        *_worse_runs(diagnosis),
        *_diverged(diagnosis),
    )


def _without_truth(diagnosis: Diagnosis, kind: str, added: bool) -> tuple[str, tuple[str, ...]]:
    """Return (headline, details) where errors of the position are not known."""
    before, after = (
        side["pooled"]["residual_spread"] for side in (diagnosis.before, diagnosis.after)
    )
    stream = "TDOAs" if any(len(flight.tdoa) for flight in diagnosis.flights) else "ranges"
    scatter = f"Innovations (measured minus predicted {stream}) scatter by {centimetres(before)}"
    if kind == "nothing":
        return UNKNOWN, (f"{scatter}.",)
    if not added:
        decided = diagnosis.refused[len(diagnosis.attribution.refused) :]
        return UNKNOWN, (
            *(f"Not added, {item.what}: {item.why}." for item in decided),
            f"{scatter}.",
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
    return f"{change} {UNKNOWN}", (validated,)


def _names(diagnosis: Diagnosis) -> list[str]:
    """Return the names of the judged flights, each once."""
    return list(dict.fromkeys(run["flight"] for run in diagnosis.before["runs"]))


def _with_noise(diagnosis: Diagnosis) -> list[str]:
    """Return a sentence on the error with all files as they are written."""
    if diagnosis.written is None or diagnosis.tdoa_std is None:
        refused = (item for item in diagnosis.refused if item.what.startswith("tdoa_std"))
        return [f"{item.what} is not written to ekf_node.yaml: {item.why}." for item in refused]
    after = diagnosis.written["pooled"]
    worse = "; ".join(worse_phases(diagnosis.after, diagnosis.written))
    also = f"; worse: {worse}" if worse else ""
    return [
        f"With tdoa_std {diagnosis.tdoa_std:.3f} m of ekf_node.yaml too it is "
        f"{centimetres(after['rmse_3d'])}{also}."
    ]


def worse_phases(before: dict[str, Any], after: dict[str, Any]) -> list[str]:
    """Return one clause per phase in which the error grows.

    before, after : sides of `compare`
    """
    return [words for change, words in _changes_of_phases(before, after).values() if change < 0]


def _changes_of_phases(
    before: dict[str, Any], after: dict[str, Any]
) -> dict[str, tuple[float, str]]:
    """Return {phase: (m by which its error falls, the same in words)} of clear changes.

    A change is clear from WORTH_DOING and from SIGNIFICANT standard deviations of its mean over
    runs on. A run is one sample, because the error at rest hardly changes within it.

    before, after : sides of `compare`
    """
    found: dict[str, tuple[float, str]] = {}
    for name, title in TITLES.items():
        changes, words = [], []
        for rows in zip(*([side["pooled"], *side["runs"]] for side in (before, after))):
            figures = [row.get("phases", {}).get(name, {}) for row in rows]
            if None not in (errors := [each.get("rmse_3d") for each in figures]):
                changes.append(errors[0] - errors[1])
                words.append(f"{title}, from {' to '.join(map(_of_phase, figures))}")
        change, *of_runs = changes or [0.0]
        std = np.std(of_runs, ddof=1) / np.sqrt(len(of_runs)) if len(of_runs) > 1 else 0.0
        if abs(change) > max(WORTH_DOING, SIGNIFICANT * std):
            found[name] = change, words[0]
    return found


def _of_phase(figures: dict[str, Any]) -> str:
    """Return the 3D RMSE and the NEES of a phase, as text."""
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
    if base := len(diagnosis.base):
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
    if elsewhere := diagnosis.after["pooled"].get("rmse_3d_gain_elsewhere"):
        out.append(f"The 95 % interval of the gain of another flight is {percent(elsewhere)}.")
    if any(case.untold > 0.0 for case in diagnosis.cases):
        out.append(
            "These flights do not show which of several functions is the cause, so their mean is "
            "applied. To find the cause, fly where they differ."
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


def cause(entry: Entry, describe: Callable[[SmoothTerm, str], str] = described) -> str:
    """Return what is wrong, as a clause; for a fitted function its largest part.

    describe : `described` or `in_brief`
    """
    if not entry.findings[0].declared:
        said = describe(*_largest(entry))
        terms = _functions(entry)
        if sum(len(prefixes_of(term)) for term in terms) == 1:
            return said
        covariates = listed(
            dict.fromkeys(name.replace("_", " ") for term in terms for name in term.arguments)
        )
        return f"errors that depend on {covariates}, anchor by anchor; the largest: {said}"
    effect = entry.findings[0].effect
    what, key = effect.row.physics.partition(":")[0], effect.largest_size()
    if key is None:
        return f"{what} ({effect.name})"
    unit, factor = for_people(effect.unit_of(key))
    std = effect.std.get(key)
    largest = measured(factor * effect.values[key], std and factor * std, unit)
    sizes = sum(not effect.is_condition(name) for name in effect.values)
    most = f"largest of {sizes}: " if sizes > 1 else ""
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
