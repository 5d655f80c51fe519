"""The velocity is measured with a wrong length."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .affine import Affine
from .aid_error import AidEffect
from .wording import significant, size

if TYPE_CHECKING:
    from ..foundation.anchors import Anchors


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
    reference = "Borenstein and Feng, IEEE Trans. Robotics and Automation 12, 1996: systematic errors of odometry"
    channels = ("velocity",)

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        return [("scale",)]

    def aid(self) -> Affine:
        return Affine((1.0 + self.values.get("scale", 0.0)) * np.eye(3), np.zeros(3))

    def advice(self) -> tuple[str, ...]:
        if not significant(self):
            return ()
        way = "fast" if self.values["scale"] > 0.0 else "slow"
        scale = size(self, "scale", "%", 100.0)
        what = "over a known distance (radius of the wheels, focal length)"
        return (f"Calibrate the velocity {what}: it is {scale} too {way}.",)
