"""The IMU is not mounted along the body's axes."""

from __future__ import annotations

import numpy as np

from ..foundation.later import rotations
from .affine import Affine
from .imu_error import ImuEffect
from .wording import listed, measured


class ImuMisalignment(ImuEffect):
    """The IMU's axes are the body's, turned by the rotation vector (x, y, z): it measures R^T of
    what the body feels.
    """

    name = "imu_misalignment"
    unit = "rad"
    bound = 0.6
    negligible = 0.004
    typical = 0.05
    example = "x"
    physics = "the sensor, or the frame of the ground truth, is turned against the body's axes"
    confounded_with = ("accel_bias", "gyro_scale")
    distinguished_by = {
        "accel_bias": "quick turns: a misalignment also shows on the gyroscope",
    }
    reference = "strapdown navigation: mounting misalignment"
    channels = ("gyro", "accel")

    def _turn(self) -> Affine:
        return Affine(rotations.Rotation.from_rotvec(self.vector()).as_matrix().T, np.zeros(3))

    def gyro(self) -> Affine:
        return self._turn()

    def accel(self) -> Affine:
        return self._turn()

    def advice(self) -> tuple[str, ...]:
        turns = {
            key: (
                f"{measured(-np.degrees(value), np.degrees(self.std.get(key, 0.0)), 'degrees')} "
                f"about {key}"
            )
            for key, value in self.significant().items()
        }
        if not turns:
            return ()
        back = listed(turns[key] for key in sorted(turns))
        return (
            (
                f"Turn the IMU by {back}: its axes are not those of the body as the ground truth "
                "has it."
            ),
        )
