"""The velocity is lost for a while."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .interval_error import IntervalEffect

if TYPE_CHECKING:
    import numpy as np

    from .samples import AidSamples


class VelocitySlip(IntervalEffect):
    """A share "N.share" of the velocity is missing from "N.start" to "N.end" seconds after the
    first TDOA.
    """

    name = "velocity_slip"
    part = "share"
    unit = "1, s"
    bound = 10.0
    negligible = 0.05
    typical = 0.5
    example = "1.share"
    physics = "wheels slip or spin, a camera loses its features and says that it stands still"
    confounded_with = ("velocity_scale",)
    distinguished_by = {"velocity_scale": "a longer flight: slip ends, a scale stays"}
    reference = (
        "Borenstein and Feng, IEEE Trans. Robotics and Automation 12, 1996: non-systematic errors "
        "of odometry"
    )
    channels = ("velocity",)

    def per_unit(self, samples: AidSamples) -> np.ndarray:
        return -samples.reading

    def advice(self) -> tuple[str, ...]:
        return tuple(
            f"Look for slip of the wheels or lost features{when}: the velocity was {size} too "
            f"{'small' if value > 0.0 else 'large'}."
            for value, size, when in self.significant_sizes("%", 100.0)
        )
