# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find mistakes of all TDOAs, or of the ids of anchors: undo each mistake, and compare the fit.

A rule takes an OrderedRecording and yields trials, each with one mistake undone, and the Finding to
report if that explains much more.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from uwb_tdoa_bias.common.anchors import UNITS as SURVEY_UNITS, Anchors
from uwb_tdoa_bias.common.flight import Tdoas
from uwb_tdoa_bias.common.radio import SPEED_OF_LIGHT, TICK
from uwb_tdoa_bias.effects.anchor import replaced
from uwb_tdoa_ekf.monitoring.explain import SCALE, compare
from uwb_tdoa_ekf.monitoring.finding import ERROR, Finding
from uwb_tdoa_ekf.monitoring.judge import Judge, exchanged, wrong_scale, wrong_sign
from uwb_tdoa_ekf.monitoring.stream_rules import StreamRules

from .ordered import (
    LEAST_MOTION,
    LONG,
    SHORT,
    OrderedRecording,
    SurveyFit,
    Trial,
    displacement,
    second_principal_std,
)
from .pair_rules import MANY, OFF

Survey = tuple[str, Anchors]  # its name, and what it says

# ratio of the remaining loss, and its standard errors; healthy recordings: 1.02 at least in any
# trial
RATIO, DEVIATIONS = 0.93, 2.5
UNITS = {  # m in one
    "nanoseconds or in feet": SPEED_OF_LIGHT / 1e9,  # a foot is 1.017 ns
    "centimetres": 0.01,
    "DW1000 ticks": TICK,
    "millimetres": 0.001,
    "kilometres": 1000.0,
    "microseconds": SPEED_OF_LIGHT / 1e6,
    "milliseconds": SPEED_OF_LIGHT / 1e3,
    "seconds": SPEED_OF_LIGHT,
}
# m, median difference of successive TDOAs of a pair: limits, and usual; healthy 0.047 - 0.084
NOISE, USUAL = (0.02, 0.2), 0.063
WELL = 0.4  # loss below which a motion explains the TDOAs; healthy 0.31 at most
BY_ERRORS = 0.1**2 / (0.1**2 + SCALE**2)  # loss that systematic errors of 0.1 m cause
GAIN = 0.065  # fall of the loss by moving all anchors; measured healthy flights 0.064 at most
# loss as surveyed below which no more than two ids are mixed up: three or more leave 0.27 at least, but
# for one of 56; the survey of another room, whose anchors another order may resemble, 0.24 at most
MIXED = 0.25
# m, median by which anchors still move then: 0.75 at most if the order is right, 1.1 to 2.2 if the
# survey is of another simulated room with corners elsewhere
OFF_AT_MOST = 1.0
POOR = 0.33  # loss as surveyed beyond that of any healthy recording, which is 0.28 at most
# fall of the loss with anchors fitted to the other half; measured healthy flights 0.052 at most,
# surveys of other rooms 0.063 at least. In a recording shorter than ENOUGH, s, the tag sees a part
# of the room, and other anchors describe the systematic errors there: healthy pieces 0.083 at most.
# Below SHORTEST, s, the survey is not judged: of 17 healthy pieces of 1.2 s 3 were blamed, of 2 s none.
HELD, HELD_OF_SHORT, ENOUGH, SHORTEST = 0.06, 0.09, 30.0, 3.0
HELD_OF_TRIAL = 0.03  # the same after a correction: if more is left, the survey may be the mistake
# largest loss of errors that depend on the place, over that with the anchors moved: behind a body
# 0.55, in measured flights with anchors elsewhere 0.94 at least
AS_RADIO = 0.9
# least share of the loss with delays that the rivals leave: three late anchors 0.95 (simulated), where
# nothing else is wrong, and 0.75 to 0.91 (measured); the survey of another day 0.90 at most
AS_LATE = 0.93
ALONE = 0.85  # share of the gain that one anchor explains, or delays do
# the same of the gain with a delay of each anchor. Where ALONE holds, one moved anchor explains 0.92 at
# least, and one in place of two or three late ones 0.90 at most (one of 15 simulated recordings: 0.98).
BESIDE_DELAYS = 0.91
# windows with a position; TDOAs of an anchor that may have the id of another; successive TDOAs
FEWEST = 10
APART = 1.0  # m, least error of such an anchor: anchors of a hall are farther from each other
CONTRARY, FAR = 0.7, 0.5  # share of a pair's TDOAs longer than FAR, m, that fit the other sign
MOST_PAIRS = 4  # pairs that may have a wrong sign each
SAME = 0.2  # m at most between the places of an anchor in two surveys of one installation


def in_metres(recording: OrderedRecording) -> bool:
    """Return whether the TDOAs scatter as metres do. TDOAs of a quiet radio in nanoseconds do so too."""
    return NOISE[0] <= successive_difference(recording.tdoa) <= NOISE[1]


def other_unit(recording: OrderedRecording) -> tuple[Finding, OrderedRecording] | None:
    """Return (Finding, OrderedRecording in metres) if the TDOAs have another unit, or None.

    The noise of the radio is known, and a motion must explain most of the TDOAs.
    """
    noise = successive_difference(recording.tdoa)
    # small TDOAs are explained wherever they come from, large ones only in metres
    if not noise > 0.0 or (noise >= NOISE[0] and is_explained(recording)):
        return None
    near = sorted(UNITS.items(), key=lambda unit: abs(np.log(unit[1] * noise / USUAL)))[:2]
    (name, scale), (other, its) = near
    trial = recording.with_tdoa(d=recording.tdoa.d * scale)
    if not NOISE[0] <= scale * noise <= NOISE[1] or not is_explained(trial):
        return None
    found = Finding(
        "tdoa_unit",
        ERROR,
        cause=f"TDOAs are in {name}, not in metres",
        evidence=(
            f"successive TDOAs of a pair differ by {noise:.3g}: {scale * noise:.2f} m if in {name}, "
            f"{its * noise:.2g} m if in {other}; radios have 0.05 - 0.1 m"
        ),
        remedy=f"message.distance_difference *= {scale:.10g}"
        + "  # of nanoseconds; of feet 0.3048" * ("feet" in name),
        value=scale,
    )
    return found, trial


def is_explained(recording: OrderedRecording, most: float = WELL) -> bool:
    """Return whether a motion explains the TDOAs but for a loss of `most`, also a fast motion."""
    return recording.part(LONG).unexplained(most).mean < most


def successive_difference(tdoa: Tdoas) -> float:
    """Return the median difference of successive TDOAs of a pair, in the unit of the file, 0 for few."""
    order = np.lexsort((tdoa.t, tdoa.b, tdoa.a))
    a, b, t, d = tdoa.a[order], tdoa.b[order], tdoa.t[order], tdoa.d[order]
    follows = (np.diff(a) == 0) & (np.diff(b) == 0) & (np.diff(t) < 0.1)
    enough = np.count_nonzero(follows) >= FEWEST
    return float(np.median(np.abs(np.diff(d))[follows])) if enough else 0.0


def judged(recording: OrderedRecording) -> Iterator[Trial]:
    """Yield the trials with the other sign, and with the other ids that the Judge prefers.

    Ids are not tried for motion along a line: in a room that is symmetrical about it, anchors differ
    by their systematic errors alone.
    """
    yield Trial(recording.with_tdoa(d=-recording.tdoa.d), wrong_sign(""))
    table, fit = judge_of(recording).order, recording.survey_fit
    if not table or second_principal_std(fit.places) < LEAST_MOTION:
        return
    other = relabelled(recording, table)
    if len(table) > 2:
        off = displacement(fit.positions, other.survey_fit.all_moved[1])
        if fit.before < MIXED or np.median(off) > OFF_AT_MOST:
            return
    yield Trial(other, exchanged(table, ""))


def judge_of(recording: OrderedRecording) -> Judge:
    """Return the Judge of the part of a recording in which the tag moves most."""
    brief, doubtful = recording.part(LONG), None
    if len(recording.anchors) > MANY:
        doubtful = recording.anchors.index(_far_off(recording.part(SHORT))).tolist()
    streams = StreamRules(brief.anchors)
    streams.judge = Judge(brief.anchors, None, doubtful)
    tdoa = brief.tdoa
    streams.feed_tdoa(tdoa.t, np.full(len(tdoa), np.nan), tdoa.a, tdoa.b, tdoa.d)
    streams.finish()
    return streams.judge


def scaled_survey(recording: OrderedRecording) -> Iterator[Trial]:
    """Yield trials with the survey in another unit, unless the anchors lie in a plane.

    (If the TDOAs show it directly, the rules of streams have reported it before.) Beside a plane a
    smaller survey with a tag outside explains more than the right one.
    """
    if recording.survey_fit.flat:
        return
    for name, factor in SURVEY_UNITS.items():
        yield Trial(recording.scaled(factor), wrong_scale(name, factor, ""))


def other_survey(recording: OrderedRecording, others: Sequence[Survey]) -> Iterator[Trial]:
    """Yield trials with other surveys, [(name, Anchors)].

    Surveys of one installation on different days count as one.
    """
    while others:
        (name, anchors), *rest = others
        duplicates = [other for other, its in rest if same_place(anchors, its)]
        others = [(other, its) for other, its in rest if other not in duplicates]
        if same_place(anchors, recording.anchors):
            continue
        names = " or ".join([name, *duplicates])
        yield Trial(
            replace(recording, anchors=anchors),
            Finding(
                "survey_other",
                ERROR,
                cause=f"the survey is of another room or day: {names} fits",
                evidence="",
                remedy=f"--survey {name}",
                value=np.nan,
            ),
        )


def same_place(one: Anchors, other: Anchors) -> bool:
    """Return whether two Anchors have the same ids at the same places."""
    rows = other.index(one.ids)
    return (
        len(one) == len(other)
        and bool((rows >= 0).all())
        and largest_displacement(one, other) < SAME
    )


def largest_displacement(one: Anchors, other: Anchors) -> float:
    """Return the largest distance between the two places of an id, m; infinite without a common id."""
    rows = other.index(one.ids)
    off = np.linalg.norm(one.positions - other.positions[rows], axis=1)[rows >= 0]
    return float(off.max()) if len(off) else np.inf


def renumbered_ids(recording: OrderedRecording) -> Iterator[Trial]:
    """Yield the trial with renumbered ids: the same anchors in the same order, with other numbers."""
    heard = np.unique(np.r_[recording.tdoa.a, recording.tdoa.b])
    known = np.sort(recording.anchors.ids)
    if len(heard) != len(known) or np.isin(heard, known).all():
        return
    table = dict(zip(heard.tolist(), known.tolist()))
    shift = heard[0] - known[0]
    yield Trial(
        relabelled(recording, table),
        Finding(
            "ids_renumbered",
            ERROR,
            cause=(
                f"the ids of the survey are others: what the tag calls {heard[0]} ... {heard[-1]} "
                f"is {known[0]} ... {known[-1]} there"
            ),
            evidence="",
            remedy=f"id -= {shift}" if (heard - known == shift).all() else f"id = {table}[id]",
            value=np.nan,
        ),
    )


def _far_off(recording: OrderedRecording) -> np.ndarray:
    """Return the ids of anchors with much larger innovations than most: their ids may be exchanged."""
    (a, b), off = recording.rows(), np.abs(recording.innovations())
    rows = np.unique(np.concatenate([a, b])[np.tile(np.isfinite(off), 2)])  # of known anchors
    mine = [off[((a == row) | (b == row)) & np.isfinite(off)] for row in rows.tolist()]
    each = np.array([np.median(some) if len(some) >= FEWEST else 0.0 for some in mine])
    limit = max(OFF * np.median(each), APART) if len(each) else 0.0
    return recording.anchors.ids[rows[each > limit]]


def inverted_pairs(recording: OrderedRecording) -> Iterator[Trial]:
    """Yield trials with the sign of single pairs inverted, or of all pairs with the larger id first."""
    tdoa = recording.tdoa
    pairs = np.unique(np.column_stack([tdoa.a, tdoa.b]), axis=0)
    backward = tdoa.a > tdoa.b
    if 0.2 < backward.mean() < 0.8:
        yield Trial(
            _flipped(recording, backward),
            Finding(
                "tdoa_one_sign",
                ERROR,
                cause="the sign of the TDOAs does not follow the order of the anchors",
                evidence="",
                remedy=(
                    "message.distance_difference = distance_to_b - distance_to_a  # in the order "
                    "of the message's ids"
                ),
                value=np.nan,
            ),
        )
    wrong = _contrary(recording.part(LONG), pairs)
    if not 0 < len(wrong) <= MOST_PAIRS or recording.survey_fit.flat:
        return
    flip = np.zeros(len(tdoa), dtype=bool)
    for a, b in wrong:
        flip |= (tdoa.a == a) & (tdoa.b == b)
    other = _flipped(recording, flip)
    if still_gains(other.survey_fit):
        # With a survey of another room some pairs seem to have the other sign, and it does not fit.
        return
    names = ", ".join(f"({a}, {b})" for a, b in wrong)
    remedy = f"if (a, b) in {{{names}}}: message.distance_difference *= -1.0  # and find out why"
    cause = f"the sign of the pairs {names} is wrong"
    found = Finding("pair_sign", ERROR, cause, "", remedy, np.nan)
    yield Trial(other, found, share=flip.mean())


def _contrary(recording: OrderedRecording, pairs: np.ndarray) -> list[tuple[int, int]]:
    """Return the pairs, [(a, b)], most of whose TDOAs are nearer to the negative of the prediction."""
    tdoa = recording.tdoa
    predicted = tdoa.d - recording.innovations()
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


def moved_anchor(recording: OrderedRecording) -> Iterator[Trial]:
    """Yield the trial with one anchor moved to where the TDOAs are explained.

    There is none if the survey may be right, or if all anchors moved, or late, explain much more than
    one.
    """
    fit = recording.survey_fit
    gain = gained(fit)
    if gain is None:
        return
    tried = fit.heard if len(recording.anchors) > MANY else range(len(recording.anchors))
    solved = {row: fit.solve([row]) for row in tried}  # (loss, positions) with this anchor moved
    row = min(solved, key=lambda row: solved[row][0])
    loss, positions = solved[row]
    if fit.before - loss < max(ALONE * gain, BESIDE_DELAYS * (fit.before - fit.late_loss)):
        return
    number = int(recording.anchors.ids[row])
    shift = ", ".join(f"{s:+.1f}" for s in positions[row] - fit.positions[row])
    yield Trial(
        replace(recording, anchors=recording.anchors.at(positions)),
        Finding(
            "anchor_moved",
            ERROR,
            cause=f"anchor {number} is not where the survey has it, but about ({shift}) m from there",
            evidence="",
            remedy=(
                f"{number}: {{position: [x, y, z]}}  # measure it again; look for exchanged digits "
                "and axes"
            ),
            value=np.nan,
        ),
    )


def gained(fit: SurveyFit) -> float | None:
    """Return by how much the loss falls with all anchors moved, or None if the survey may be right.

    The survey may be right if the gain is no larger than in a healthy recording. Anchors fitted to one
    half must also fit the other half, unless the loss exceeds that of any healthy recording. They
    must fit it better if the recording is short. The radio may explain it better: errors that depend
    on the place. Anchors and tag in one plane determine nothing across it. If the tag alone moves in
    one, moved anchors must beat the radio.
    """
    gain = apparent_gain(fit)
    least = HELD if fit.seconds >= ENOUGH else HELD_OF_SHORT
    if gain <= GAIN:
        return None
    as_radio = 1.0 / AS_RADIO if fit.thin else AS_RADIO
    if fit.radio_loss < as_radio * fit.all_moved[0]:
        return None
    poor = fit.before > POOR and len(fit.positions) <= MANY
    return gain if poor or (not fit.flat and fit.held_out_gain > least) else None


def is_of_delays(fit: SurveyFit) -> bool:
    """Return whether delays explain as much as moved anchors and errors that depend on the place.

    Those have three and four times as many unknowns.
    """
    explained = apparent_gain(fit) > GAIN and not fit.flat
    return explained and min(fit.all_moved[0], fit.radio_loss) > AS_LATE * fit.late_loss


def is_of_radio(fit: SurveyFit) -> bool:
    """Return whether errors that depend on the place explain more than all anchors moved.

    With the survey of another room they may, too. Fitted to one half they must also fit the other.
    """
    least = max(HELD, fit.held_out_gain)
    return fit.radio_loss < AS_RADIO * fit.all_moved[0] and fit.held_out_gain_of_radio > least


def still_gains(fit: SurveyFit) -> bool:
    """Return whether anchors elsewhere may explain more than a correction of the TDOAs did.

    Less evidence suffices than for `gained`: signs and ids are not blamed for a wrong survey.
    """
    return apparent_gain(fit) > GAIN and (fit.before > POOR or fit.held_out_gain > HELD_OF_TRIAL)


def apparent_gain(fit: SurveyFit) -> float:
    """Return the same without a comparison of both halves; 0.0 for too few windows or seconds."""
    return fit.before - fit.all_moved[0] if len(fit) >= FEWEST and fit.seconds >= SHORTEST else 0.0


def best_trial(
    recording: OrderedRecording, others: Sequence[Survey] = ()
) -> tuple[Finding | None, OrderedRecording]:
    """Return (Finding, OrderedRecording with it undone), or (None, recording).

    It is the trial that explains most, if it is significant and gains more than systematic errors can.
    Smaller TDOAs are always explained better. So another unit is accepted at once only if the noise
    contradicts metres, else only if no other trial helps.
    """
    if not in_metres(recording):
        unit = other_unit(recording)
        if unit is not None:
            return unit
    base, trials = recording.part(LONG).unexplained(), []
    for rule in (
        judged,
        scaled_survey,
        renumbered_ids,
        inverted_pairs,
        moved_anchor,
        lambda c: other_survey(c, others),
    ):
        for trial in rule(recording):
            most = min(RATIO * base.mean, base.mean - BY_ERRORS * trial.share)
            other = trial.recording.part(LONG).unexplained(most)
            ratio, z = compare(base, other)
            if ratio < RATIO and z > DEVIATIONS and other.mean < most:
                trials.append((ratio, z, trial))
    if trials:
        ratio, z, trial = min(trials, key=lambda entry: entry[0])
        return trial.explained(ratio, z), trial.recording
    return other_unit(recording) or (None, recording)


def relabelled(recording: OrderedRecording, table: dict[int, int]) -> OrderedRecording:
    """Return the recording with ids replaced by the dict `table`, all at once."""
    a, b = (replaced(ids, table) for ids in (recording.tdoa.a, recording.tdoa.b))
    return recording.with_tdoa(a=a, b=b)
