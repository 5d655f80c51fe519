# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What the monitor of ekf_node finds in a recording: anchors that were moved, exchanged or changed,
before it began or while it lasts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import re

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_ekf.monitoring.finding import Finding
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
