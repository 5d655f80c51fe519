"""The accelerometer is off by a constant."""

from __future__ import annotations

import numpy as np

from .affine import Affine
from .imu_error import ImuEffect, readings


class AccelBias(ImuEffect):
    """Measured force = true specific force + (x, y, z), body axes."""

    name = "accel_bias"
    unit = "m/s^2"
    bound = 10.0
    negligible = 0.03
    typical = 0.5
    example = "x"
    physics = "zero-g offset of a MEMS accelerometer, and vibration that it rectifies"
    confounded_with = ("imu_misalignment", "imu_gravity", "accel_scale")
    reference = "BMI088 data sheet: zero-g offset 20 mg"
    channels = ("accel",)
    sizable_share = 0.3  # one axis: a scale of the others would take their place

    def accel(self) -> Affine:
        return Affine(np.eye(3), self.vector())

    def advice(self) -> tuple[str, ...]:
        found = readings(self, "along")
        return (
            (
                (
                    "Calibrate the accelerometer at rest and damp the vibration of its mount: it "
                    f"reads {found}."
                ),
            )
            if found
            else ()
        )
