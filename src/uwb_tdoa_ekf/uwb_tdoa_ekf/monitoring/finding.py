# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Define the Finding, the result of a rule that detects a problem."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
import math
from typing import Any, NamedTuple

from uwb_tdoa_bias.common.compiled import Record
from uwb_tdoa_bias.common.sensors import SENSORS

from ..core.imu_fault_detector import MOTION, RATE, TILT, TURN, WEIGHT
from ..reorder_buffer import Restart

# ERROR: the estimate is wrong. WARNING: it may be worse than possible. NOTE: information.
ERROR, WARNING, NOTE = "error", "warning", "note"
SEVERITIES = (ERROR, WARNING, NOTE)
# ERRORs that make the position wrong and its stated covariance too small. Rules whose names begin
# with SURVEY also belong to these.
POSITION_WRONG = frozenset(
    [
        "tdoa_sign",
        "tdoa_one_sign",
        "tdoa_large",
        "tdoa_unit",
        "two_tags",
        "ids_unknown",
        "ids_exchanged",
        "anchor_scale",
        "tdoa_clipped",
        "tdoa_frozen",
        "stamps_unit",
        "stamps_coarse",
    ]
)
SURVEY = "survey"
WRONG_WITH_IMU = frozenset(  # ERRORs that make the position wrong while the filter uses the IMU
    [
        "imu_force_unit",
        "imu_no_gravity",
        "imu_rate_unit",
        "imu_turned",
        "imu_axes",
        "imu_other_body",
        "gyro_axes",
        "accel_axes",
        "imu_silent",
        "imu_in_turns",
        "imu_axis_dead",
        "stamps_apart",
    ]
)
# relative change of the deciding number up to which a persistent finding keeps its text
SAME = 0.3
# share of TDOAs with unknown ids, which are not used; below it the other TDOAs determine the
# position
FEW_UNKNOWN = 0.5


@dataclass(frozen=True)
class Finding:
    """Describe one detected problem.

    Attributes
    ----------
    rule : str
        Name of the rule, for machines.
    severity : str
        Value from SEVERITIES.
    cause : str
        The problem, as a clause.
    evidence : str
        The numbers that show it.
    remedy : str
        A line to copy.
    value : float
        The number that decided, in SI units.
    """

    rule: str
    severity: str
    cause: str
    evidence: str
    remedy: str
    value: float

    @property
    def sentence(self) -> str:
        """Return cause, evidence and remedy in one line for /diagnostics."""
        return f"{self.cause} ({self.evidence}): {' '.join(self.remedy.split())}"

    @property
    def brief(self) -> str:
        """Return cause and remedy in one line."""
        return f"{self.cause}: {' '.join(self.remedy.split())}"

    def position_wrong(self, imu_used: bool = True) -> bool:
        """Return whether this problem makes the position wrong.

        Parameters
        ----------
        imu_used : bool
            Whether the filter uses the IMU.
        """
        if self.severity != ERROR or (self.rule == "ids_unknown" and self.value < FEW_UNKNOWN):
            return False
        return (
            self.rule in POSITION_WRONG
            or self.rule.startswith(SURVEY)
            or (imu_used and self.rule in WRONG_WITH_IMU)
        )


class Limit(NamedTuple):
    """A rule that compares one share of the messages in windows with a limit.

    Attributes
    ----------
    rule, severity, cause, evidence, remedy : str
        As of the Finding; "{}" in the evidence is the share in percent.
    limit : float
        Largest healthy share, 0 to 1.
    share : callable
        share(windows) is the share.
    """

    rule: str
    severity: str
    cause: str
    evidence: str
    remedy: str
    limit: float
    share: Callable[[Any], float]

    def __call__(self, windows: Any) -> Iterator[Finding]:
        """Yield a Finding if the share exceeds the limit."""
        share = self.share(windows)
        if share > self.limit:
            evidence = self.evidence.format(100.0 * share)
            yield Finding(self.rule, self.severity, self.cause, evidence, self.remedy, share)


def most_severe_first(findings: Iterable[Finding]) -> list[Finding]:
    """Return the findings in order of severity, and in the given order within one severity."""
    return sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))


def explained_by(findings: Iterable[Finding], explains: Mapping[str, Collection[str]]) -> set[str]:
    """Return the rules whose findings other findings explain.

    Parameters
    ----------
    findings : iterable of Finding
        Findings that hold.
    explains : mapping
        {rule: rules that its finding explains}.
    """
    return {rule for finding in findings for rule in explains.get(finding.rule, ())}


class Steady:
    """Keep the text of a finding that persists, because its numbers would change every second."""

    def __init__(self) -> None:
        self._said: dict[
            tuple[str, str], Finding
        ] = {}  # {(rule, severity): Finding with the first text}

    def __call__(self, findings: Iterable[Finding]) -> list[Finding]:
        """Return the findings, each with its first text while its number changes little."""
        out = []
        for finding in findings:
            said = self._said.get((finding.rule, finding.severity), finding)
            alike = math.isclose(said.value, finding.value, rel_tol=SAME)
            unknown = math.isnan(said.value) and math.isnan(finding.value)
            out.append(said if alike or unknown else finding)
        self._said = {(finding.rule, finding.severity): finding for finding in out}
        return out


TOPICS = {"imu": "imu/data", "tdoa": "uwb/tdoa"} | {
    name: sensor.topics[0][0] for name, sensor in SENSORS.items()
}  # topic by stream
STAMP_LINE = (
    "message.header.stamp = ...  # when the sample was measured, by the clock of the other streams"
)


def clock_ahead(stream: str, lead: float, count: int) -> Finding:
    """Return the Finding on a stream whose clock is ahead.

    Parameters
    ----------
    stream : str
        Name from STREAMS.
    lead : float
        Lead over the other streams, in s.
    count : int
        Invalid messages of the stream so far.
    """
    return Finding(
        "clock_ahead",
        WARNING,
        cause=(
            f"the stamps of {TOPICS[stream]} are {lead:.3g} s ahead of those of the other streams; "
            "its messages are not used"
        ),
        evidence=f"{count} invalid messages so far",
        remedy=STAMP_LINE,
        value=lead,
    )


def restarted(cause: Restart) -> Finding:
    """Return the Finding for a Restart: the stamps fell back, or other streams had run ahead.

    Its value is the step, s, below 0.
    """
    topic = TOPICS[cause.stream]
    how = "are behind those of the other streams" if cause.overtaken else "fell back"
    return Finding(
        "restarted",
        WARNING,
        cause=(
            f"the filter has started anew, because the stamps of {topic} {how} by "
            f"{-cause.step:.3g} s"
        ),
        evidence=(
            f"the new time begins at {cause.at:.3f} s, from the whole second of the first stamp on"
        ),
        remedy=(
            "keep the clocks of all drivers in step (chronyc tracking); replaying a recording also "
            "causes this"
        ),
        value=cause.step,
    )


SAID = {
    WEIGHT: (
        "what the accelerometer reads is not gravity",
        "a specific force of {:.3g} m/s^2, where 9.81 is expected",
        "linear_acceleration = ...  # the specific force, with gravity, in m/s^2",
    ),
    TURN: (
        "gyroscope and accelerometer contradict each other",
        (
            "where the gyroscope has turned upwards to, the specific force is {:+.1f} m/s^2, and "
            "9.81 is expected"
        ),
        "angular_velocity = ...  # in rad/s, and the axes of both sensors x forward, y left, z up",
    ),
    RATE: (
        "the gyroscope turns as nothing does",
        "{:.0f} rad/s",
        "angular_velocity = ...  # in rad/s",
    ),
    MOTION: (
        "TDOAs contradict the motion that the IMU measures",
        "they agree on a place {:.1f} m away, or on another yaw, again and again",
        "angular_velocity, linear_acceleration = ...  # check axes, signs, scales and offsets",
    ),
    TILT: (
        "the IMU is turned, or the tag lies on its side",
        "the specific force along z is {:+.1f} m/s^2, where +9.81 is expected",
        "x, y, z = ...  # of both sensors: x forward, y left, z up",
    ),
}


def implausible(check: Record) -> Finding:
    """Return the Finding for the imu_fault_detector of a filter that ignores the IMU."""
    cause, evidence, remedy = SAID[int(check.reason)]
    size = float(check["size"])  # `.size` of a numpy record is its number of elements
    return Finding(
        "imu_left_out",
        ERROR,
        cause=f"{cause}: the filter goes without the IMU",
        evidence=evidence.format(size),
        remedy=remedy,
        value=size,
    )
