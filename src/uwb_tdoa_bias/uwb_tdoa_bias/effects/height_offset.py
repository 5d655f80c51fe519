"""The range finder reads too long, or sits above the origin of the body frame."""

from __future__ import annotations

import numpy as np

from .affine import Affine
from .aid_error import AidEffect


class HeightOffset(AidEffect):
    """Measured range = true one from the origin of the body frame + `offset`. The filter's
    `height_arm` is the same with the other sign: set one of them.
    """

    name = "height_offset"
    unit = "m"
    bound = 2.0
    negligible = 0.005
    typical = 0.1
    example = "offset"
    physics = (
        "the range finder reads too long, or is mounted above the origin of the body frame along "
        "its z"
    )
    confounded_with = ("height_scale",)
    distinguished_by = {
        "height_scale": "a flight at several heights: an offset is the same at all of them"
    }
    reference = "VL53L1X data sheet: offset calibration, up to some centimetres"
    channels = ("height",)

    def aid(self) -> Affine:
        return Affine(np.eye(1), np.array([self.values.get("offset", 0.0)]))

    def advice(self) -> tuple[str, ...]:
        off = self.directed("offset", "too long", "too short")
        return (
            (f"Check where the range finder is mounted, and its offset: it reads {off}.",)
            if off
            else ()
        )
