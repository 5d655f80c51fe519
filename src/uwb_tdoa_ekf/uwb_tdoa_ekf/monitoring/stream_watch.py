# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Apply the rules over streams in flight, to the last seconds and without rules for recordings."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .finding import NOTE, Steady, most_severe_first
from .signs import SignWatch
from .stamp_rules import median_of
from .stream_rules import StreamRules

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.common.anchors import Anchors

    from .finding import Finding

KEPT = 4  # windows of 1 s that are checked together
FEWEST = 3  # fewest windows for a finding
LATEST = 2  # latest windows that must show a finding too, or it is over
# Reported by `check` only: in flight, the filter already weights a vibrating accelerometer less.
NOT_IN_FLIGHT = {"imu_shaking"}
# rule that does not hold for a tag with a fixed height, which needs three anchors
FEW_ANCHORS = "few_anchors"
SMALLEST_UNIT = 100.0  # smallest ratio of units of stamps; a smaller one is the rate of a replay
# ratio of the latency variations of both streams above which this process was not scheduled
ALIKE = 0.5


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
        self._rules = StreamRules(self._anchors, KEPT)
        self._imu: list[tuple[np.ndarray, ...]] = []
        self._tdoa: list[tuple[np.ndarray, ...]] = []
        self._sign = SignWatch(self._anchors)
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

    def findings(self, turns: int = 0, doubted: bool = False) -> list[Finding]:
        """Return the Findings that hold, the most severe first.

        Parameters
        ----------
        turns : int
            Sign flips of all TDOAs so far, from the Monitor.
        doubted : bool
            Whether the filter rejects most TDOAs.
        """
        imu, self._imu = self._imu, []
        tdoa, self._tdoa = self._tdoa, []
        if self._turns is not None and turns > self._turns:
            self._sign.turn()
        elif doubted:
            self._sign.doubt()
        self._turns = turns
        rules = self._rules
        if imu:
            rules.feed_imu(*map(np.concatenate, zip(*imu)))
        if tdoa:
            t, arrival, a, b, d = map(np.concatenate, zip(*tdoa))
            rules.feed_tdoa(t, arrival, a, b, d)
            self._sign.feed(t, a, b, d)
        if max(len(rules.imu), len(rules.tdoa)) < FEWEST:
            return []
        still, found = {finding.rule for finding in rules.findings(LATEST)}, []
        if still:
            found = [
                finding
                for finding in rules.findings()
                if finding.rule in still and self._counts(finding)
            ]
        return most_severe_first(self._steady([*found, *filter(None, [self._sign.finding])]))

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
