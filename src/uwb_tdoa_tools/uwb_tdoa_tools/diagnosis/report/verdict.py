# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""State the verdict: the error before and after, the data, and the uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from uwb_tdoa_bias.effects.base import listed

from ...scoring.gains import NO_DIFFERENCE, difference
from ...scoring.phases import TITLES
from ..self_calibration.solve import CLEARLY, CLEARLY_OF_RANGES, LEFT
from .left_over import left_over
from .reasons import reasons

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from uwb_tdoa_ekf.monitoring.finding import Finding as NumbersFinding

    from ..result import Diagnosis

CM = 100.0  # cm per metre
MOST_NAMES = 6  # largest number of named flights
ERROR = "The position error (3D RMSE)"


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
    if diagnosis.after["pooled"].get("rmse_3d") is None:
        return _without_truth(diagnosis)
    if not any(finding.added for finding in diagnosis.findings):
        return _nothing_added(diagnosis)
    return _with_errors(diagnosis)


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


def _share(value: float) -> str:
    return f"{value * 100:.0f} %"


def _bounds(interval: Sequence[float] | None) -> str:
    return f"{interval[0] * CM:.1f} to {interval[1] * CM:.1f}" if interval else "unknown"


def _with_errors(diagnosis: Diagnosis) -> Verdict:
    before, after = diagnosis.before["pooled"], diagnosis.after["pooled"]
    gain, interval = 1.0 - after["rmse_3d"] / before["rmse_3d"], after.get("rmse_3d_gain_ci")
    change = f"from {centimetres(before['rmse_3d'])} to {centimetres(after['rmse_3d'])}"
    more = [
        _intervals(before, after, interval),
        f"Judged on {diagnosis.judged_on}: {_flights(diagnosis)}; {_named(diagnosis)}.",
        *reasons(diagnosis),
        *_worse_phases(diagnosis),
        *_with_noise(diagnosis),
        *_over_phases(diagnosis),
        *_shared(diagnosis),
        *_caveats(diagnosis),
        *_worse(diagnosis),
        *_diverged(diagnosis),
        *left_over(diagnosis),
    ]
    if all(finding.on_floor for finding in diagnosis.findings if finding.added):
        stays = (
            f"{ERROR} stays {centimetres(after['rmse_3d'])}: what is added acts near the floor "
            "alone, where the filter weighs it."
        )
        return Verdict(stays, tuple(more), "same")
    if interval and interval[0] > 0.0:
        return Verdict(
            f"{ERROR} falls {change}: {_share(gain)} of it is gone.", tuple(more), "better"
        )
    more.append(
        "More flights to judge on (--holdout) make that certain; until then compare before "
        "relying on effects.yaml."
    )
    if interval and interval[1] < 0.0:
        return Verdict(f"{ERROR} rises {change}.", tuple(more), "unsure")
    return Verdict(
        f"There is {NO_DIFFERENCE}: the position error (3D RMSE) goes {change}.",
        tuple(more),
        "unsure",
    )


def _intervals(before: dict[str, Any], after: dict[str, Any], gain: Sequence[float] | None) -> str:
    sides = [
        f"{_bounds(side['rmse_3d_ci'])} cm {name}"
        for side, name in ((before, "before"), (after, "after"))
    ]
    share = 1.0 - after["rmse_3d"] / before["rmse_3d"]
    return (
        f"95 % intervals: {', '.join(sides)}; gain {_share(share)} ({percent(gain)})."
        if gain
        else f"95 % intervals: {', '.join(sides)}."
    )


def _nothing_added(diagnosis: Diagnosis) -> Verdict:
    pooled, found = diagnosis.before["pooled"], len({finding.key for finding in diagnosis.findings})
    interval = f"95 % interval {_bounds(pooled['rmse_3d_ci'])} cm"
    data = f"{_flights(diagnosis)}; {_named(diagnosis)}"
    error = f"{ERROR} is {centimetres(pooled['rmse_3d'])}, {interval}: {data}."
    more = (
        error,
        *(f"Not added: {item.why}." for item in diagnosis.refused if item.what == "all"),
        *_with_noise(diagnosis),
        *_over_phases(diagnosis),
        *_shared(diagnosis),
        *_diverged(diagnosis),
        *left_over(diagnosis),
    )
    if not found:
        return Verdict(
            "Nothing was found: what the model leaves of the measurements looks like noise.",
            more,
            "nothing",
        )
    what = (
        "One effect was found, but taking it out does"
        if found == 1
        else f"{found} effects were found, but taking them out does"
    )
    return Verdict(
        f"{what} not make the position better; nothing is added to the model.", more, "same"
    )


def _without_truth(diagnosis: Diagnosis) -> Verdict:
    before, after = (
        side["pooled"]["residual_spread"] for side in (diagnosis.before, diagnosis.after)
    )
    measured = "TDOAs" if any(len(flight.tdoa) for flight in diagnosis.flights) else "ranges"
    scatter = f"Innovations (measured minus predicted {measured}) scatter by {centimetres(before)}"
    if not diagnosis.findings:
        headline = "Nothing was found: what the model leaves of the measurements looks like noise."
        return Verdict(headline, (_UNKNOWN, f"{scatter}."), "nothing")
    if not any(finding.added for finding in diagnosis.findings):
        headline = (
            "Nothing of what was found is added to the model: nobody can tell whether it would "
            "help the position."
        )
        decided = diagnosis.refused[len(diagnosis.attribution.refused) :]
        why = tuple(f"Not added, {item.what}: {item.why}." for item in decided)
        return Verdict(headline, (_UNKNOWN, *why, f"{scatter}."), "unknown")
    headline = (
        "What was found makes measurements agree better; what that is worth for the position is "
        "unknown."
    )
    limit = (
        f"not above {100 * LEFT:.1f} cm, or {CLEARLY:g} times smaller than it was, limits that "
        "were set on measured flights"
        if measured == "TDOAs"
        else f"{CLEARLY_OF_RANGES:g} times smaller than it was, a limit that was set on simulated "
        "flights"
    )
    validated = (
        "It is added because what is slow in the innovations becomes small: what it leaves is "
        f"{limit}."
    )
    change = f"{scatter} before and {centimetres(after)} after, on {diagnosis.judged_on}."
    return Verdict(headline, (_UNKNOWN, validated, change), "unknown")


_UNKNOWN = "Without ground truth nobody knows the position error, neither before nor after."


def _names(diagnosis: Diagnosis) -> list[str]:
    """Return the names of the judged flights, each once."""
    return list(dict.fromkeys(run["flight"] for run in diagnosis.before["runs"]))


def _flights(diagnosis: Diagnosis) -> str:
    ends: dict[
        str, list[float]
    ] = {}  # first and last stamp per flight, since judged parts of a flight alternate
    for score in diagnosis.before["scores"]:
        ends.setdefault(score.name, []).extend([score.first, score.last])
    count, seconds = len(_names(diagnosis)), sum(max(of) - min(of) for of in ends.values())
    parts = " or ".join(sorted({TITLES[score.part] for score in diagnosis.before["scores"]}))
    return f"{count} flight{'s' if count > 1 else ''}, {seconds:.0f} s {parts}"


def _named(diagnosis: Diagnosis) -> str:
    """Return the names of the judged flights, the first few of many."""
    names = _names(diagnosis)
    rest = len(names) - MOST_NAMES
    return listed(names) if rest <= 0 else f"{', '.join(names[:MOST_NAMES])} and {rest} more"


def _worse_phases(diagnosis: Diagnosis) -> list[str]:
    """Return a sentence on phases in which the error grows."""
    worse = list(worse_phases(diagnosis.before["pooled"], diagnosis.after["pooled"]))
    return [f"Worse: {'; '.join(worse)}."] if worse else []


def _with_noise(diagnosis: Diagnosis) -> list[str]:
    """Return a sentence on the error with all files as they are written."""
    if diagnosis.written is None or diagnosis.tdoa_std is None:
        return []
    before, after = diagnosis.before["pooled"], diagnosis.written["pooled"]
    worse = list(worse_phases(before, after))
    also = f"; worse: {'; '.join(worse)}" if worse else ""
    return [
        f"With tdoa_std {diagnosis.tdoa_std:.3f} m of ekf_node.yaml too it is "
        f"{centimetres(after['rmse_3d'])}{also}."
    ]


def _over_phases(diagnosis: Diagnosis) -> list[str]:
    """Return a sentence on errors in the other phases, which the first sentence leaves out."""
    before, after = (
        side["pooled"].get("phases", {}) for side in (diagnosis.before, diagnosis.after)
    )
    parts, judged = [], {score.part for score in diagnosis.before["scores"]}
    for name in (name for name in TITLES if name in before and name not in judged):
        sides = [_of_phase(side[name]) for side in (before, after)]
        parts.append(f"{TITLES[name]} {' to '.join(dict.fromkeys(sides))}")
    return [f"Outside of that, before and after: {'; '.join(parts)}."] if parts else []


def worse_phases(before: dict[str, Any], after: dict[str, Any]) -> Iterator[str]:
    """Yield one clause per phase in which the error grows.

    before, after : pooled figures of a side of `compare`
    """
    sides = before.get("phases", {}), after.get("phases", {})
    for name in (name for name in TITLES if name in sides[0] and name in sides[1]):
        first, second = (side[name] for side in sides)
        known = first["rmse_3d"] is not None and second["rmse_3d"] is not None
        if known and difference(first["rmse_3d"], second["rmse_3d"]) < 0:
            yield f"{TITLES[name]} from {_of_phase(first)} to {_of_phase(second)}"


def _of_phase(figures: dict[str, Any]) -> str:
    """Return the 3D RMSE and the NEES of a phase, as text."""
    if figures["rmse_3d"] is None:
        return "unknown"
    return centimetres(figures["rmse_3d"]) + (
        "" if figures["nees_mean"] is None else f" (NEES {figures['nees_mean']:.1f})"
    )


def _shared(diagnosis: Diagnosis) -> list[str]:
    """Return a caveat if the reference knows only a part of the path."""
    if all(diagnosis.reference.positions_known):
        return []
    return [
        f"Errors are against {diagnosis.reference.words}: an error that both share is not in them."
    ]


def _caveats(diagnosis: Diagnosis) -> list[str]:
    out, base = [], len(diagnosis.effects) - sum(finding.added for finding in diagnosis.findings)
    if base > 0:
        out.append(
            f"Before is with the {base} effect{'s' if base > 1 else ''} that the model held "
            "already."
        )
    if set(_names(diagnosis)) & {flight.name for flight in diagnosis.flights}:
        out.append(
            "Which effects to add was decided on these same flights; flights given as "
            "--holdout judge that too."
        )
    if len(_names(diagnosis)) == 1:
        out.append("One flight does not tell how much flights differ.")
    return out


def _worse(diagnosis: Diagnosis) -> list[str]:
    runs = list(zip(diagnosis.before["runs"], diagnosis.after["runs"]))
    worse = [
        (b["rmse_3d"], a["rmse_3d"], b["flight"]) for b, a in runs if a["rmse_3d"] > b["rmse_3d"]
    ]
    if not worse or len(runs) == 1:
        return []
    before, after, name = max(worse, key=lambda run: run[1] - run[0])
    much = f"most on {name}, from {centimetres(before)} to {centimetres(after)}"
    return [f"On {len(worse)} of {len(runs)} runs the error grows, {much}."]


def _diverged(diagnosis: Diagnosis) -> list[str]:
    before, after = (
        sum(run["diverged"] for run in side["runs"]) for side in (diagnosis.before, diagnosis.after)
    )
    if not before and not after:
        return []
    return [f"Of {len(diagnosis.before['runs'])} runs, {before} diverged before and {after} after."]
