"""The gyroscope reads too much or too little."""

from __future__ import annotations

import numpy as np

from .affine import Affine
from .imu_error import ImuEffect, readings


class GyroScale(ImuEffect):
    """Measured rate = (1 + (x, y, z)) true rate, axis by axis."""

    name = "gyro_scale"
    unit = "1"
    bound = 0.5
    negligible = 0.01
    typical = 0.05
    example = "z"
    physics = "sensitivity error of a MEMS gyroscope"
    confounded_with = ("truth_time_offset", "imu_misalignment")
    reference = "BMI088 data sheet: sensitivity tolerance 1 %"
    channels = ("gyro",)

    def gyro(self) -> Affine:
        return Affine(np.eye(3) + np.diag(self.vector()), np.zeros(3))

    def advice(self) -> tuple[str, ...]:
        found = readings(self, "about", "%", 100.0)
        return (f"Calibrate the gyroscope on a turntable: it reads {found}.",) if found else ()
