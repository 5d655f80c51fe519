"""The DW1000's range error over received power."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..foundation.radio import NOMINAL_GAIN, RadioLink, power_bias, received_power_dbm
from .base import ArrivalEffect
from .samples import tile
from .wording import measured

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .samples import Samples

LINK = RadioLink()


class ReceivedPowerBias(ArrivalEffect):
    """`scale` times the table of Decawave APS011 at the power that Friis and the antennas' patterns
    predict.

    An anchor, or a tag, whose attitude is not known counts with the mean gain of its antenna.
    """

    name = "received_power_bias"
    unit = "1"
    bound = 10.0
    negligible = 0.1
    typical = 1
    example = "scale"
    physics = "the leading edge is detected earlier in a strong signal and later in a weak one"
    confounded_with = ("range_bias", "antenna_pattern")
    reference = "Decawave APS011, table 2 (500 MHz, 64 MHz PRF)"
    uses_attitude = True

    def delay_regressors(
        self, samples: Samples, rows: np.ndarray, keys: Sequence[str]
    ) -> np.ndarray:
        anchors = samples.anchors
        power = received_power_dbm(
            tile(samples, samples.p),
            tile(samples, samples.q),
            anchors.positions[rows],
            anchors.orientations[rows],
            LINK,
        )
        unknown = ~np.isfinite(power)
        if unknown.any():
            distance = np.linalg.norm(tile(samples, samples.p) - anchors.positions[rows], axis=1)
            free = LINK.tx_power_dbm + 2.0 * NOMINAL_GAIN - LINK.path_loss_db(distance)
            power = np.where(unknown, free, power)
        late = np.where(np.isfinite(power), power_bias(power), np.nan)
        return np.repeat(late[:, None], len(keys), axis=1)

    def advice(self) -> tuple[str, ...]:
        if not self.significant():
            return ()
        scale = measured(self.values["scale"], self.std.get("scale"))
        return (
            (
                f"Correct ranges for received power in the tag: they err by {scale} times the "
                "table of Decawave APS011."
            ),
        )
