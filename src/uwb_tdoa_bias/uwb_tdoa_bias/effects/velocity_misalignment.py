"""The velocity sensor is turned about the vertical axis of the body."""

from __future__ import annotations

import math

import numpy as np

from .affine import Affine
from .aid_error import AidEffect


class VelocityMisalignment(AidEffect):
    """The axes of the velocity are the body's, turned by `yaw` about z: it measures R_z(yaw)^T of
    the velocity in the body frame.
    """

    name = "velocity_misalignment"
    unit = "rad"
    bound = math.pi
    negligible = 0.005
    typical = 0.1
    example = "yaw"
    physics = (
        "the camera, the flow sensor or the axes of the wheels are turned against the body's axes"
    )
    reference = (
        "Borenstein and Feng, IEEE Trans. Robotics and Automation 12, 1996: misalignment of wheels"
    )
    channels = ("velocity",)

    def aid(self) -> Affine:
        yaw = self.values.get("yaw", 0.0)
        cos, sin = math.cos(yaw), math.sin(yaw)
        return Affine(np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))

    def advice(self) -> tuple[str, ...]:
        if not self.significant():
            return ()
        way = "counterclockwise" if self.values["yaw"] > 0.0 else "clockwise"
        angle = self.size("yaw", "degrees", math.degrees(1.0))
        return (
            (
                f"Turn the velocity sensor, or its frame: seen from above it is turned {way} by "
                f"{angle}."
            ),
        )
