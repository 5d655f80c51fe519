"""A constant delay of one anchor."""

from __future__ import annotations

from .base import AnchorEffect
from .wording import counted, listed


class AnchorDelay(AnchorEffect):
    """Everything heard from anchor i arrives `values[i]` metres late: bias of d_ab = delay_b -
    delay_a, of a range to b delay_b.

    In TDOAs only differences of delays are observable: the sum over all anchors is not.
    """

    name = "anchor_delay"
    unit = "m"
    bound = 5.0
    negligible = 0.01
    typical = 0.3
    example = "0"
    physics = (
        "the antenna delay of an anchor is not calibrated: it always seems farther away by the "
        "same distance"
    )
    confounded_with = ("anchor_position", "pair_offset", "range_offset")
    distinguished_by = {
        "pair_offset": "TDoA3, where each anchor is heard in many pairs",
        "anchor_position": "a flight that passes the anchor on several sides, near and far",
    }
    reference = "DW1000 user manual, antenna delay calibration: 10 - 50 cm from module to module"

    def advice(self) -> tuple[str, ...]:
        late = {
            key: f"{self.size(key)} {'late' if value > 0.0 else 'early'}"
            for key, value in self.significant().items()
        }
        if not late:
            return ()
        each = (
            listed(f"anchor {key} {how}" for key, how in late.items())
            if len(late) > 1
            else f"it {next(iter(late.values()))}"
        )
        which = counted(sorted(late, key=int), "anchor")
        return (
            (
                f"Calibrate the antenna delay of {which}: the tag hears {each}, against the other "
                "anchors."
            ),
        )
