"""The stamps of the ground truth are off."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

from ..foundation.sensors import DIAGNOSED
from .base import need_truth
from .stamp_error import StampEffect
from .wording import significant, size

if TYPE_CHECKING:
    from collections.abc import Sequence
    import numpy as np
    from ..foundation.flight import Flight


class TruthTimeOffset(StampEffect):
    """Ground truth is stamped `offset` seconds after the instant it was taken at. Corrected by moving its stamps: it
    changes what is compared, not the estimate."""

    name = "truth_time_offset"
    stream = "truth"
    unit = "s"
    bound = 1.0
    negligible = 0.002
    typical = 0.05
    example = "offset"
    physics = "motion-capture poses reach the log late, over a radio link"
    confounded_with = ("tdoa_time_offset", "range_delay")
    reference = "UTIL web page: motion-capture poses logged on board have about 10 ms of radio latency"
    needs_reference = True
    portable = False
    channels = ("tdoa", "gyro", *DIAGNOSED)  # on the accelerometer it is less than its vibration

    def regressors(self, samples: Any, keys: Sequence[str]) -> np.ndarray:
        return -super().regressors(samples, keys)  # the tag is already farther on its way than the truth of that stamp says

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        need_truth(self, flight)
        return super().inject(flight, rng)

    def advice(self) -> tuple[str, ...]:
        if not significant(self):
            return ()
        sign = "late" if self.values["offset"] > 0.0 else "early"
        return (
            f"Correct the stamps of the ground truth, which are {size(self, 'offset', 'ms', 1e3)} {sign}: that "
            "changes what the estimate is compared with, not the estimate.",
        )
