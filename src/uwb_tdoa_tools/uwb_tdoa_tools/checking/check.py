# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Apply all rules to one recording, in the order in which one mistake hides another."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.sensors import SENSORS, Ranges
from uwb_tdoa_ekf.monitoring.finding import (
    ERROR,
    NOTE,
    WARNING,
    WRONG_WITH_IMU,
    Finding,
    explained_by,
    most_severe_first,
)
from uwb_tdoa_ekf.monitoring.stream_rules import StreamRules

from ..estimate import FlightEstimator
from ..readers.streams import protocol
from . import coverage, imu_rules, motion_rules, recording_rules, tdoa_rules
from .ordered import OrderedRecording, SurveyFit, differences, displacement
from .pair_rules import MANY
from .sensor_rules import judge_sensors
from .tdoa_rules import SAME, largest_displacement
from .watch import found_by_monitor, together

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from uwb_tdoa_bias.common.flight import Flight

    from ..live.session import End
    from .recording import Recording
    from .tdoa_rules import Survey

FEWEST_PAIRS = 1000  # of successive ranges, for a trial without TDOAs
ROUNDS = 3  # mistakes that are undone one after the other
# After one of these findings no correction, or none of the IMU, can be tried.
NOTHING_TO_TRY = {
    "stamps_zero",
    "stamps_stand",
    "stamps_unit",
    "stamps_jump",
    "two_tags",
    "few_anchors",
    "senders",
    "tdoa_clipped",
    "tdoa_frozen",
    "anchor_scale",
}
WITHOUT_IMU = {
    "imu_silent",
    "imu_in_turns",
    "imu_no_gravity",
    "imu_axis_dead",
    "imu_tilted",
    "imu_clipped",
}
# After one of these findings the recorded attitude shows nothing else.
OF_IMU = WITHOUT_IMU | WRONG_WITH_IMU
OTHER_SURVEY = (
    "give --survey a folder of all surveys: check says which one fits; or survey the anchors again"
)
# Findings that a survey of another room causes. Each explains a part, and with it undone the survey
# still does not fit.
BLAMED = {
    "tdoa_sign",
    "ids_exchanged",
    "pair_sign",
    "tdoa_one_sign",
    "anchor_moved",
    "survey_scale",
}
# Findings of the streams that trials find again, in comparison with more rivals.
JUDGED = {"tdoa_sign", "ids_exchanged"}
# Findings of the streams that another finding explains.
EXPLAINS = {
    "tdoa_unit": {"tdoa_unit", "tdoa_large", "tdoa_outliers", "tdoa_rounded", "survey_scale"},
    "ids_renumbered": {"ids_unknown", "anchor_missing"},
    "ids_exchanged": {"tdoa_large", "tdoa_outliers"},
    "survey_other": {"tdoa_large", "tdoa_outliers"},
    "survey_misfit": {"tdoa_large", "tdoa_outliers"},
    "anchors_late": {"tdoa_large", "tdoa_outliers"},
    "tdoa_one_sign": {"tdoa_one_sign"},
    "survey_scale": {"tdoa_large", "tdoa_outliers"},
}


@dataclass(frozen=True)
class Report:
    """Result of `check`.

    Attributes
    ----------
    recording : str
        Name of the recording.
    findings : list of Finding
        Most severe first.
    facts : dict
        {quantity: text}: rates, duration, anchors, protocol.
    ends : tuple of End
        Publishers and subscriptions of live topics.
    """

    recording: str
    findings: list[Finding]
    facts: dict[str, str]
    ends: tuple[End, ...] = ()

    @property
    def faulty(self) -> bool:
        """Return whether there is an error."""
        return any(finding.severity == ERROR for finding in self.findings)


def check(
    recording: Recording,
    others: Sequence[Survey] = (),
    estimator: FlightEstimator = FlightEstimator(),
    line: str | None = None,
) -> Report:
    """Return the Report of a Recording.

    Parameters
    ----------
    recording : Recording
        The streams.
    others : sequence of (name, Anchors)
        Other surveys that may fit.
    estimator : FlightEstimator
        Estimator with the calibrated effects.
    line : str or None
        Command line that surveys the anchors with the recording.
    """
    estimator = replace(estimator, smoothed=False)
    streams = processed_streams(recording)
    found = streams.findings()
    for rule in recording_rules.RULES:
        found += rule(recording)
    found = _without(found, explained_by(found, {"clock_silence": {"gap"}}))
    if len(recording.tdoa):
        found = _with_trials(recording, streams, found, others, estimator, line)
    else:
        found += _tried_with_ranges(recording, found, estimator)
    if not OF_IMU & {finding.rule for finding in found}:
        found += motion_rules.judge_imu(recording, stamps=False)
    found += motion_rules.truth_unit(recording)
    return Report(
        recording.name, most_severe_first(found), _facts(recording, streams), recording.ends
    )


def _tried_with_ranges(
    recording: Recording, found: list[Finding], estimator: FlightEstimator
) -> list[Finding]:
    """Return findings about inertial sensor, survey and ranges of a Recording without TDOAs.

    Two successive ranges make a TDOA. Other corrections cannot be tried with ranges alone.

    found : findings of the streams
    """
    ranges = recording.sensors.get("range")
    names = {finding.rule for finding in found}
    if not isinstance(ranges, Ranges) or names & (NOTHING_TO_TRY | WITHOUT_IMU):
        return []
    paired = OrderedRecording.of(replace(recording, tdoa=differences(ranges, recording.anchors)))
    unit = tdoa_rules.judge_of(paired).finding
    if unit is not None and unit.rule == "tdoa_unit":
        cause = "ranges are in nanoseconds or in feet, not in metres"
        remedy = f"range *= {unit.value}  # of nanoseconds; of feet 0.3048"
        return [replace(unit, rule="range_unit", cause=cause, remedy=remedy)]
    if len(paired.tdoa) >= FEWEST_PAIRS and paired.imu is not None:
        finding = imu_rules.find_imu_mistake(_without_stream_mistakes(paired, found))
        if finding is not None:
            return [finding]
    if any(finding.severity == ERROR for finding in found):
        return []
    flight = replace(paired, tdoa=recording.tdoa).flight().replaced(**recording.sensors)
    return judge_sensors(flight, estimator(flight), estimator)


def _with_trials(
    recording: Recording,
    streams: StreamRules,
    found: list[Finding],
    others: Sequence[Survey],
    estimator: FlightEstimator,
    line: str | None,
) -> list[Finding]:
    """Return the findings of the streams, of trials, and about coverage, without those explained."""
    names = {finding.rule for finding in found}
    places, track = np.empty((0, 3)), None
    explained: set[str] = set()
    if names & NOTHING_TO_TRY:
        found.append(
            Finding(
                "not_tried",
                NOTE,
                cause="sign, ids, survey and axes were not tried",
                evidence="the streams are of no use for that",
                remedy="put the errors right, record again, and check again",
                value=np.nan,
            )
        )
    else:
        found = _without(found, JUDGED)
        ordered = _without_stream_mistakes(OrderedRecording.of(recording), found)
        tried, places = _try_corrections(ordered, names, others)
        flight = ordered.flight().replaced(**recording.sensors)
        if any(one.rule in OF_IMU for one in tried):  # it would move anchors
            flight = flight.without("imu")
        run = estimator(flight)
        track = run.odometry.t, run.odometry.p
        events = found_by_monitor(flight, run, estimator)
        tried = together(ordered, tried, events, line)
        explained = explained_by(tried, EXPLAINS)
        found = _without(found, explained) + tried
        if not any(finding.severity == ERROR for finding in found):
            found += judge_sensors(flight, run, estimator)
    if "survey_scale" in names:  # of a room of another size
        places = np.empty((0, 3))
    view = coverage.CoverageView(
        recording.anchors, list(streams.tdoa), places, "height" in recording.sensors, track
    )
    for rule in coverage.RULES:
        found += _without(rule(view), explained)
    return found


def _without(findings: Iterable[Finding], explained: set[str]) -> list[Finding]:
    return [finding for finding in findings if finding.rule not in explained]


def processed_streams(recording: Recording) -> StreamRules:
    """Return StreamRules that have processed a whole Recording."""
    streams, imu, tdoa = StreamRules(recording.anchors), recording.imu, recording.tdoa
    if imu is not None:
        streams.feed_imu(imu.t, recording.imu_arrival, imu.gyro, imu.accel)
    streams.feed_tdoa(tdoa.t, recording.tdoa_arrival, tdoa.a, tdoa.b, tdoa.d)
    streams.finish()
    return streams


def _without_stream_mistakes(ordered: OrderedRecording, found: list[Finding]) -> OrderedRecording:
    """Return the OrderedRecording without the mistakes that the streams show directly."""
    for finding in found:
        if finding.rule == "survey_scale" and tdoa_rules.in_metres(ordered):
            ordered = ordered.scaled(finding.value)
        elif finding.rule == "tdoa_wraps":
            ordered = ordered.possible()
        imu = ordered.imu
        if imu is None:
            continue
        if finding.rule == "imu_force_unit":
            ordered = ordered.with_imu(accel=imu.accel * finding.value)
        elif finding.rule == "imu_rate_unit":
            ordered = ordered.with_imu(gyro=np.deg2rad(imu.gyro))
        elif finding.rule == "imu_turned":
            turn = upright(np.median(imu.accel, axis=0))
            ordered = ordered.with_imu(accel=imu.accel @ turn.T, gyro=imu.gyro @ turn.T)
        elif finding.rule == "stamps_apart":
            ordered = ordered.with_imu(t=imu.t - finding.value)
    return ordered


def upright(force: np.ndarray) -> np.ndarray:
    """Return the rotation (3, 3) by quarter turns that moves the largest axis of `force` (3,) to +z."""
    k = int(np.argmax(np.abs(force)))
    up = np.sign(force[k]) * np.eye(3)[k]
    side = np.eye(3)[(k + 1) % 3]
    return np.stack([side, np.cross(up, side), up])


def _try_corrections(
    ordered: OrderedRecording, names: set[str], others: Sequence[Survey]
) -> tuple[list[Finding], np.ndarray]:
    """Try corrections, and return ([Finding], positions of the tag (k, 3) m)."""
    found, given = [], ordered
    for _ in range(ROUNDS):
        finding, ordered = tdoa_rules.best_trial(ordered, others)
        if finding is None:
            break
        found.append(finding)
    fit = ordered.survey_fit
    blamed = [finding for finding in found if finding.rule in BLAMED]
    if not found:
        found += filter(None, [_misfit(fit)])
    elif blamed and tdoa_rules.still_gains(fit):  # the corrections did not make it fit
        found = [finding for finding in found if finding not in blamed]
        found += filter(None, [_misfit(given.survey_fit) or _misfit(fit)])
    if (
        ordered.imu is not None
        and not names & WITHOUT_IMU
        and not any(f.rule in ("survey_misfit", "anchors_late") for f in found)
    ):
        finding = imu_rules.find_imu_mistake(ordered)
        found += [finding] if finding else []
    return found, fit.places


def _misfit(fit: SurveyFit) -> Finding | None:
    """Return the Finding on a survey that fits much better with anchors moved, or late; or None."""
    if tdoa_rules.is_of_delays(fit):
        less = 100.0 * (1.0 - fit.late_loss / fit.before)
        return Finding(
            "anchors_late",
            ERROR,
            cause="several anchors are late or early: no anchor needs to stand elsewhere",
            evidence=f"{less:.0f} % less stays unexplained with a delay of each anchor",
            remedy="calibrate the delays: survey, or diagnose; look what stands before the anchors",
            value=fit.late_loss,
        )
    gain = tdoa_rules.gained(fit)
    if gain is not None:
        moved = displacement(fit.positions[fit.heard], fit.all_moved[1][fit.heard])
        or_late = ", or several are late" * (fit.before - fit.late_loss > tdoa_rules.ALONE * gain)
        return Finding(
            "survey_misfit",
            ERROR,
            cause=f"the survey does not fit: of another room, or anchors have been moved{or_late}",
            evidence=(
                f"{100.0 * gain / fit.before:.0f} % less stays unexplained with the anchors "
                f"elsewhere, by {np.median(moved):.1f} m in the median"
            ),
            remedy=OTHER_SURVEY,
            value=gain,
        )
    enough = fit.seconds >= tdoa_rules.SHORTEST and len(fit.positions) <= MANY and not fit.flat
    if enough and fit.before > tdoa_rules.POOR:
        return Finding(
            "survey_misfit",
            ERROR,
            cause="the survey does not fit: of another room, or its ids are mixed up",
            evidence="wherever the tag is, and with any anchors moved, the TDOAs do not fit",
            remedy=OTHER_SURVEY,
            value=fit.before,
        )
    if tdoa_rules.apparent_gain(fit) <= tdoa_rules.GAIN:
        return None
    if tdoa_rules.is_of_radio(fit):
        more = 100.0 * (1.0 - fit.radio_loss / fit.all_moved[0])
        return Finding(
            "radio_errors",
            WARNING,
            cause="the errors of the TDOAs depend on the place of the tag: no anchor is blamed",
            evidence=(
                "errors of each anchor that change with the place explain more than anchors "
                f"elsewhere: {more:.0f} % less stays unexplained"
            ),
            remedy=(
                "look what stands between tag and anchors: a body, metal, a wall; localize --zones "
                "shows where"
            ),
            value=more,
        )
    return Finding(
        "misfit_unclear",
        NOTE,
        cause=(
            "the TDOAs fit the survey less well than usual, and this recording does not determine "
            "why"
        ),
        evidence=(
            "with the anchors elsewhere each half of the recording fits better, and not the other "
            "half"
        ),
        remedy="record a minute in which the tag is carried through the whole room, and check again",
        value=tdoa_rules.apparent_gain(fit),
    )


def _facts(recording: Recording, streams: StreamRules) -> dict[str, str]:
    """Return {quantity: text} of the received streams."""
    facts = {}
    for name, windows, unit in (("TDOAs", streams.tdoa, "Hz"), ("IMU", streams.imu, "Hz")):
        if windows:
            step = float(np.median([window.stamps.step for window in windows]))
            facts[name] = f"{1.0 / step:.0f} {unit}" if step > 0.0 else "no rate"
    for name, stream in recording.sensors.items():
        step = float(np.median(np.diff(stream.t))) if len(stream) > 1 else 0.0
        step = step or float(np.ptp(stream.t)) / max(len(stream) - 1, 1)  # several of one stamp
        facts[name] = (
            f"{SENSORS[name].plural} {1.0 / step:.0f} Hz"
            if step > 0.0
            else f"{SENSORS[name].plural}, no rate"
        )
    if streams.tdoa:
        windows = list(streams.tdoa)
        facts["duration"] = f"{windows[-1].stamps.end - windows[0].stamps.begin:.1f} s"
        facts["anchors"] = (
            f"{np.count_nonzero(sum(w.heard for w in windows))} of {len(recording.anchors)} heard"
        )
        facts["protocol"] = protocol(recording.tdoa).replace("tdoa", "TDoA")
    return facts


def different_surveys(recordings: Sequence[Recording | Flight]) -> Iterator[Finding]:
    """Yield findings about Recordings with different surveys: an id at two places.

    Such flights do not belong together.
    """
    for one, two in zip(recordings, recordings[1:]):
        off = largest_displacement(one.anchors, two.anchors)
        if off > SAME:
            apart = f"the same ids are up to {off:.2f} m apart"
            yield Finding(
                "surveys_differ",
                WARNING,
                cause=f"{one.name} and {two.name} have different surveys",
                evidence=apart if np.isfinite(off) else "they have no id in common",
                remedy="diagnose, train and fit maps for each installation by itself",
                value=off,
            )
