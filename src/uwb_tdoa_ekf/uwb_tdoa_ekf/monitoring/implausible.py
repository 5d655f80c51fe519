"""What is said of inertial samples that the filter goes without, see core/plausibility.py."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..core.plausibility import RATE, TILT, TURN, WEIGHT
from ..streams import ERROR, Finding

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.compiled import Record

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
    """The Finding of a PLAUSIBILITY by which inertial samples are left out."""
    cause, evidence, remedy = SAID[int(check.reason)]
    cause = f"{cause}: the filter goes without the IMU"
    size = float(check["size"])  # of a numpy record, `.size` is how many it is
    return Finding("imu_left_out", ERROR, cause, evidence.format(size), remedy, size)
