"""The range finder reads too long, or sits above the origin of the body frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .affine import Affine
from .aid_error import AidEffect
from .wording import significant, size

if TYPE_CHECKING:
    from ..foundation.anchors import Anchors


class HeightOffset(AidEffect):
    """Measured range = true one from the origin of the body frame + `offset`. The filter's `height_arm` is the same with
    the other sign: set one of them."""

    name = "height_offset"
    unit = "m"
    bound = 2.0
    negligible = 0.005
    typical = 0.1
    example = "offset"
    physics = "the range finder reads too long, or is mounted above the origin of the body frame along its z"
    confounded_with = ("height_scale",)
    distinguished_by = {"height_scale": "a flight at several heights: an offset is the same at all of them"}
    reference = "VL53L1X data sheet: offset calibration, up to some centimetres"
    channels = ("height",)

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        return [("offset",)]

    def aid(self) -> Affine:
        return Affine(np.eye(1), np.array([self.values.get("offset", 0.0)]))

    def advice(self) -> tuple[str, ...]:
        if not significant(self):
            return ()
        way = "long" if self.values["offset"] > 0.0 else "short"
        return (f"Check where the range finder is mounted, and its offset: it reads {size(self, 'offset')} too {way}.",)
