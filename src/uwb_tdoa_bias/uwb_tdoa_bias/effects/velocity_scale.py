"""The velocity is measured with a wrong length."""

from __future__ import annotations

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
    confounded_with = ("velocity_slip",)
    distinguished_by = {"velocity_slip": "a longer flight: a scale stays, slip ends"}
    reference = (
        "Borenstein and Feng, IEEE Trans. Robotics and Automation 12, 1996: systematic errors of "
        "odometry"
    )
    channels = ("velocity",)

    def aid(self) -> Affine:
        return Affine((1.0 + self.values.get("scale", 0.0)) * np.eye(3), np.zeros(3))

    def advice(self) -> tuple[str, ...]:
        off = self.directed("scale", "too fast", "too slow", "%", 100.0)
        return (
            (
                (
                    "Calibrate the velocity over a known distance (radius of the wheels, focal "
                    f"length): it is {off}."
                ),
            )
            if off
            else ()
        )
