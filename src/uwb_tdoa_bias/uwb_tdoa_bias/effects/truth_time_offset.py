"""The stamps of the ground truth are off."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..foundation.sensors import DIAGNOSED
from .base import require_truth
from .stamp_error import StampEffect

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from ..foundation.flight import Flight


class TruthTimeOffset(StampEffect):
    """Ground truth is stamped `offset` seconds after the instant it was taken at. Corrected by
    moving its stamps: it changes what is compared, not the estimate.
    """

    name = "truth_time_offset"
    stream = "truth"
    physics = "motion-capture poses reach the log late, over a radio link"
    remedy = (
        "Correct the stamps of the ground truth, which are {}: that changes what the estimate is "
        "compared with, not the estimate."
    )
    confounded_with = ("tdoa_time_offset", "range_delay")
    reference = (
        "UTIL web page: motion-capture poses logged on board have about 10 ms of radio latency"
    )
    needs_reference = True
    portable = False
    channels = ("tdoa", "gyro", *DIAGNOSED)  # on the accelerometer it is less than its vibration

    def regressors(self, samples: Any, keys: Sequence[str]) -> np.ndarray:
        return -super().regressors(
            samples, keys
        )  # the tag is already farther on its way than the truth of that stamp says

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        require_truth(self, flight)
        return super().inject(flight, rng)
