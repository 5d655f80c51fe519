"""The stamps of the velocity are late."""

from __future__ import annotations

from .stamp_error import StampEffect


class VelocityDelay(StampEffect):
    """Velocities are stamped `offset` seconds after the instant they were taken at.

    Corrected by moving the stamps.
    """

    name = "velocity_delay"
    stream = "velocity"
    physics = (
        "images take time to be exposed, read and compared; odometry is stamped when it is computed"
    )
    remedy = "Stamp the velocity when it is measured: it is stamped {}."
    confounded_with = ("truth_time_offset",)
    distinguished_by = {
        "truth_time_offset": "a late truth shows in the gyroscope and the TDOAs too"
    }
    reference = (
        "Li and Mourikis, Int. J. Robotics Research 33, 2014: online temporal calibration of "
        "camera and IMU"
    )
    channels = ("velocity", "yaw_rate")
