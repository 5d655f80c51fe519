"""The ground below the tag is not where the floor is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .interval_error import IntervalEffect

if TYPE_CHECKING:
    import numpy as np

    from .samples import AidSamples


class FloorStep(IntervalEffect):
    """The ground below is "N.height" metres above z = 0 from "N.start" to "N.end" seconds after the
    first TDOA.
    """

    name = "floor_step"
    part = "height"
    unit = "m, s"
    bound = 20.0
    negligible = 0.02
    typical = 0.3
    example = "1.height"
    physics = "a step, a box, a table or a person below: the range finder measures down to that"
    confounded_with = ("height_offset",)
    distinguished_by = {
        "height_offset": "a flight over other places: an offset is the same everywhere"
    }
    reference = "geometry"
    channels = ("height",)

    def per_unit(self, samples: AidSamples) -> np.ndarray:
        return -1.0 / samples.up[:, None]

    def advice(self) -> tuple[str, ...]:
        return tuple(
            (
                f"Look what lay below the tag{when}: the ground was {size} "
                f"{'higher' if value > 0.0 else 'lower'}."
            )
            for value, size, when in self.significant_sizes("m")
        )
