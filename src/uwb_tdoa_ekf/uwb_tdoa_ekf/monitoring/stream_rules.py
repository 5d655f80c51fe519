# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Cut both streams of a tag into windows and apply all rules to the windows.

`StreamWatch` applies them in flight, to the last seconds and without rules for recordings.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors

from . import inertial_rules, ranging_rules, stamp_rules
from .finding import ERROR, NOTE, Finding, Steady, explained_by, most_severe_first
from .judge import KEPT, Judge, wrong_sign
from .stamp_rules import median_of
from .windows import Cutter, ImuWindow, TdoaWindow, imu_window, tdoa_window

Window = TypeVar("Window", "ImuWindow", "TdoaWindow")

# Rules whose findings another finding explains: only that one is reported.
EXPLAINS = {
    "imu_silent": {"imu_no_gravity", "imu_force_unit", "imu_turned", "imu_tilted"},
    "imu_in_turns": {
        "imu_no_gravity",
        "imu_force_unit",
        "imu_rate_unit",
        "imu_turned",
        "imu_tilted",
        "imu_shaking",
    },
    "imu_no_gravity": {"imu_force_unit", "imu_turned", "imu_tilted"},
    "tdoa_wraps": {"tdoa_large", "tdoa_outliers", "two_tags"},
    "tdoa_rounded": {"tdoa_repeated", "tdoa_clipped", "tdoa_frozen"},
    "tdoa_frozen": {"tdoa_repeated", "tdoa_clipped"},
    "tdoa_clipped": {"tdoa_repeated"},
    "survey_scale": {"tdoa_large", "tdoa_outliers"},
    "anchor_scale": {"tdoa_large", "tdoa_outliers"},
    "tdoa_unit": {"tdoa_large", "tdoa_outliers"},
    "ids_exchanged": {"tdoa_large", "tdoa_outliers"},
}
FULL = 20  # fewest messages of a window with reliable statistics

IN_FLIGHT = 4  # windows of 1 s that are checked together in flight
FEWEST = 3  # fewest of these for a finding
LATEST = 2  # latest windows that must show a finding too, or it is over
# Reported by `check` only: in flight, the filter already weights a vibrating accelerometer less.
# The Monitor names exchanged anchors sooner, and `status` a silent IMU.
NOT_IN_FLIGHT = {"imu_shaking", "ids_exchanged", "imu_partly"}
# rule that does not hold for a tag with a fixed height, which needs three anchors
FEW_ANCHORS = "few_anchors"
# cause and evidence of a sign that flips
CHANGED = "the sign of all TDOAs has changed in flight"
FLIPPED = "from one moment on, each TDOA is the negative of what the place of the tag makes it"
SMALLEST_UNIT = 100.0  # smallest ratio of units of stamps; a smaller one is the rate of a replay
# ratio of the latency variations of both streams above which this process was not scheduled
ALIKE = 0.5


class StreamRules:
    """Check the inertial samples and the TDOAs of one tag without a filter.

    The streams are cut into windows as they come, and the rules check windows.
    """

    def __init__(self, anchors: Anchors, kept: int | None = None) -> None:
        """Start without messages.

        Parameters
        ----------
        anchors : Anchors
            Surveyed anchors.
        kept : int or None
            Number of latest windows to keep for each stream; None keeps all.
        """
        self.anchors, self._kept = anchors, kept
        self.imu: list[ImuWindow] = []
        self.tdoa: list[TdoaWindow] = []
        self.unknown: Counter[int] = Counter()  # ids that are not in the survey
        self._imu, self._tdoa = Cutter(), Cutter()
        self.judge = Judge(anchors, kept and KEPT)

    def feed_imu(
        self, t: np.ndarray, arrival: np.ndarray, gyro: np.ndarray, force: np.ndarray
    ) -> None:
        """Add samples in the order of their arrival.

        Parameters
        ----------
        t, arrival : (n,) array
            Stamps and arrival times, in s; NaN if unknown.
        gyro : (n, 3) array
            Angular velocity in the body frame, in rad/s.
        force : (n, 3) array
            Specific force in the body frame, in m/s^2.
        """
        columns = (np.asarray(column, dtype=float) for column in (t, arrival, gyro, force))
        for window in self._imu.cut(*columns):
            self._keep(self.imu, imu_window(*window))

    def feed_tdoa(
        self, t: np.ndarray, arrival: np.ndarray, a: np.ndarray, b: np.ndarray, d: np.ndarray
    ) -> None:
        """Add TDOAs in the order of their arrival.

        Parameters
        ----------
        t, arrival : (n,) array
            Stamps and arrival times, in s; NaN if unknown.
        a, b : (n,) array
            Anchor ids.
        d : (n,) array
            Raw TDOAs, in m.
        """
        row_a, row_b = self.anchors.index(a), self.anchors.index(b)
        for ids, known in ((a, row_a), (b, row_b)):
            values, counts = np.unique(np.asarray(ids)[known < 0], return_counts=True)
            self.unknown.update(dict(zip(values.tolist(), counts.tolist())))
        t, arrival, d = (np.asarray(column, dtype=float) for column in (t, arrival, d))
        for window in self._tdoa.cut(t, arrival, row_a, row_b, d):
            self._add_tdoa(*window)

    def _add_tdoa(self, columns: list[np.ndarray], own: int) -> None:
        window = tdoa_window(columns, own, self.anchors.positions)
        self._keep(self.tdoa, window)
        self.judge.add(window.latest)

    def finish(self) -> None:
        """Add the last, shorter windows of a recording if they have at least FULL messages."""
        if len(self._imu) >= FULL:
            self._keep(self.imu, imu_window(*self._imu.rest()))
        if len(self._tdoa) >= FULL:
            self._add_tdoa(*self._tdoa.rest())
        self.judge.add_order()

    def findings(self, latest: int = 0) -> list[Finding]:
        """Return the Findings that hold, the most severe first.

        Parameters
        ----------
        latest : int
            Number of latest windows of each stream to check; 0 checks all.
        """
        imu, tdoa = self.imu[-latest:], self.tdoa[-latest:]
        of_imu, of_tdoa = [window.stamps for window in imu], [window.stamps for window in tdoa]
        found = [*filter(None, [self.judge.finding])]
        if imu:
            found += _found(stamp_rules.OF_ONE, "imu/data", of_imu)
            found += _found(inertial_rules.RULES, imu)
        if tdoa:
            found += _found(stamp_rules.OF_ONE, "uwb/tdoa", of_tdoa)
            found += _found(ranging_rules.RULES, tdoa)
        if imu and tdoa:
            found += _found(stamp_rules.OF_BOTH, of_imu, of_tdoa)
        found += self._unknown(tdoa)
        explained = explained_by(found, EXPLAINS)
        return most_severe_first(one for one in found if one.rule not in explained)

    def _unknown(self, windows: list[TdoaWindow]) -> Iterator[Finding]:
        count = sum(window.unknown for window in windows)
        if count:
            share = count / sum(window.stamps.count for window in windows)
            ids = sorted(self.unknown)
            yield Finding(
                "ids_unknown",
                ERROR,
                cause="the tag hears anchors that the survey does not have",
                evidence=(
                    f"{100.0 * share:.1f} % of the TDOAs are with {', '.join(map(str, ids))}; the "
                    f"survey has {', '.join(map(str, self.anchors.ids))}"
                ),
                remedy="\n".join(f"  {number}: {{position: [x, y, z]}}" for number in ids),
                value=share,
            )

    def _keep(self, windows: list[Window], window: Window) -> None:
        windows.append(window)
        if self._kept is not None:
            del windows[: -self._kept]


def _found(rules: Sequence[Any], *windows: Any) -> list[Finding]:
    return [finding for rule in rules for finding in rule(*windows)]


class StreamWatch:
    """Collect messages and check them once per second."""

    def __init__(self, anchors: Anchors, lag: float, ignored: Sequence[str] = ()) -> None:
        """Start without messages.

        Parameters
        ----------
        anchors : Anchors
            Surveyed anchors.
        lag : float
            Time for which the node waits, in s.
        ignored : sequence of str
            Names of rules that do not hold for this tag.
        """
        self._anchors, self._lag, self._ignored = anchors, lag, NOT_IN_FLIGHT | set(ignored)
        self.restart()

    def restart(self) -> None:
        """Drop all messages and findings, because a new time begins."""
        self._rules = StreamRules(self._anchors, IN_FLIGHT)
        self._imu: list[tuple[np.ndarray, ...]] = []
        self._tdoa: list[tuple[np.ndarray, ...]] = []
        self._flipped: Finding | None = None  # all signs have flipped in flight
        self._turns: int | None = None  # sign flips counted by the Monitor at the last check
        self._steady = Steady()

    def add_imu(
        self, t: np.ndarray, arrival: np.ndarray, gyro: np.ndarray, accel: np.ndarray
    ) -> None:
        """Add inertial samples.

        Parameters
        ----------
        t, arrival : (n,) array
            Stamps and arrival times, in s, of one clock if possible.
        gyro : (n, 3) array
            Angular velocity in the body frame, in rad/s.
        accel : (n, 3) array
            Specific force in the body frame, in m/s^2.
        """
        self._imu.append((t, arrival, gyro, accel))

    def add_tdoa(
        self, t: np.ndarray, arrival: np.ndarray, a: np.ndarray, b: np.ndarray, d: np.ndarray
    ) -> None:
        """Add raw TDOAs.

        Parameters
        ----------
        t, arrival : (n,) array
            Stamps and arrival times, in s.
        a, b : (n,) array
            Anchor ids.
        d : (n,) array
            TDOAs, in m.
        """
        self._tdoa.append((t, arrival, a, b, d))

    def findings(self, turns: int = 0) -> list[Finding]:
        """Return the Findings that hold, the most severe first.

        Parameters
        ----------
        turns : int
            Sign flips of all TDOAs so far, from the Monitor.
        """
        imu, self._imu = self._imu, []
        tdoa, self._tdoa = self._tdoa, []
        rules = self._rules
        if self._turns is not None and turns > self._turns:
            flipped = replace(wrong_sign(FLIPPED, np.nan), cause=CHANGED)
            self._flipped = None if self._flipped else flipped
            rules.judge.forget()
        self._turns = turns
        if imu:
            rules.feed_imu(*map(np.concatenate, zip(*imu)))
        if tdoa:
            rules.feed_tdoa(*map(np.concatenate, zip(*tdoa)))
        if max(len(rules.imu), len(rules.tdoa)) < FEWEST:
            return []
        if rules.judge.full:  # it has judged anew
            self._flipped = None
        still, found = {finding.rule for finding in rules.findings(LATEST)}, []
        if still:
            found = [
                finding
                for finding in rules.findings()
                if finding.rule in still and self._counts(finding)
            ]
        if self._flipped and "tdoa_sign" not in still:
            found.append(self._flipped)
        return most_severe_first(self._steady(found))

    def _counts(self, finding: Finding) -> bool:
        # Return whether a finding matters in flight.
        if finding.severity == NOTE or finding.rule in self._ignored:
            return False
        if finding.rule == "stamps_unit":
            return finding.value > SMALLEST_UNIT
        if finding.rule == "blocks":
            return finding.value > self._lag and not self._starved()
        return True

    def _starved(self) -> bool:
        """Return whether both streams arrive in blocks, because this process was not scheduled."""
        spreads = [
            median_of([window.stamps for window in windows], "spread")
            for windows in (self._rules.imu, self._rules.tdoa)
            if windows
        ]
        return len(spreads) == 2 and min(spreads) > ALIKE * max(spreads)
