# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a run of the filter shows in a recording.

The monitor of ekf_node finds anchors that were moved, exchanged or changed, before it began or while
it lasts. Sensors contradict everything else, draw the filter away from the TDOAs, or are off by a
constant.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
import re

import numpy as np

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.sensors import LOCATING, SENSORS
from uwb_tdoa_bias.common.sensors.sensor import Sensor
from uwb_tdoa_ekf.core.memory import INVALID, REJECTED, REPEATED, STARTUP
from uwb_tdoa_ekf.monitoring.explain import Unexplained, compare, in_words
from uwb_tdoa_ekf.monitoring.finding import NOTE, WARNING, Finding
from uwb_tdoa_ekf.monitoring.monitor import SURVEYING, Event, watched
from uwb_tdoa_ekf.offline import Run

from ..estimate import FlightEstimator
from .ordered import OrderedRecording, is_flat
from .tdoa_rules import FEWEST, POOR, gained

CHANGED, EXCHANGED, DISPLACED = "anchor_changed", "ids_exchanged", "anchor_displaced"
OF_ANCHORS = CHANGED, EXCHANGED, DISPLACED
# s before the end of the recording, until which a displaced anchor must be named: the monitor may
# think better of it
STANDS = 5.0
# s for which another must last, and one that has changed until the end, too: what passes, as at an
# obstacle, is no fault
LASTS = 8.0
LONG_ENOUGH = 15.0  # s of a recording that show whether the survey fits
# Mistakes by which no anchor is where it seems to be: they are put right first.
FIRST = {
    "tdoa_sign",
    "tdoa_one_sign",
    "tdoa_unit",
    "survey_scale",
    "survey_other",
    "ids_renumbered",
    "ids_exchanged",
}
# Mistakes for which nobody should blame the ground truth, or an anchor that stands where it should.
BEFORE_TRUTH = FIRST | {
    EXCHANGED,
    CHANGED,
    DISPLACED,
    "survey_misfit",
    "anchor_moved",
    "anchors_late",
}
BEFORE_TRUTH |= {"pair_sign"}
# What an anchor that changes on the way, or two that are exchanged then, may be taken for, where
# the whole recording is asked.
TAKEN_FOR = {
    "survey_misfit",
    "misfit_unclear",
    "radio_errors",
    "anchors_late",
    "anchor_moved",
    "pair_sign",
    "tdoa_large",
    "tdoa_outliers",
}


def found_by_monitor(flight: Flight, run: Run, estimator: FlightEstimator) -> list[Event]:
    """Return the Events of anchors in the Run of a FlightEstimator over a Flight that say more than
    the rules over streams do.
    """
    calibrated = estimator.effects.covariance if estimator.effects else None
    events = watched(flight.anchors, run.odometry, run.residuals, calibrated, flight.restarts)
    end = float(run.odometry.t[-1]) if len(run.odometry) else 0.0
    lasting = [
        end,
        *(event.since for event in events if event.finding.rule in (CHANGED, EXCHANGED)),
    ]
    kept = []
    for event in events:
        rule, stands = event.finding.rule, event.until > end - STANDS
        if rule == DISPLACED:
            stands = not is_flat(flight.anchors.positions) and any(
                at - STANDS <= event.until <= at + STANDS for at in lasting
            )
        lasts = event.until - event.since > LASTS
        if rule == CHANGED:
            stands = stands and lasts and not any(_came_and_went(other, event) for other in events)
        elif rule == EXCHANGED:
            stands = stands or lasts
        if rule in OF_ANCHORS and stands:
            kept.append(event)
    return kept


def _came_and_went(event: Event, later: Event) -> bool:
    """Whether the same anchor had changed by as much before a `later` Event, and had come back:
    what passes, as at an obstacle or with the attitude, shows that the other will, too.
    """
    one, other = event.finding, later.finding
    alike = (
        one.rule == other.rule == CHANGED and one.cause.split(":")[0] == other.cause.split(":")[0]
    )
    return alike and event.until < later.since and abs(one.value) >= abs(other.value)


def together(
    ordered: OrderedRecording, found: Sequence[Finding], events: Sequence[Event], line: str | None
) -> list[Finding]:
    """Return the Findings of a whole OrderedRecording, and those of Events in it, without what they
    explain of each other.

    line : command that surveys the anchors with the recording, or None.
    """
    begin, end = float(ordered.tdoa.t[0]), float(ordered.tdoa.t[-1])
    rules = {one.rule for one in found}
    if rules & FIRST:
        return list(found)
    displaced = {
        anchor: event.finding
        for event in events
        if event.finding.rule == DISPLACED
        for anchor in _named(event.finding)
    }
    found = [
        _as_seen_by(one, displaced.get(_named(one)[0]), line) if one.rule == "anchor_moved" else one
        for one in found
    ]
    if rules & TAKEN_FOR:
        if not any(_explains(ordered, event) for event in events):
            return list(found)
        found = [one for one in found if one.rule not in TAKEN_FOR]
    return [*found, *(_with_times(event, begin, end, line) for event in events)]


def _named(one: Finding) -> list[str]:
    """Return the anchors that a Finding names, the most probable first."""
    return re.findall(r"\d+", one.cause.partition(" is ")[0].partition(" does ")[0])


def _as_seen_by(one: Finding, other: Finding | None, line: str | None) -> Finding:
    """Return the Finding of a moved anchor with what the monitor's says of the same one, or None:
    where it stands, and how to mend it.
    """
    if other is None:
        return one
    return replace(
        one,
        cause=other.cause,
        evidence=f"{one.evidence}; {other.evidence}",
        remedy=_remedy(other, line),
    )


def _remedy(one: Finding, line: str | None) -> str:
    if line is None or not one.remedy.startswith(SURVEYING):
        return one.remedy
    return f"{line}  # {one.remedy.partition('  # ')[2]}"


def _explains(ordered: OrderedRecording, event: Event) -> bool:
    """Whether the survey fits an OrderedRecording before an Event."""
    t = ordered.tdoa.t
    if event.finding.rule == DISPLACED or event.since <= t[0] + LONG_ENOUGH:
        return False
    before = {name: column[t < event.since] for name, column in vars(ordered.tdoa).items()}
    fit = ordered.with_tdoa(**before).survey_fit
    return len(fit) >= FEWEST and fit.before < POOR and gained(fit) is None


def _with_times(event: Event, begin: float, end: float, line: str | None) -> Finding:
    """Return the Finding of an Event, with its times."""
    since, until, one = event.since - begin, event.until - begin, event.finding
    when = (
        f"from {since:.0f} s on"
        if event.until > end - STANDS
        else f"from {since:.0f} to {until:.0f} s"
    )
    if one.rule == DISPLACED:
        when = f"seen after {since:.0f} s"
    return replace(one, evidence=f"{when}: {one.evidence}", remedy=_remedy(one, line))


OF_SENSORS = CONTRADICTS, MISLEADS = "sensor_contradicts", "sensor_misleads"
UNUSED = 0.5  # share of the measurements of a second that are not used
# seconds with UNUSED, and their share, of a sensor that contradicts everything: healthy range finders
# 3 s, optical flow 6 s of 33
SECONDS, SHARE = 5, 0.2
# ratio of the loss of the TDOAs without a sensor, and its standard errors. Healthy range finders
# 0.93 (TDOAs have errors of the height), optical flow 1.00; wheels that stand still 0.28 to 0.78.
RATIO, DEVIATIONS = 0.85, 2.5
FEWEST_RANGES = 20  # ranges of an anchor
# m, common error of all ranges that is reported; more than the delays of usual antennas; and its
# least number of standard deviations
LARGE, DELAYS, SURE = 0.1, 0.6, 5.0


def judge_sensors(flight: Flight, run: Run, estimator: FlightEstimator) -> list[Finding]:
    """Return findings on the SENSORS of a Flight; `run` is that of the estimator over it, not smoothed.

    A sensor misleads if the TDOAs fit better without it. Only the one without which they fit best is
    named, and none beside a sensor that contradicts everything.
    """
    delay, found = [*tag_delay(flight, run)], list[Finding]()
    for name, rows in run.sensors.items():
        stream = getattr(flight, name)
        refused = (rows["verdict"] == INVALID) & np.isfinite(stream.values).all(axis=1)
        unused = refused | (rows["verdict"] == REJECTED)
        if name in LOCATING:
            found += _contradicting_anchors(stream.anchor, unused, SENSORS[name].plural)
        elif len(stream):
            found += _contradicting(stream.t, unused, SENSORS[name])
    return delay + (found or _misleading(flight, run, estimator))


def tag_delay(flight: Flight, run: Run) -> Iterator[Finding]:
    """Yield a finding if the filter finds a common error of all ranges: the antenna delay of the tag.

    TDOAs do not depend on it. Without `range_offset_std` the position error exceeds the delay where
    the anchors are on one side.
    """
    offset, std = run.range_offset or (0.0, np.inf)
    if abs(offset) < max(LARGE, SURE * std):
        return
    severity, cause = NOTE, "the antenna delay of the tag"
    if abs(offset) > DELAYS and flight.range is not None:
        size = float(np.nanmedian(flight.range.d))
        scale = size / (size - offset)
        severity, cause = WARNING, f"{cause}, or all are {scale:.2f} times the distances"
    yield Finding(
        "tag_delay",
        severity,
        cause=f"all ranges are too {'long' if offset > 0.0 else 'short'} by about as much: {cause}",
        evidence=f"{offset:.2f} m, standard deviation {std:.2f} m",
        remedy=(
            "calibrate it: survey, or diagnose where there is ground truth; until then leave "
            "range_offset_std above 0.0: the filter finds it after each start"
        ),
        value=offset,
    )


def _contradicting(t: np.ndarray, unused: np.ndarray, sensor: Sensor) -> Iterator[Finding]:
    """Yield a finding on a Sensor that contradicts everything else; stamps (n,) s, and (n,) bool."""
    _, second = np.unique(np.floor(t), return_inverse=True)
    share = np.bincount(second, unused) / np.bincount(second)
    bad = int(np.count_nonzero(share > UNUSED))
    if bad > max(SECONDS, SHARE * len(share)):
        yield Finding(
            CONTRADICTS,
            WARNING,
            cause=f"the {sensor.plural} contradict everything else",
            evidence=f"in {bad} of {len(share)} s more than half of them are not used",
            remedy=f"check the sensor, {sensor.remedy}",
            value=bad / len(share),
        )


def _misleading(flight: Flight, run: Run, estimator: FlightEstimator) -> list[Finding]:
    """Return the finding on the sensor without which the TDOAs fit best, if much better."""
    found, loss = [], _loss(run)
    for name in run.sensors if loss.blocks else ():  # each costs a run of the filter
        ratio, z = compare(loss, _loss(estimator(flight.without(name))))
        if ratio < RATIO and z > DEVIATIONS:
            sensor = SENSORS[name]
            remedy = f"check the sensor, {sensor.remedy}; until then --without {name}"
            cause = f"the TDOAs fit much better without the {sensor.plural}"
            found.append(Finding(MISLEADS, WARNING, cause, in_words(ratio, z), remedy, ratio))
    return sorted(found, key=lambda finding: finding.value)[:1]


def _contradicting_anchors(
    anchor: np.ndarray, unused: np.ndarray, plural: str
) -> Iterator[Finding]:
    """Yield findings on anchors most of whose measurements are not used, (n,) ids and bool."""
    for one in np.unique(anchor).tolist():
        mine = unused[anchor == one]
        if len(mine) >= FEWEST_RANGES and mine.mean() > UNUSED:
            yield Finding(
                CONTRADICTS,
                WARNING,
                cause=f"the {plural} of anchor {one} contradict everything else",
                evidence=f"{mine.mean():.0%} of {len(mine)} are not used",
                remedy="check where this anchor stands, and what its driver sends",
                value=float(mine.mean()),
            )


def _loss(run: Run) -> Unexplained:
    """Return the Unexplained of the TDOAs that the filter judged."""
    left = run.residuals
    order = np.argsort(left.t, kind="stable")
    order = order[~np.isin(left.verdict[order], (INVALID, STARTUP, REPEATED))]
    return Unexplained.of(left.t[order], left.innovation[order])
