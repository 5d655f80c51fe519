"""The accelerometer reads too much or too little."""

from __future__ import annotations

import numpy as np

from .affine import Affine
from .imu_error import BESIDE_BIAS, ImuEffect, readings


class AccelScale(ImuEffect):
    """Measured force = (1 + (x, y, z)) true specific force, axis by axis."""

    name = "accel_scale"
    unit = "1"
    bound = 0.5
    negligible = 0.004
    typical = 0.05
    example = "z"
    physics = "sensitivity error of a MEMS accelerometer"
    confounded_with = ("accel_bias", "imu_gravity")
    distinguished_by = {
        "accel_bias": "hard manoeuvres: a scale grows with them, a bias does not",
    }
    reference = "BMI088 data sheet: sensitivity tolerance 0.7 %"
    channels = ("accel",)
    price = BESIDE_BIAS

    def accel(self) -> Affine:
        return Affine(np.eye(3) + np.diag(self.vector()), np.zeros(3))

    def advice(self) -> tuple[str, ...]:
        found = readings(self, "along", "%", 100.0)
        return (
            (f"Calibrate the accelerometer, each axis up and down: it reads {found}.",)
            if found
            else ()
        )
