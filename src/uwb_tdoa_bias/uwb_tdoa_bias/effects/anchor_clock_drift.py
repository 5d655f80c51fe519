"""The clock of one anchor runs away."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .base import AnchorEffect
from .wording import counted, listed

if TYPE_CHECKING:
    import numpy as np

    from .samples import Samples


class AnchorClockDrift(AnchorEffect):
    """Anchor i gets later by `values[i]` metres a second, counted from the first TDOA of the
    recording.
    """

    name = "anchor_clock_drift"
    unit = "m/s"
    bound = 1.0
    negligible = 5e-4
    typical = 0.01
    example = "0"
    physics = (
        "the correction of an anchor's clock lags behind its crystal, which warms up: its delay "
        "grows with time"
    )
    confounded_with = ("anchor_delay", "nlos")
    distinguished_by = {
        "nlos": "a longer flight: a drift goes on, an obstacle ends",
        "anchor_delay": "a longer flight",
    }
    reference = "Sidorenko et al., Sensors 2019, 19, 2942; DW1000 user manual: 2.15 mm per degree"
    portable = False
    covariates = ("time",)

    def delay_per_unit(self, samples: Samples) -> np.ndarray:
        return samples.t - samples.start

    def advice(self) -> tuple[str, ...]:
        drifts = [
            (
                f"anchor {key} by {self.size(key, 'm')} a second "
                f"{'later' if value > 0.0 else 'earlier'}"
            )
            for key, value in self.significant().items()
        ]
        if not drifts:
            return ()
        which = counted(sorted(self.significant(), key=int), "anchor")
        return (f"Let {which} warm up before flights, or check the clock: heard {listed(drifts)}.",)
