# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Count both streams of a tag in windows and apply all rules to the windows."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from . import inertial_rules, ranging_rules, ranging_windows, stamp_rules
from .finding import ERROR, Finding, most_severe_first
from .survey_scale import KEPT, SurveyScale

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.anchors import Anchors

    from .inertial_rules import ImuWindow
    from .ranging_windows import TdoaWindow

Window = TypeVar("Window", "ImuWindow", "TdoaWindow")

LOOKS_LIKE = {"tdoa_large", "tdoa_outliers"}
FULL = 20  # fewest messages of a window with reliable statistics


class StreamRules:
    """Check the inertial samples and the TDOAs of one tag without a filter.

    A window is one second of arrival, or of stamps if the arrival is unknown. Messages are counted
    as they come, and the rules check windows.
    """

    def __init__(self, anchors: Anchors, kept: int | None = None) -> None:
        """Create the counters.

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
        self._imu, self._tdoa = inertial_rules.new_imu(), ranging_windows.new_tdoa(anchors)
        self._scale = SurveyScale(anchors, kept and KEPT)

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
        t, arrival, gyro, force = (
            np.ascontiguousarray(column, dtype=float) for column in (t, arrival, gyro, force)
        )
        row = 0
        while row < len(t):
            row, complete = inertial_rules.feed_imu(self._imu, t, arrival, gyro, force, row)
            if complete:
                self._close_imu()

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
        t, arrival, d = (np.ascontiguousarray(column, dtype=float) for column in (t, arrival, d))
        row = 0
        while row < len(t):
            row, complete = ranging_windows.feed_tdoa(self._tdoa, t, arrival, row_a, row_b, d, row)
            if complete:
                self._close_tdoa()

    def finish(self) -> None:
        """Close the windows at the end of a recording, unless they are almost empty."""
        for counters, close in ((self._imu, self._close_imu), (self._tdoa, self._close_tdoa)):
            if counters.stamps[stamp_rules.COUNT] >= FULL:
                close()

    def findings(self, latest: int = 0) -> list[Finding]:
        """Return the Findings that hold, the most severe first.

        Parameters
        ----------
        latest : int
            Number of latest windows of each stream to check; 0 checks all.
        """
        imu, tdoa = self.imu[-latest:], self.tdoa[-latest:]
        of_imu, of_tdoa = [window.stamps for window in imu], [window.stamps for window in tdoa]
        found: list[Finding | None] = []
        if imu:
            found += [rule("imu/data", of_imu) for rule in stamp_rules.OF_ONE] + [
                rule(imu) for rule in inertial_rules.RULES
            ]
        if tdoa:
            found += [rule("uwb/tdoa", of_tdoa) for rule in stamp_rules.OF_ONE] + [
                rule(tdoa) for rule in ranging_rules.RULES
            ]
        if imu and tdoa:
            found += [rule(of_imu, of_tdoa) for rule in stamp_rules.OF_BOTH]
        if (
            scale := self._scale.finding
        ) is not None:  # a wrong scale also makes TDOAs impossible: report the cause only
            found = [
                scale,
                *(
                    finding
                    for finding in found
                    if finding is None or finding.rule not in LOOKS_LIKE
                ),
            ]
        found.append(self._unknown(tdoa))
        return most_severe_first(finding for finding in found if finding is not None)

    def _unknown(self, windows: list[TdoaWindow]) -> Finding | None:
        count = sum(window.unknown for window in windows)
        if not count:
            return None
        share = count / sum(window.stamps.count for window in windows)
        ids = ", ".join(map(str, sorted(self.unknown)))
        evidence = (
            f"{100.0 * share:.1f} % of the TDOAs are with {ids}; the survey has "
            f"{', '.join(map(str, self.anchors.ids))}"
        )
        line = "".join(
            f"  {number}: {{position: [x, y, z]}}\n" for number in sorted(self.unknown)
        ).rstrip("\n")
        return Finding(
            "ids_unknown",
            ERROR,
            "the tag hears anchors that the survey does not have",
            evidence,
            line,
            share,
        )

    def _close_imu(self) -> None:
        self._keep(self.imu, inertial_rules.imu_window(self._imu))
        inertial_rules.restart_imu(self._imu)

    def _close_tdoa(self) -> None:
        window = ranging_windows.tdoa_window(self._tdoa)
        self._keep(self.tdoa, window)
        self._scale.add(window.latest)
        ranging_windows.restart_tdoa(self._tdoa)

    def _keep(self, windows: list[Window], window: Window) -> None:
        windows.append(window)
        if self._kept is not None:
            del windows[: -self._kept]
