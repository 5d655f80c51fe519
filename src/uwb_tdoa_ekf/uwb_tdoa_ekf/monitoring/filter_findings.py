# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Make Findings of the estimator itself: clocks of streams, and implausible inertial samples."""

from __future__ import annotations

from typing import TYPE_CHECKING

from uwb_tdoa_bias.common.sensors import SENSORS

from ..core.imu_fault_detector import RATE, TILT, TURN, WEIGHT
from .finding import ERROR, WARNING, Finding

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.compiled import Record

    from ..reorder_buffer import Restart


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
