"""The velocity, or the yaw rate of wheels, is measured with a wrong length."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from .affine import Affine
from .aid_error import AidEffect


class VelocityScale(AidEffect):
    """Measured velocity = (1 + `scale`) true one."""

    name = "velocity_scale"
    unit = "1"
    bound = 0.9
    negligible = 0.005
    typical = 0.1
    example = "scale"
    physics = "a wheel of another radius, a wrong focal length or height of optical flow"
    confounded_with: ClassVar[tuple[str, ...]] = ("velocity_slip",)
    distinguished_by = {"velocity_slip": "a longer flight: a scale stays, slip ends"}
    reference = (
        "Borenstein and Feng, IEEE Trans. Robotics and Automation 12, 1996: systematic errors of "
        "odometry"
    )
    channels = ("velocity",)
    axes: ClassVar[int] = 3
    remedy: ClassVar[str] = (
        "Calibrate the velocity over a known distance (radius of the wheels, focal length)"
    )

    def aid(self) -> Affine:
        scale = 1.0 + self.values.get("scale", 0.0)
        return Affine(scale * np.eye(self.axes), np.zeros(self.axes))

    def advice(self) -> tuple[str, ...]:
        off = self.directed("scale", "too fast", "too slow", "%", 100.0)
        return (f"{self.remedy}: it is {off}.",) if off else ()


class YawRateScale(VelocityScale):
    """Measured yaw rate = (1 + `scale`) true one."""

    name = "yaw_rate_scale"
    physics = "the driver of the wheels assumes a wrong track width, or a wrong radius"
    confounded_with = ()
    distinguished_by = {}
    channels = ("yaw_rate",)
    axes = 1
    remedy = "Calibrate the yaw rate over known turns (track width, radius of the wheels)"
