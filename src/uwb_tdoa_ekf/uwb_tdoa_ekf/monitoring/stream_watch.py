"""The rules over streams in flight: over the last seconds, and without those that say nothing
there.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .finding import NOTE, Steady, most_severe_first
from .signs import SignWatch
from .stamp_rules import usual
from .stream_rules import StreamRules

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.common.anchors import Anchors

    from .finding import Finding

KEPT = 4  # windows of a second that are checked together
FEWEST = 3  # of them, below which nothing is said
LATEST = 2  # of them, which must say it too, or it is over
# Said by `check`, and no warning in flight: the filter knows what a shaking accelerometer is worth.
NOT_IN_FLIGHT = {"imu_shaking"}
FEW_ANCHORS = "few_anchors"  # a tag with a fixed height needs three
SMALLEST_UNIT = 100.0  # of another unit of stamps: what is less is the pace of a replay
# share of the swing of one stream's latency that the other has too, when it is we who are not
# scheduled
ALIKE = 0.5


class StreamWatch:
    """Keeps what arrives and checks it when it is asked, once a second."""

    def __init__(self, anchors: Anchors, lag: float, ignored: Sequence[str] = ()) -> None:
        """anchors : Anchors; lag : s, what the node waits for; ignored : names of rules that do not
        hold for this tag.
        """
        self._anchors, self._lag, self._ignored = anchors, lag, NOT_IN_FLIGHT | set(ignored)
        self.restart()

    def restart(self) -> None:
        """Forget everything: another time has begun."""
        self._rules = StreamRules(self._anchors, KEPT)
        self._imu: list[tuple[np.ndarray, ...]] = []
        self._tdoa: list[tuple[np.ndarray, ...]] = []
        self._sign = SignWatch(self._anchors)
        self._turns: int | None = None  # as of Monitor, at the last look
        self._steady = Steady()

    def add_imu(
        self, t: np.ndarray, arrival: np.ndarray, gyro: np.ndarray, accel: np.ndarray
    ) -> None:
        """Take samples: stamps and arrivals, (n,) s, of one clock if possible; gyro (n, 3) rad/s;
        accel (n, 3) m/s^2.
        """
        self._imu.append((t, arrival, gyro, accel))

    def add_tdoa(
        self, t: np.ndarray, arrival: np.ndarray, a: np.ndarray, b: np.ndarray, d: np.ndarray
    ) -> None:
        """Take raw TDOAs: stamps and arrivals, (n,) s; a, b (n,) ids; d (n,) m."""
        self._tdoa.append((t, arrival, a, b, d))

    def findings(self, turns: int = 0, doubted: bool = False) -> list[Finding]:
        """What stands: a list of Finding, most severe first. turns : of the signs of all TDOAs so
        far, as of Monitor; doubted : most TDOAs contradict the filter.
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
        if finding.severity == NOTE or finding.rule in self._ignored:
            return False
        if finding.rule == "stamps_unit":
            return finding.value > SMALLEST_UNIT
        if finding.rule == "blocks":
            return finding.value > self._lag and not self._starved()
        return True

    def _starved(self) -> bool:
        """Whether both streams arrive in blocks: then it is this node that was not scheduled."""
        spreads = [
            usual([window.stamps for window in windows], "spread")
            for windows in (self._rules.imu, self._rules.tdoa)
            if windows
        ]
        return len(spreads) == 2 and min(spreads) > ALIKE * max(spreads)
