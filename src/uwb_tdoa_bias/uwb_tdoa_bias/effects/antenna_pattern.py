"""Antennas delay a signal by an amount that depends on its direction."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..foundation.antenna import Antenna
from ..foundation.radio import FLAT_MOUNT, into_frame
from .base import ArrivalEffect
from .samples import tile
from .wording import listed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..foundation.anchors import Anchors
    from .samples import Samples

UNIT = Antenna(delay_span=1.0)


class AntennaPattern(ArrivalEffect):
    """`tag` and `anchor` metres times the shape of a DWM1000-like module's group delay over
    direction (0 ... 1).
    """

    name = "antenna_pattern"
    unit = "m"
    bound = 3.0
    negligible = 0.02
    typical = 0.2
    example = "tag"
    physics = (
        "off its best direction an antenna radiates over longer ways: the group delay grows "
        "towards its nulls"
    )
    confounded_with = ("received_power_bias", "tag_lever_arm")
    distinguished_by = {
        "received_power_bias": "one place at many headings, then one heading at many ranges",
    }
    reference = (
        "Qorvo support: 10 - 15 cm over direction for a module; the shape is that of "
        "uwb_tdoa_bias.foundation.antenna"
    )
    uses_attitude = True

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        return [("tag", "anchor"), ("tag",), ("anchor",)]

    def delay_regressors(
        self, samples: Samples, rows: np.ndarray, keys: Sequence[str]
    ) -> np.ndarray:
        to_anchor = samples.anchors.positions[rows] - tile(samples, samples.p)
        out = np.zeros((len(rows), len(keys)))
        for column, key in enumerate(keys):
            if key == "tag":
                seen = into_frame(FLAT_MOUNT, into_frame(tile(samples, samples.q), to_anchor))
                out[:, column] = UNIT.group_delay(seen)
            else:  # an anchor whose orientation was not surveyed adds nothing
                seen = into_frame(samples.anchors.orientations[rows], -to_anchor)
                known = np.isfinite(samples.anchors.orientations[rows]).all(axis=1)
                out[:, column] = np.where(known, UNIT.group_delay(seen), 0.0)
        return out

    def advice(self) -> tuple[str, ...]:
        spans = [
            (
                f"{self.size(key)} {'later' if value > 0.0 else 'earlier'} in the nulls of the "
                f"{key}'s antenna"
            )
            for key, value in self.significant().items()
        ]
        if not spans:
            return ()
        return (
            (
                "Turn antennas so that their nulls point at nothing that is heard: arrivals are "
                f"{listed(spans)}."
            ),
        )
