"""The stamps of the velocity are late."""

from __future__ import annotations

from .stamp_error import StampEffect
from .wording import significant, size


class VelocityDelay(StampEffect):
    """Velocities are stamped `offset` seconds after the instant they were taken at. Corrected by moving the stamps."""

    name = "velocity_delay"
    stream = "velocity"
    unit = "s"
    bound = 1.0
    negligible = 0.002
    typical = 0.05
    example = "offset"
    physics = "images take time to be exposed, read and compared; odometry is stamped when it is computed"
    confounded_with = ("truth_time_offset",)
    distinguished_by = {"truth_time_offset": "a late truth shows in the gyroscope and the TDOAs too"}
    reference = "Li and Mourikis, Int. J. Robotics Research 33, 2014: online temporal calibration of camera and IMU"
    channels = ("velocity",)

    def advice(self) -> tuple[str, ...]:
        if not significant(self):
            return ()
        way = "late" if self.values["offset"] > 0.0 else "early"
        return (f"Stamp the velocity when it is measured: it is stamped {size(self, 'offset', 'ms', 1e3)} {way}.",)
