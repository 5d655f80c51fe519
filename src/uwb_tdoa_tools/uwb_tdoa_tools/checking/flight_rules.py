# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Judge the numbers of a flight: its streams alone, and against its ground truth if it has one.

The streams alone are judged by `uwb_tdoa_ekf.streams`. Here geometry and motion show what should
have been measured.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.effects.anchor import AnchorIds
from uwb_tdoa_ekf.monitoring.finding import NOTE, WARNING, Finding, most_severe_first

from . import coverage, imu_rules, motion_rules, pair_rules, time_rules
from .check import processed_streams
from .pair_rules import KnownPath, least_height, repairs_of
from .recording import of_flight

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
        found += time_rules.wrong_stamps(path)
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
