"""The range finder measures with a wrong length."""

from __future__ import annotations

import numpy as np

from .affine import Affine
from .aid_error import AidEffect


class HeightScale(AidEffect):
    """Measured range = (1 + `scale`) true one."""

    name = "height_scale"
    unit = "1"
    bound = 0.5
    negligible = 0.005
    typical = 0.05
    example = "scale"
    physics = "a wrong unit or speed of propagation: of ultrasound, with the temperature of the air"
    confounded_with = ("height_offset",)
    distinguished_by = {"height_offset": "a flight at several heights: a scale grows with height"}
    reference = "speed of sound: 0.18 % per degree"
    channels = ("height",)

    def aid(self) -> Affine:
        return Affine((1.0 + self.values.get("scale", 0.0)) * np.eye(1), np.zeros(1))

    def advice(self) -> tuple[str, ...]:
        off = self.directed("scale", "too long", "too short", "%", 100.0)
        return (
            (f"Check the unit and the calibration of the range finder: it reads {off}.",)
            if off
            else ()
        )
