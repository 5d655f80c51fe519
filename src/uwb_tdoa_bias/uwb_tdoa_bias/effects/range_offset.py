"""A constant error of the distances to one anchor, which TDOAs do not have."""

from __future__ import annotations

from .base import AnchorEffect
from .wording import counted, listed


class RangeOffset(AnchorEffect):
    """Distances to anchor i are `values[i]` metres too long, and TDOAs are not: else it is an
    anchor_delay.
    """

    name = "range_offset"
    unit = "m"
    bound = 5.0
    negligible = 0.01
    typical = 0.3
    example = "0"
    physics = (
        "two-way ranging has a delay that TDOAs do not have: of the tag's antenna, or of a "
        "calibration of its own"
    )
    confounded_with = ("anchor_delay", "anchor_position")
    reference = (
        "DW1000 user manual, antenna delay calibration: a two-way range has the delays of both "
        "antennas"
    )
    channels = ("range",)
    witnesses = ("tdoa",)  # without TDOAs it is an anchor_delay

    def advice(self) -> tuple[str, ...]:
        off = self.significant()
        if not off:
            return ()
        each = listed(
            f"to anchor {key} {self.size(key)} too {'long' if value > 0.0 else 'short'}"
            for key, value in off.items()
        )
        which = counted(sorted(off, key=int), "anchor")
        return (
            (
                f"Calibrate the antenna delay of two-way ranging with {which}: ranges are {each}, "
                "and TDOAs are not."
            ),
        )
