# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Apply all rules to one recording, in the order in which one mistake hides another.

`check` judges a recording, and `judge_flight` the numbers of a flight: its streams alone, and against
its ground truth if it has one. The findings are written as text and JSON, and as remarks of tools
that estimate.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.sensors import SENSORS, Ranges
from uwb_tdoa_bias.effects.anchor import AnchorIds
from uwb_tdoa_bias.effects.base import listed
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

from .. import cli, command_lines
from ..estimate import FlightEstimator
from ..readers.inputs import Reading
from ..readers.streams import protocol
from . import coverage, imu_rules, motion_rules, pair_rules, recording_rules, tdoa_rules
from .ordered import OrderedRecording, differences, displacement
from .pair_rules import MANY, KnownPath, least_height, repairs_of
from .recording import Recording, of_flight, read_recording
from .tdoa_rules import SAME, gained, largest_displacement
from .watch import BEFORE_TRUTH, EXCHANGED, FIRST, found_by_monitor, judge_sensors, together

if TYPE_CHECKING:
    from ..live.session import End
    from .tdoa_rules import Survey

FEWEST_PAIRS = 1000  # of successive ranges, for a trial without TDOAs
ROUNDS = 3  # mistakes that are undone one after the other
# Loss below which one motion explains TDOAs that leap and return. Simulated tags with 10 % outliers
# leave 0.11 to 0.27, two measured flights on one topic 0.2 at least, but for one of 131.
ONE_TAG = 0.2
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

    def text(self) -> str:
        """Return lines: the verdict first, then the findings, most severe first."""
        facts = ", ".join(
            f"{name} {value}" if name in ("TDOAs", "IMU") else value
            for name, value in self.facts.items()
        )
        out = [f"{self.recording}: {verdict(self.findings)}  ({facts})"]
        out += [f"  {end.topic} from {end.node}: {end.qos}" for end in self.ends if end.publishes]
        for finding in self.findings:
            out += lines(finding)
        return "\n".join(out)


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
    ordered = OrderedRecording.of(recording)
    names = {finding.rule for finding in found}
    if "two_tags" in names and tdoa_rules.is_explained(ordered, ONE_TAG):
        found = _without(found, {"two_tags"})  # outliers leap and return, too
        names.remove("two_tags")
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
        ordered = _without_stream_mistakes(ordered, found)
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
        found += filter(None, [_misfit(ordered)])
    elif blamed and tdoa_rules.still_gains(fit):  # the corrections did not make it fit
        found = [finding for finding in found if finding not in blamed]
        found += filter(None, [_misfit(given) or _misfit(ordered)])
    if (
        ordered.imu is not None
        and not names & WITHOUT_IMU
        and not any(f.rule in ("survey_misfit", "anchors_late") for f in found)
    ):
        finding = imu_rules.find_imu_mistake(ordered)
        found += [finding] if finding else []
    return found, fit.places


def _misfit(recording: OrderedRecording) -> Finding | None:
    """Return the Finding on a survey that fits much better with anchors moved, or late; or None."""
    fit = recording.survey_fit
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
    if enough and fit.before > tdoa_rules.POOR and not tdoa_rules.is_explained(recording):
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


HOLE = 1.0  # s without ground truth in the air
LEAP, LEAST_LEAP = 20.0, 0.2  # m/s, and m, between two poses; healthy 0.11 m


def judge_against_truth(flight: Flight) -> list[Finding]:
    """Return the findings of a Flight against its ground truth; none without ground truth."""
    if flight.truth is None or len(flight.truth) < 2:
        return []
    return [*judge_truth(flight), *_of_tdoas(KnownPath(flight)), *motion_rules.judge_imu(flight)]


def _of_tdoas(path: KnownPath) -> list[Finding]:
    """Return findings about ids, then other values, then stamps if ids and values are right."""
    repairs = repairs_of(path)
    found: list[Finding] = []
    if any(effect.name == AnchorIds.name for effect in repairs):
        found += pair_rules.exchanged_ids(path)
    found += pair_rules.wrong_values(path.without(repairs[0]) if found else path)
    if not any(finding.rule.startswith(("ids", "tdoa")) for finding in found):
        found += pair_rules.wrong_stamps(path)
    return found


def judge_truth(flight: Flight) -> Iterator[Finding]:
    """Yield holes and jumps of the ground truth in the air."""
    of = flight.known_truth
    up = np.flatnonzero(of.p[:, 2] > least_height(of))
    if len(up) < 2:
        return
    t, p = of.t[up[0] : up[-1] + 1], of.p[up[0] : up[-1] + 1]
    dt = np.diff(t)
    k = int(np.argmax(dt))
    if dt[k] > HOLE:
        yield Finding(
            "truth_hole",
            WARNING,
            cause="the ground truth has a hole",
            evidence=f"{dt[k]:.1f} s without a pose from {t[k] - flight.tdoa.t[0]:.1f} s on",
            remedy="judge on what lies before or after",
            value=float(dt[k]),
        )
    step = np.linalg.norm(np.diff(p, axis=0), axis=1)
    speed = np.where(step > LEAST_LEAP, step / np.maximum(dt, 1e-3), 0.0)
    if (speed > LEAP).any():
        k = int(np.argmax(speed))
        yield Finding(
            "truth_leap",
            WARNING,
            cause="the ground truth leaps",
            evidence=(
                f"{np.linalg.norm(p[k + 1] - p[k]):.2f} m in {dt[k]:.3f} s at "
                f"{t[k] - flight.tdoa.t[0]:.1f} s"
            ),
            remedy="look for exchanged or hidden markers",
            value=float(speed[k]),
        )


def judge_flight(flight: Flight) -> list[Finding]:
    """Return the findings of a Flight, most severe first, without notes.

    The streams are judged alone, and against the ground truth if there is one. Findings of several
    rules with one name are reported once.
    """
    streams, imu = processed_streams(of_flight(flight)), flight.imu
    found = streams.findings()
    track = None if flight.truth is None else (flight.truth.t, flight.truth.p)
    found += coverage.unheard_anchors(
        coverage.CoverageView(flight.anchors, list(streams.tdoa), np.empty((0, 3)), track=track)
    )
    if imu is not None and not any(finding.rule == "imu_clipped" for finding in found):
        found += imu_rules.clipped_axes(flight)
    found = [finding for finding in found if finding.severity != NOTE]
    known = {finding.rule for finding in found}
    return most_severe_first(
        found + [finding for finding in judge_against_truth(flight) if finding.rule not in known]
    )


# the rule of `check` for a survey that does not fit without another mistake
MISFIT = "survey_misfit"
# largest median shift of the anchors, in standard deviations, that a calibration can correct
LARGEST_SHIFT = 3.0
SYMBOL = {"error": "ERROR", "warning": "warning", "note": "note"}


def verdict(findings: Sequence[Finding]) -> str:
    """Return the verdict in a few words."""
    counts = {severity: sum(f.severity == severity for f in findings) for severity in SYMBOL}
    if not counts["error"] and not counts["warning"]:
        return "OK" if not counts["note"] else "OK, with a remark"
    return ", ".join(
        f"{count} {severity}{'s' * (count > 1)}" for severity, count in counts.items() if count
    )


def lines(finding: Finding) -> Iterator[str]:
    """Yield the lines of text about one Finding."""
    yield f"  {SYMBOL[finding.severity]}: {finding.cause}"
    yield f"      seen:   {finding.evidence}"
    first, *more = command_lines.as_it_runs(finding.remedy).splitlines()
    yield f"      remedy: {first}"
    for line in more:
        yield f"              {line}"


def as_dict(reports: Iterable[Report], together: Iterable[Finding]) -> dict[str, Any]:
    """Return the content for JSON.

    {"recordings": [{"recording", "facts", "findings", "ends"}], "together": [findings about several
    recordings]}. "ends" are publishers and subscriptions of live topics.
    """
    return {
        "recordings": [
            {
                "recording": r.recording,
                "facts": r.facts,
                "findings": [_finding(f) for f in r.findings],
                "ends": [asdict(end) for end in r.ends],
            }
            for r in reports
        ],
        "together": [_finding(f) for f in together],
    }


def _finding(finding: Finding) -> dict[str, Any]:
    return cli.as_json(asdict(finding))


SHORTEST = 10.0  # s; shorter flights get no remark


def survey_remarks(flight: Flight) -> Iterator[str]:
    """Yield sentences about the survey of a Flight: missing anchors, and positions that cannot be right.

    The test is how much moving the anchors explains (see SurveyFit).

    Raises
    ------
    InputError
        If no TDOA is between two anchors of the survey.
    """
    tdoa, anchors = flight.tdoa, flight.anchors
    known = (anchors.index(tdoa.a) >= 0) & (anchors.index(tdoa.b) >= 0)
    heard = np.unique([tdoa.a, tdoa.b])
    lacking = heard[anchors.index(heard) < 0].tolist()
    if len(tdoa) and not known.any():
        raise InputError(
            f"{flight.name}: the tag hears anchors {_listed(heard)}, the survey has "
            f"{_listed(anchors.ids)}, and no "
            "TDOA is between two that it has; give the survey of that room."
        )
    if lacking:
        share = 100.0 * np.mean(~known)
        yield (
            f"the survey has no anchor {_listed(lacking)}: {share:.0f} % of the TDOAs are not "
            "used; survey it, too."
        )
    if not (len(tdoa) and np.ptp(tdoa.t) > SHORTEST):
        return
    recording = of_flight(flight)
    if gained(OrderedRecording.of(recording).survey_fit) is not None:
        causes = [
            f"{one.cause}: {one.evidence}; {one.remedy}."
            for one in check(recording).findings
            if one.rule in BEFORE_TRUTH
        ]
        yield from causes or [
            (
                "the survey does not fit the TDOAs: of another room, or anchors have been moved; "
                "`check` says more."
            )
        ]


def _listed(ids: Iterable[int]) -> str:
    return ", ".join(map(str, ids))


def remarks_on(
    flights: Sequence[Flight], surveys: Sequence[str | Path | None] = ()
) -> Iterator[str]:
    """Yield sentences on the surveys of Flights, each alone and in comparison.

    surveys : files of the surveys, as of `remark_on_surveys`; () to name none
    """
    for flight in flights:
        yield from (f"{flight.name}: {remark}" for remark in survey_remarks(flight))
    yield from (
        f"{finding.cause}: {finding.evidence}; {finding.remedy}."
        for finding in different_surveys(flights)
    )
    if surveys:
        yield from remark_on_surveys(surveys, flights)


def nothing_comes_first(
    command: str, reading: Reading, paths: Sequence[str], estimator: FlightEstimator, std: float
) -> bool:
    """Return whether `check` finds no mistake that looks like misplaced anchors.

    These are mistakes of ids, signs, units and the scale of the survey, and a survey of another
    room. They are printed, and a command that estimates anchors must stop.

    command : name of the command, for its messages; reading : how recordings are read
    paths : files and folders to read; raises InputError
    std : standard deviation of a coordinate of an anchor as given, m
    """
    found, misfits = [], []
    with cli.Progress(command) as progress:
        for path, survey in progress.over(reading.find(paths), "checking recordings"):
            recording = read_recording(reading, path, survey)
            findings = check(recording, others=(), estimator=estimator).findings
            found += [finding for finding in findings if finding.rule in (*FIRST, EXCHANGED)]
            off = misfit_beyond(recording, findings, std)
            if off is not None:
                misfits.append((recording.name, off))
                found += [finding for finding in findings if finding.rule == MISFIT]
    for finding in found:
        cli.show(*lines(finding))
    if misfits:
        needed = max(off for _, off in misfits) / LARGEST_SHIFT
        cli.say(
            command,
            f"stopped, and nothing is written: the survey does not fit {listed(n for n, _ in misfits)}"
            ", as said above. Give the survey of that room. If its anchors can be off by that much, "
            f"survey improves them with --std {math.ceil(20.0 * needed) / 20.0:g} (m, standard "
            f"deviation of a coordinate; {std:g} is assumed).",
        )
    elif found:
        cli.say(
            command,
            "stopped, and nothing is written: ids, signs, units and scale first, as said above; "
            "then "
            "anchors.",
        )
    return not found


def misfit_beyond(recording: Recording, findings: Iterable[Finding], std: float) -> float | None:
    """Return by how much anchors are off in the median, m, if that is beyond their accuracy.

    None if no finding is about a survey that does not fit, or if a calibration can correct that.
    std : standard deviation of a coordinate of an anchor, m
    """
    if not any(finding.rule == MISFIT for finding in findings):
        return None
    fit = OrderedRecording.of(recording).survey_fit
    off = float(np.median(displacement(fit.positions, fit.all_moved[1])))
    return off if off > LARGEST_SHIFT * std else None


def remark_on_surveys(
    surveys: Sequence[str | Path | None], recordings: Sequence[Recording | Flight]
) -> Iterator[str]:
    """Yield a sentence if some recordings have different surveys of one installation.

    surveys : their files, None for the anchors of a bag
    """
    off = [largest_displacement(recordings[0].anchors, one.anchors) for one in recordings]
    if not any(0.0 < distance <= SAME for distance in off):
        return
    names: dict[str, list[str]] = {}
    for survey, one in zip(surveys, recordings):
        names.setdefault("the anchors in the bag" if survey is None else str(survey), []).append(
            one.name
        )
    if len(names) < 2:
        return
    each = "; ".join(f"{', '.join(of)}: {survey}" for survey, of in names.items())
    apart = max(distance for distance in off if distance <= SAME)
    yield (
        f"the flights have different surveys ({each}), in which the same ids are up to "
        f"{100.0 * apart:.1f} cm apart. Each flight is used with its own, one correction is fitted to "
        f"all, and what is written and printed for the nodes is for {next(iter(names))}."
    )
