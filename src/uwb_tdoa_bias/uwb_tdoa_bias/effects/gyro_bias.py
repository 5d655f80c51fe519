"""The gyroscope reads something at rest."""

from __future__ import annotations

import numpy as np

from .affine import Affine
from .imu_error import ImuEffect, readings


class GyroBias(ImuEffect):
    """Measured rate = true rate + (x, y, z), body axes."""

    name = "gyro_bias"
    unit = "rad/s"
    bound = 1.0
    negligible = 0.002
    typical = 0.05
    example = "z"
    physics = "zero-rate offset of a MEMS gyroscope, with temperature and age"
    reference = "BMI088 data sheet: zero-rate offset 1 degree/s"
    channels = ("gyro",)

    def gyro(self) -> Affine:
        return Affine(np.eye(3), self.vector())

    def advice(self) -> tuple[str, ...]:
        found = readings(self, "about")
        return (
            (f"Let the gyroscope find its zero at rest before take-off: it reads {found}.",)
            if found
            else ()
        )
