# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Decide what ekf_node publishes on /diagnostics about itself, with the remedy."""

from __future__ import annotations

from collections import Counter
import time
from typing import TYPE_CHECKING

from diagnostic_msgs.msg import DiagnosticStatus
import numpy as np

from uwb_tdoa_bias.common.sensors import LOCATING, SENSORS
from uwb_tdoa_bias.ros.diagnostics import Rate

from .finding import ERROR as SEVERE
from .status import LARGEST_UNUSED, Use, VolumeCheck

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from uwb_tdoa_bias.common.flyable import FlyableVolume
    from uwb_tdoa_bias.ros.diagnostics import Report

    from ..core.config import FilterConfig
    from ..estimator import Estimator
    from .finding import Finding

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
        self, config: FilterConfig, lag: float, volume: FlyableVolume | None = None
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
        """
        # messages of each stream: imu, tdoa, and the SENSORS
        self.received: Counter[str] = Counter()
        self.last_odometry: float | None = None  # time.monotonic(), s
        # (3,) m, and its covariance (3, 3) m^2
        self.last_position: tuple[np.ndarray, np.ndarray] | None = None
        # s from the stamp of the newest odometry to the current ROS time
        self.behind: float | None = None
        self._use_imu, self._lag = config.use_imu, lag
        self._volume = VolumeCheck(volume)
        self._imu_rate, self._tdoa_rate, self._located_rate = Rate(), Rate(), Rate()
        self._sensors_before: dict[
            str, dict[str, int]
        ] = {}  # by sensor: messages received and not used at the last report
        self._sensors_bad: dict[
            tuple[str, str], int
        ] = {}  # consecutive reports in which most messages of a sensor were not used, by reason
        self._sensors_heard: dict[
            str, tuple[int, float]
        ] = {}  # by sensor: messages so far, and time.monotonic() of the last change, s
        self._starting: float | None = None  # time.monotonic(), s
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
        self.use.look(
            time.monotonic(), self.received, counts, estimator is not None and estimator.running
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
        now = time.monotonic()
        self.look(estimator, counts)
        imu_rate, tdoa_rate = (
            self._imu_rate.of(self.received["imu"]),
            self._tdoa_rate.of(self.received["tdoa"]),
        )
        located = self._located_rate.of(
            self.received["tdoa"] + sum(self.received[name] for name in LOCATING)
        )
        running = estimator is not None and estimator.running
        if running or not located:
            self._starting = None
        elif self._starting is None:
            self._starting = now
        status: tuple[bytes, str]
        if refused:
            status = ERROR, refused
        elif estimator is None:
            status = (
                ERROR,
                "no anchors yet: publish them on uwb/anchors, reliable and transient local",
            )
        elif not located:
            status = (
                ERROR,
                (
                    "no TDOAs on uwb/tdoa_corrected: start bias_node in this namespace and the "
                    "tag's driver"
                ),
            )
        elif self._use_imu and not imu_rate:
            status = (
                ERROR,
                "no samples on imu/data: check the IMU's driver, or set use_imu to false",
            )
        elif wiring or findings:
            status = _worst(wiring, findings)
        elif running:
            status = (WARN, self.use.trouble) if self.use.trouble else (OK, "running")
        elif estimator.lost:
            status = WARN, estimator.lost
        elif self._starting is not None and now - self._starting > START_TIMEOUT:
            status = WARN, self.use.trouble or self._no_start()
        else:
            status = OK, "looking for the start position"
        if status == (OK, "running"):
            status = self._status_of_sensors(now, counts)
        if status == (OK, "running") and estimator is not None and estimator.side_unknown:
            status = WARN, estimator.side_unknown
        at_position: dict[str, str] = {}
        if estimator is not None and running and self.last_position is not None:
            trouble, at_position = self._volume.trouble_at(estimator.anchors, *self.last_position)
            if trouble and status[0] == OK:
                status = WARN, trouble
        if (
            running
            and self.behind is not None
            and BEHIND[0] < self.behind < BEHIND[1]
            and status[0] == OK
        ):
            reason = "this machine is too slow for all it receives, or clocks differ"
            status = WARN, f"the odometry is {self.behind:.1f} s behind: {reason}"
        if (
            running
            and self.behind is not None
            and -BEHIND[1] < self.behind < -BEHIND[0]
            and status[0] == OK
        ):
            status = (
                WARN,
                (
                    f"the odometry is {-self.behind:.1f} s ahead of the clock: correct the "
                    "stamps, or the clock"
                ),
            )
        age = "none yet" if self.last_odometry is None else f"{now - self.last_odometry:.3f} s"
        state = (
            "running"
            if running
            else "lost"
            if estimator is not None and estimator.lost
            else "starting"
        )
        values = {"state": state, "age of last odometry": age}
        values |= {"odometry behind the clock": _behind(self.behind)}
        values |= {"IMU rate": f"{imu_rate:.1f} Hz", "TDOA rate": f"{tdoa_rate:.1f} Hz"}
        sentences = [*wiring, *(finding.sentence for finding in findings)]
        values |= {"wrong with the streams": "; ".join(sentences) or "nothing"}
        values |= {f"found {finding.rule}": f"{finding.value:.4g}" for finding in findings}
        return *status, values | at_position

    def _status_of_sensors(self, now: float, counts: Mapping[str, int]) -> tuple[bytes, str]:
        """Return the status of sensors that went silent or whose messages are mostly not used."""
        status = OK, "running"
        for stream, sensor in SENSORS.items():
            received = self.received[stream]
            heard, since = self._sensors_heard.get(stream, (0, now))
            if received != heard:
                since = now
            self._sensors_heard[stream] = received, since
            reasons = {
                "rejected": (
                    "contradict everything else and are not used: check the sensor, "
                    f"{sensor.remedy}"
                ),
                "late": f"are late: check its stamps, or raise lag (now {self._lag} s)",
                "invalid": f"are invalid: {sensor.invalid}",
            }
            totals = {"received": received} | {
                reason: counts[f"{stream}_{reason}"] for reason in reasons
            }
            before = self._sensors_before.get(stream, dict.fromkeys(totals, 0))
            recent = {name: total - before[name] for name, total in totals.items()}
            self._sensors_before[stream] = totals
            if received and now - since > STOPPED:
                status = (
                    WARN,
                    (
                        f"no messages on {sensor.topics[0][0]} any more: done without; check the "
                        "sensor and its driver"
                    ),
                )
                continue
            for reason, words in reasons.items():
                bad = recent[reason] > LARGEST_UNUSED * recent["received"]
                repeats = self._sensors_bad[stream, reason] = (
                    self._sensors_bad.get((stream, reason), 0) + 1 if bad else 0
                )
                if repeats >= REPEATS:
                    status = (
                        WARN,
                        f"more than half of the messages on {sensor.topics[0][0]} {words}",
                    )
        return status

    def _no_start(self) -> str:
        """Return a sentence on why the filter does not initialize."""
        if self.use.restart_age < START_TIMEOUT:
            return (
                "the filter starts anew again and again, because stamps of a stream fall back: "
                "see restarts, and correct its clock"
            )
        return (
            "no start position found: check ids and positions of the anchors, and that four are "
            "heard"
        )


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
