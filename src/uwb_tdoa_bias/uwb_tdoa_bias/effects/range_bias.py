"""The error of an arrival grows with the square of the range."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .base import ArrivalEffect
from .samples import tile

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .samples import Samples

EXAMPLES = 4.0, 8.0  # m, distances that advice names


class RangeBias(ArrivalEffect):
    """An anchor at range r seems farther by quadratic * r^2.

    (A constant cancels in a TDOA; a slope is range_scale.)
    """

    name = "range_bias"
    unit = "1/m"
    bound = 0.5
    negligible = 5e-4
    typical = 0.01
    example = "quadratic"
    physics = "the detector fires later on weak, far signals: a range error that bends over range"
    confounded_with = ("received_power_bias", "range_scale")
    distinguished_by = {
        "received_power_bias": "one range at many headings: power changes with the antennas, range does not",
        "range_scale": "a flight near to and far from the anchors",
    }
    covariates = ("range",)
    reference = (
        "Decawave APS011: the range error is a bent function of received power, hence of range"
    )

    def delay_regressors(
        self, samples: Samples, rows: np.ndarray, keys: Sequence[str]
    ) -> np.ndarray:
        to_anchor = samples.anchors.positions[rows] - tile(samples, samples.p)
        return np.repeat(np.sum(to_anchor**2, axis=1)[:, None], len(keys), axis=1)

    def advice(self) -> tuple[str, ...]:
        if not self.significant():
            return ()
        sign = "far" if self.values["quadratic"] > 0.0 else "near"
        near, far = (f"{self.size('quadratic', 'm', r * r)} at {r:g} m" for r in EXAMPLES)
        return (
            f"Calibrate ranges over distance: an anchor seems too {sign} by {near} and by {far}.",
        )
