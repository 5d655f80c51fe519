"""All ranges are too long by one factor."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .base import Effect
from .samples import RADIO

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .samples import Samples


class RangeScale(Effect):
    """d_ab is measured as (1 + scale) d_ab, and so are ranges."""

    name = "range_scale"
    unit = "1"
    bound = 0.5
    negligible = 0.002
    typical = 0.02
    example = "scale"
    physics = (
        "the tag converts ticks to metres with a wrong length: a wrong clock frequency, speed of "
        "propagation or unit"
    )
    confounded_with = ("range_bias", "anchor_position", "truth_frame")
    covariates = ("range",)
    channels = tuple(RADIO)
    reference = "DW1000 user manual: one tick is 15.65 ps, 4.69 mm"

    def bias(self, samples: Samples) -> np.ndarray:
        return self.values.get("scale", 0.0) * samples.true()

    def regressors(self, samples: Samples, keys: Sequence[str]) -> np.ndarray:
        return np.repeat(samples.true()[:, None], len(keys), axis=1)

    def advice(self) -> tuple[str, ...]:
        off = self.directed("scale", "too large", "too small", "%", 100.0)
        return (f"Check how the tag turns ticks into metres: everything is {off}.",) if off else ()
