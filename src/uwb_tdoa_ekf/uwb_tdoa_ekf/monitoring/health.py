# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Decide what ekf_node publishes on /diagnostics about itself, with the remedy."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
import time

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np

from uwb_tdoa_bias.common.anchors import FlyableVolume
from uwb_tdoa_bias.common.sensors import LOCATING, SENSORS
from uwb_tdoa_bias.ros.node import Rate, Report

from ..core.config import FilterConfig
from ..estimator import Estimator
from .finding import ERROR as SEVERE, Finding
from .status import LARGEST_UNUSED, Use, flyability

START_TIMEOUT = 5.0  # s of data without an initialization before a warning
# s, age of the newest odometry: below the first it is normal, above the second the clocks are
# unrelated
BEHIND = 1.0, 60.0
STOPPED = 2.0  # s without a message of a sensor that was received before, before a warning
MOST_SAID = 3  # sentences in the status text; the values contain all sentences
# consecutive reports with mostly unused messages of a sensor before a warning; optical flow at
# times contradicts all other sensors for 1 s
REPEATS = 2

OK, WARN, ERROR = DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR


class Health:
    """Check the state of the filter once per second of wall time."""

    def __init__(
        self,
        config: FilterConfig,
        lag: float,
        volume: FlyableVolume | None = None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        """Store the parameters and reset all counts.

        Parameters
        ----------
        config : FilterConfig
            Parameters of the filter.
        lag : float
            Time for which the filter waits for a silent stream, in s.
        volume : FlyableVolume or None
            Volume in which the tag may fly.
        now : callable
            Returns the time that ages are measured by, in s.
        """
        self.now = now
        # messages of each stream: imu, tdoa, and the SENSORS
        self.received: Counter[str] = Counter()
        self.last_odometry: float | None = None  # s, as of `now`
        # (3,) m, and its covariance (3, 3) m^2
        self.last_position: tuple[np.ndarray, np.ndarray] | None = None
        # s from the stamp of the newest odometry to the current ROS time
        self.behind: float | None = None
        # whether a node publishes corrected TDOAs, as bias_node does
        self.corrects = False
        self._use_imu, self._lag, self._volume = config.use_imu, lag, volume
        self._imu_rate, self._tdoa_rate, self._located_rate = Rate(), Rate(), Rate()
        # at the last report: messages of each stream, and totals by verdict
        self._received_before: Counter[str] = Counter()
        self._counts_before: Counter[str] = Counter()
        # consecutive reports in which most messages of a sensor were not used, by (sensor, reason)
        self._bad: Counter[tuple[str, str]] = Counter()
        self._heard: dict[str, float] = {}  # s, by sensor: time of its last message
        self._starting: float | None = None  # s
        self.use = Use(lag)

    def look(self, estimator: Estimator | None, counts: Mapping[str, int]) -> None:
        """Update the use of measurements; call this several times per second.

        Parameters
        ----------
        estimator : Estimator or None
            None before the anchors arrive.
        counts : mapping
            Totals by verdict.
        """
        self.use.update(
            self.now(), self.received, counts, estimator is not None and estimator.running
        )

    def report(
        self,
        refused: str | None,
        estimator: Estimator | None,
        counts: Mapping[str, int],
        wiring: Sequence[str] = (),
        findings: Sequence[Finding] = (),
    ) -> Report:
        """Return (level, text, values) for /diagnostics.

        Problems of the input come before their consequences.

        Parameters
        ----------
        refused : str or None
            Problem with the last anchors.
        estimator : Estimator or None
            None before the anchors arrive.
        counts : mapping
            Totals by verdict.
        wiring : sequence of str
            Sentences on topics that are connected wrongly.
        findings : sequence of Finding
            Findings of the rules over streams, the most severe first.
        """
        now = self.now()
        self.look(estimator, counts)
        imu_rate = self._imu_rate.of(self.received["imu"])
        tdoa_rate = self._tdoa_rate.of(self.received["tdoa"])
        located = self._located_rate.of(
            self.received["tdoa"] + sum(self.received[name] for name in LOCATING)
        )
        running = estimator is not None and estimator.running
        if running or not located:
            self._starting = None
        elif self._starting is None:
            self._starting = now
        missing = refused or self._missing(estimator, bool(imu_rate), bool(located))
        outside: str | None = None
        at_position: dict[str, str] = {}
        if estimator is not None and running and self.last_position is not None:
            outside, at_position = flyability(self._volume, estimator.anchors, *self.last_position)
        troubles: list[str] = []
        if estimator is not None and running:
            troubles = [*filter(None, self._troubles(estimator, counts, outside))]
        if missing:
            level, text = ERROR, missing
        elif wiring or findings or troubles:
            level, text = _worst([*wiring, *troubles], findings)
        elif running:
            level, text = OK, "running"
        else:
            level, text = self._not_running(estimator, now)
        state = "running" if running else "starting"
        if estimator is not None and not running and estimator.lost:
            state = "lost"
        age = "none yet" if self.last_odometry is None else f"{now - self.last_odometry:.3f} s"
        sentences = [*wiring, *(finding.sentence for finding in findings)]
        values = {
            "state": state,
            "age of last odometry": age,
            "odometry behind the clock": _behind(self.behind),
            "IMU rate": f"{imu_rate:.1f} Hz",
            "TDOA rate": f"{tdoa_rate:.1f} Hz",
            "wrong with the streams": "; ".join(sentences) or "nothing",
            **{f"found {finding.rule}": f"{finding.value:.4g}" for finding in findings},
        }
        return level, text, values | at_position

    def _missing(self, estimator: Estimator | None, imu: bool, located: bool) -> str | None:
        """Return a sentence on missing input, or None.

        Parameters
        ----------
        estimator : Estimator or None
            None before the anchors arrive.
        imu, located : bool
            Whether inertial samples, and TDOAs or distances, arrive.
        """
        if estimator is None:
            return "no anchors yet: publish them on uwb/anchors, reliable and transient local"
        if not located and self.corrects:
            return (
                "no TDOAs on uwb/tdoa_corrected, though bias_node runs: check the tag's driver, "
                "and see the status of bias_node"
            )
        if not located:
            return (
                "no TDOAs on uwb/tdoa_corrected: start bias_node in this namespace and the tag's "
                "driver"
            )
        if self._use_imu and not imu:
            return "no samples on imu/data: check the IMU's driver, or set use_imu to false"
        return None

    def _not_running(self, estimator: Estimator | None, now: float) -> tuple[bytes, str]:
        """Return (level, text) of a filter without a position at `now`, in s."""
        if estimator is not None and estimator.lost:
            return WARN, estimator.lost
        if self._starting is None or now - self._starting <= START_TIMEOUT:
            return OK, "looking for the start position"
        if self.use.why_unused:
            return WARN, self.use.why_unused
        return WARN, (
            "no start position found: check ids and positions of the anchors, and that four are "
            "heard"
        )

    def _troubles(
        self, estimator: Estimator, counts: Mapping[str, int], outside: str | None
    ) -> Iterator[str | None]:
        """Yield sentences on the trouble of a running filter, the most important first, or None.

        Parameters
        ----------
        estimator : Estimator
            The filter.
        counts : mapping
            Totals by verdict.
        outside : str or None
            Sentence on a position outside of the flyable volume.
        """
        yield self.use.why_unused
        yield self._trouble_of_sensors(counts)
        yield estimator.side_unknown
        yield outside
        yield off_the_clock(self.behind)

    def _trouble_of_sensors(self, counts: Mapping[str, int]) -> str | None:
        """Return a sentence on a sensor that went silent or whose messages are mostly not used."""
        trouble, now = None, self.now()
        for stream, sensor in SENSORS.items():
            topic = sensor.topics[0][0]
            new = self.received[stream] - self._received_before[stream]
            if new or stream not in self._heard:
                self._heard[stream] = now
            reasons = {
                "rejected": (
                    "contradict everything else and are not used: check the sensor, "
                    f"{sensor.remedy}"
                ),
                "late": f"are late: check its stamps, or raise lag (now {self._lag} s)",
                "invalid": f"are invalid: {sensor.invalid}",
            }
            if self.received[stream] and now - self._heard[stream] > STOPPED:
                trouble = (
                    f"no messages on {topic} any more: done without; check the sensor and its "
                    "driver"
                )
                continue
            for reason, words in reasons.items():
                name = f"{stream}_{reason}"
                unused = counts[name] - self._counts_before[name]
                bad = unused > LARGEST_UNUSED * new
                self._bad[stream, reason] = self._bad[stream, reason] + 1 if bad else 0
                if self._bad[stream, reason] >= REPEATS:
                    trouble = f"more than half of the messages on {topic} {words}"
        self._received_before, self._counts_before = Counter(self.received), Counter(counts)
        return trouble


def off_the_clock(behind: float | None) -> str | None:
    """Return a sentence on an odometry that is too old or in the future, or None.

    behind : s from the stamp of the newest odometry to the current time; None without odometry
    """
    if behind is None or not BEHIND[0] < abs(behind) < BEHIND[1]:
        return None
    if behind > 0.0:
        reason = "this machine is too slow, the data come late, or clocks differ"
        return f"the odometry is {behind:.1f} s behind the clock: {reason}"
    return f"the odometry is {-behind:.1f} s ahead of the clock: correct the stamps, or the clock"


def _worst(wiring: Sequence[str], findings: Sequence[Finding]) -> tuple[bytes, str]:
    """Return (level, text) of all problems, the most severe first."""
    severe = [finding for finding in findings if finding.severity == SEVERE]
    said = [
        *(f.sentence for f in severe),
        *wiring,
        *(f.sentence for f in findings if f not in severe),
    ]
    return ERROR if severe else WARN, together(said)


def together(sentences: Sequence[str]) -> str:
    """Return one text with the first MOST_SAID of several sentences."""
    more = len(sentences) - MOST_SAID
    return " | ".join([*sentences[:MOST_SAID], *([f"and {more} more"] if more > 0 else [])])


def _behind(seconds: float | None) -> str:
    if seconds is None:
        return "unknown"
    if abs(seconds) > BEHIND[1]:
        return (
            "not comparable: the stamps are of another time than the clock; for a recording set "
            "use_sim_time"
        )
    return f"{seconds:.3f} s"
