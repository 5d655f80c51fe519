"""Some TDOAs are plainly wrong."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .base import Effect

if TYPE_CHECKING:
    from ..foundation.flight import Flight


class OutlierRate(Effect):
    """A `share` of the TDOAs is wrong by something else: 0.5 to 5 m, either sign. The filter's
    robust weights are the remedy; there is nothing to subtract.
    """

    name = "outlier_rate"
    unit = "1"
    bound = 1.0
    negligible = 0.02
    typical = 0.05
    example = "share"
    physics = (
        "lost or mixed-up packets and reflections: single measurements that have nothing to do "
        "with the geometry"
    )
    confounded_with = ("noise_level",)
    reference = "crazyflie-firmware issues 277, 305, 375"
    portable = False
    fitted = False
    usable = False  # the filter's weights are the remedy

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        rng, tdoa = rng or np.random.default_rng(), flight.tdoa
        hit = rng.random(len(tdoa)) < self.values.get("share", 0.0)
        size = np.copysign(rng.uniform(0.5, 5.0, len(tdoa)), rng.uniform(-1.0, 1.0, len(tdoa)))
        return replace(flight, tdoa=replace(tdoa, d=tdoa.d + np.where(hit, size, 0.0)))

    def advice(self) -> tuple[str, ...]:
        if not self.significant():
            return ()
        share = self.size("share", "%", 100.0)
        return (
            (
                f"Look for lost or mixed-up packets and for reflections: {share} of the TDOAs are "
                "plainly wrong."
            ),
        )
