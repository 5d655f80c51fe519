"""What is wrong with all TDOAs, or with the ids of the anchors? Found by what fits: each mistake is
undone, and the recording says whether more of it is explained then.

A rule takes an OrderedRecording and yields Trials: that with one mistake undone, and the Finding if
that was it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.survey_faults import UNITS as SURVEY_UNITS
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.memory import TDOA, new_state, structured
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.streams import ERROR, Finding
from uwb_tdoa_ekf.streams.explain import SCALE, compare, innovations

from .ordered import LONG, SHORT, SPREAD, OrderedRecording, spread
from .pair_rules import MANY, OFF

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from uwb_tdoa_bias.foundation.anchors import Anchors
    from uwb_tdoa_bias.foundation.flight import Tdoas

    from .ordered import SurveyFit

    Survey = tuple[str, Anchors]  # its name, and what it says

RATIO, DEVIATIONS = (
    0.93,
    2.5,
)  # of what stays unexplained; healthy recordings: 1.02 at least for anything that is tried
UNITS = {  # m in one
    "nanoseconds": 0.299792458,
    "centimetres": 0.01,
    "DW1000 ticks": 0.0046917639,
    "millimetres": 0.001,
    "kilometres": 1000.0,
    "microseconds": 299.792458,
    "milliseconds": 299792.458,
    "seconds": 299792458.0,
}
NOISE, USUAL = (
    (0.02, 0.2),
    0.063,
)  # m, median difference of successive TDOAs of a pair; healthy 0.047 - 0.084
WELL = 0.4  # of the loss; healthy 0.31 at most
BY_ERRORS = 0.1**2 / (
    0.1**2 + SCALE**2
)  # of the loss: what systematic errors of 0.1 m leave unexplained
GAIN = 0.065  # of the loss by moving all anchors; healthy 0.056 at most, of measured flights
# of the loss, as surveyed: beyond what the errors of any healthy recording leave; 0.28 at most
POOR = 0.33
# share of GAIN that must be left where the other half of the recording has moved the anchors
HELD = 0.5
ALONE = 0.85  # share of the gain that one anchor explains
# windows in which the tag was located; TDOAs of an anchor that may be called by the id of another
FEWEST = 10
# m, by which TDOAs of such an anchor are off at least: anchors of a hall are farther from each
# other
APART = 1.0
CONTRARY, FAR = (
    0.7,
    0.5,
)  # share of a pair's TDOAs that fit the other sign, of those longer than that, m
MOST_PAIRS = 4  # that may be wrong by themselves
MIXED_UP = "the ids of anchors are mixed up"  # of more than two
SAME = 0.2  # m at most between the places of an anchor in two surveys of one installation


@dataclass(frozen=True)
class MistakeTrial:
    """recording : OrderedRecording with a mistake undone; finding : callable of the ratio, its
    standard errors -> Finding;
    share : of the TDOAs that it changes.
    """

    recording: OrderedRecording
    finding: Callable[[float, float], Finding]
    share: float = 1.0


def in_metres(recording: OrderedRecording) -> bool:
    """Whether the TDOAs scatter as metres do. (In nanoseconds those of a quiet radio do, too.)"""
    return NOISE[0] <= successive(recording.tdoa) <= NOISE[1]


def units(recording: OrderedRecording) -> Iterator[tuple[Finding, OrderedRecording]]:
    """In metres? The noise of the radio is known, and that a motion explains most of it. Yields
    (Finding, OrderedRecording).
    """
    noise = successive(recording.tdoa)
    if not noise > 0.0 or (
        in_metres(recording) and recording.part(LONG).unexplained(WELL).mean < WELL
    ):
        return
    near = sorted(UNITS.items(), key=lambda unit: abs(np.log(unit[1] * noise / USUAL)))[:2]
    (name, scale), (other, its) = near
    trial = recording.with_tdoa(d=recording.tdoa.d * scale)
    if (
        not NOISE[0] <= scale * noise <= NOISE[1]
        or not trial.part(LONG).unexplained(WELL).mean < WELL
    ):
        return
    evidence = (
        f"successive TDOAs of a pair differ by {noise:.3g}: {scale * noise:.2f} m as {name}, "
    )
    evidence += f"{its * noise:.2g} m as {other}; radios have 0.05 - 0.1 m"
    line = f"message.distance_difference *= {scale:.10g}"
    yield (
        Finding("tdoa_unit", ERROR, f"TDOAs are in {name}, not in metres", evidence, line, scale),
        trial,
    )


def successive(tdoa: Tdoas) -> float:
    """Median difference of successive TDOAs of a pair, in the unit of the file."""
    order = np.lexsort((tdoa.t, tdoa.b, tdoa.a))
    a, b, t, d = tdoa.a[order], tdoa.b[order], tdoa.t[order], tdoa.d[order]
    follows = (np.diff(a) == 0) & (np.diff(b) == 0) & (np.diff(t) < 0.1)
    return float(np.median(np.abs(np.diff(d))[follows])) if follows.any() else 0.0


def sign(recording: OrderedRecording) -> Iterator[MistakeTrial]:
    """All signs the other way."""
    line = "message.distance_difference = distance_to_b - distance_to_a  # not a - b"
    yield MistakeTrial(
        recording.with_tdoa(d=-recording.tdoa.d),
        _says("tdoa_sign", "the sign of all TDOAs is wrong", line),
    )


def scaled(recording: OrderedRecording) -> Iterator[MistakeTrial]:
    """The survey in another unit.

    (Where TDOAs show it at a glance, the streams have said so before.)
    """
    for name, factor in SURVEY_UNITS.items():
        cause = (
            f"the survey is in {name}, not in metres: its positions are {factor:,.5g} times too "
            "large"
        )
        line = f"x, y, z = x / {factor:.6g}, y / {factor:.6g}, z / {factor:.6g}  # of every anchor"
        anchors = recording.anchors.at(recording.anchors.positions / factor)
        yield MistakeTrial(replace(recording, anchors=anchors), _says("survey_scale", cause, line))


def survey(recording: OrderedRecording, others: Sequence[Survey]) -> Iterator[MistakeTrial]:
    """Another survey. others : [(name, Anchors)].

    Those of one installation, of different days, count as one.
    """
    while others:
        (name, anchors), *rest = others
        duplicates = [other for other, its in rest if same_place(anchors, its)]
        others = [(other, its) for other, its in rest if other not in duplicates]
        if same_place(anchors, recording.anchors):
            continue
        names = " or ".join([name, *duplicates])
        cause = f"the survey is of another room or day: {names} fits"
        yield MistakeTrial(
            replace(recording, anchors=anchors), _says("survey_other", cause, f"--survey {name}")
        )


def same_place(one: Anchors, other: Anchors) -> bool:
    """True if two Anchors have the same ids at the same places."""
    rows = other.index(one.ids)
    return len(one) == len(other) and bool((rows >= 0).all()) and furthest(one, other) < SAME


def furthest(one: Anchors, other: Anchors) -> float:
    """m between the two places of an id that two Anchors have furthest apart; infinite if they have
    none in common.
    """
    rows = other.index(one.ids)
    off = np.linalg.norm(one.positions - other.positions[rows], axis=1)[rows >= 0]
    return float(off.max()) if len(off) else np.inf


def renumbered(recording: OrderedRecording) -> Iterator[MistakeTrial]:
    """Ids that the survey does not have: the same anchors in the same order, with other numbers?"""
    heard, known = (
        np.unique(np.r_[recording.tdoa.a, recording.tdoa.b]),
        np.sort(recording.anchors.ids),
    )
    if len(heard) != len(known) or np.isin(heard, known).all():
        return
    table = dict(zip(heard.tolist(), known.tolist()))
    shift = heard[0] - known[0]
    line = f"id -= {shift}" if (heard - known == shift).all() else f"id = {table}[id]"
    cause = f"the ids of the survey are others: what the tag calls {heard[0]} ... {heard[-1]} "
    cause += f"is {known[0]} ... {known[-1]} there"
    yield MistakeTrial(relabelled(recording, table), _says("ids_renumbered", cause, line))


def swapped(recording: OrderedRecording) -> Iterator[MistakeTrial]:
    """Anchors whose ids were mixed up: the best exchange of two, then of two more, as long as more
    is explained. Not along a line: in a room that is symmetrical about it, anchors differ by their
    systematic errors alone.
    """
    if spread(recording.survey_fit.places) < SPREAD:
        return
    table: dict[int, int] = {}
    trial, brief = recording, recording.part(SHORT)
    ids = np.intersect1d(recording.anchors.ids, np.r_[recording.tdoa.a, recording.tdoa.b]).tolist()
    for _ in range(len(ids) - 1):
        doubtful = ids if len(recording.anchors) <= MANY else _far_off(brief)
        if not doubtful:
            break
        base, least, best_swap = brief.unexplained(), 1.0 - 0.02 * (1 + len(table)), {}
        for one, two in (
            (one, two) for one, two in combinations(ids, 2) if one in doubtful or two in doubtful
        ):
            swap = {one: two, two: one}
            ratio, _ = compare(base, relabelled(brief, swap).unexplained(least * base.mean))
            if ratio < least:
                least, best_swap = ratio, swap
        if not best_swap:
            break
        table = {i: best_swap.get(table.get(i, i), table.get(i, i)) for i in ids}
        table = {i: k for i, k in table.items() if i != k}
        brief, trial = relabelled(brief, best_swap), relabelled(trial, best_swap)
    if not table or (len(table) > 2 and gained(trial.survey_fit) is not None):
        # a survey of another room is explained better by exchanging many ids, and still does not
        # fit
        return
    names = ", ".join(f"{i} is {k}" for i, k in sorted(table.items()))
    cause = "the ids of two anchors are swapped" if len(table) == 2 else MIXED_UP
    yield MistakeTrial(
        trial,
        _says(
            "ids_swapped",
            f"{cause}: what is called {names}",
            f"id = {table}.get(id, id)  # or swap them in the survey",
        ),
    )


def _far_off(recording: OrderedRecording) -> list[int]:
    """Ids of the anchors whose TDOAs are far from what the filter expects, in comparison with those
    of most anchors: what is called by the id of another anchor of a hall is.
    """
    (a, b), tdoa, positions = recording.rows(), recording.tdoa, recording.anchors.positions
    off = np.abs(
        innovations(new_state(positions), structured(TDOA, tdoa.t, a, b, tdoa.d), positions)
    )
    rows = np.unique(np.concatenate([a, b])[np.tile(np.isfinite(off), 2)])  # of known anchors
    mine = [off[((a == row) | (b == row)) & np.isfinite(off)] for row in rows.tolist()]
    each = np.array([np.median(some) if len(some) >= FEWEST else 0.0 for some in mine])
    limit = max(OFF * np.median(each), APART) if len(each) else 0.0
    return recording.anchors.ids[rows[each > limit]].tolist()


def contrary(recording: OrderedRecording) -> Iterator[MistakeTrial]:
    """Single pairs with the other sign: a filter that hardly believes them knows. Or all pairs that
    name the larger id first.
    """
    tdoa = recording.tdoa
    pairs = np.unique(np.column_stack([tdoa.a, tdoa.b]), axis=0)
    backward = tdoa.a > tdoa.b
    if 0.2 < backward.mean() < 0.8:
        line = (
            "message.distance_difference = distance_to_b - distance_to_a  # in the order of the "
            "message's ids"
        )
        cause = "the sign of the TDOAs does not follow the order of the anchors"
        yield MistakeTrial(_flipped(recording, backward), _says("tdoa_one_sign", cause, line))
    wrong = _contrary(recording.part(LONG), pairs)
    if not 0 < len(wrong) <= MOST_PAIRS:
        return
    flip = np.zeros(len(tdoa), dtype=bool)
    for a, b in wrong:
        flip |= (tdoa.a == a) & (tdoa.b == b)
    trial = _flipped(recording, flip)
    if gained(trial.survey_fit) is not None:
        # of a survey of another room some pairs seem to have the other sign, and still it does not
        # fit
        return
    names = ", ".join(f"({a}, {b})" for a, b in wrong)
    line = f"if (a, b) in {{{names}}}: message.distance_difference *= -1.0  # and find out why"
    yield MistakeTrial(
        trial, _says("pair_sign", f"the sign of the pairs {names} is wrong", line), flip.mean()
    )


def _contrary(recording: OrderedRecording, pairs: np.ndarray) -> list[tuple[int, int]]:
    """The pairs, [(a, b)], most of whose TDOAs are nearer to the negative of what the filter
    predicts.
    """
    tdoa, run = (
        recording.tdoa,
        run_offline(recording.flight(), FilterConfig(use_imu=False)).residuals,
    )
    predicted = tdoa.d - run.innovation
    counted = np.isfinite(predicted) & (np.abs(tdoa.d) > FAR) & (np.abs(predicted) > FAR)
    other = np.abs(tdoa.d + predicted) < np.abs(tdoa.d - predicted)
    wrong = []
    for a, b in pairs.tolist():
        mine = counted & (tdoa.a == a) & (tdoa.b == b)
        if mine.sum() > 20 and other[mine].mean() > CONTRARY:
            wrong.append((a, b))
    return wrong


def _flipped(recording: OrderedRecording, rows: np.ndarray) -> OrderedRecording:
    return recording.with_tdoa(d=np.where(rows, -recording.tdoa.d, recording.tdoa.d))


def moved(recording: OrderedRecording) -> Iterator[MistakeTrial]:
    """An anchor that is not where the survey has it: there, TDOAs are explained that no motion
    explains otherwise.
    """
    fit = recording.survey_fit
    gain = gained(fit)
    if gain is None:
        return
    heard = fit.heard if len(recording.anchors) > MANY else range(len(recording.anchors))
    alone = {row: fit.solve([row]) for row in heard}
    row = min(alone, key=lambda row: alone[row][0])
    share = (fit.before - alone[row][0]) / gain
    if share < ALONE:
        return
    shift = alone[row][1][row] - fit.positions[row]
    number = int(recording.anchors.ids[row])
    where = ", ".join(f"{s:+.1f}" for s in shift)
    cause = f"anchor {number} is not where the survey has it, but about ({where}) m from there"
    line = (
        f"{number}: {{position: [x, y, z]}}  # measure it again; look for exchanged digits and axes"
    )
    anchors = recording.anchors.at(alone[row][1])
    yield MistakeTrial(replace(recording, anchors=anchors), _says("anchor_moved", cause, line))


def gained(fit: SurveyFit) -> float | None:
    """How much less stays unexplained with all anchors moved; None if that is no more than in a
    healthy recording, or if anchors that one half of the recording has moved do not fit the other
    half, and errors of the TDOAs can explain it as well.
    """
    gain = apparent_gain(fit)
    return gain if gain > GAIN and (fit.before > POOR or fit.held_out_gain > HELD * GAIN) else None


def apparent_gain(fit: SurveyFit) -> float:
    """The same without a look at both halves; 0.0 of too few windows."""
    return fit.before - fit.all_moved[0] if len(fit) >= FEWEST else 0.0


def best(
    recording: OrderedRecording, others: Sequence[Survey] = ()
) -> tuple[Finding | None, OrderedRecording]:
    """(Finding, OrderedRecording with it undone), or (None, recording): of all that can be tried,
    what explains the most, if it is certain, and more than systematic errors could: along a line,
    in a room that is symmetrical about it, swapped ids differ by these alone.

    Smaller TDOAs are always explained better: another unit is believed at once where the noise
    speaks against metres, and else only where nothing different helps.
    """
    if not in_metres(recording):
        for found in units(recording):
            return found
    base, trials = recording.part(LONG).unexplained(), []
    for rule in (sign, scaled, renumbered, swapped, contrary, moved, lambda c: survey(c, others)):
        for trial in rule(recording):
            most = min(RATIO * base.mean, base.mean - BY_ERRORS * trial.share)
            other = trial.recording.part(LONG).unexplained(most)
            ratio, z = compare(base, other)
            if ratio < RATIO and z > DEVIATIONS and other.mean < most:
                trials.append((ratio, z, trial))
    if trials:
        ratio, z, trial = min(trials, key=lambda entry: entry[0])
        return trial.finding(ratio, z), trial.recording
    return next(units(recording), (None, recording))


def _says(rule: str, cause: str, line: str) -> Callable[[float, float], Finding]:
    def finding(ratio: float, z: float) -> Finding:
        evidence = (
            f"{100.0 * (1.0 - ratio):.0f} % less stays unexplained then, {z:.1f} standard errors"
        )
        return Finding(rule, ERROR, cause, evidence, line, ratio)

    return finding


def relabelled(recording: OrderedRecording, table: dict[int, int]) -> OrderedRecording:
    """Ids replaced as the dict `table` says, all at once."""
    columns = {}
    for name, ids in (("a", recording.tdoa.a), ("b", recording.tdoa.b)):
        columns[name] = ids.copy()
        for one, two in table.items():
            columns[name][ids == one] = two
    return recording.with_tdoa(**columns)
