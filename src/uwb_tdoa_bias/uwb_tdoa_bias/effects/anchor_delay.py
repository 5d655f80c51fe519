"""A constant delay of one anchor."""

from .base import AnchorEffect


class AnchorDelay(AnchorEffect):
    """Everything heard from anchor i arrives `values[i]` metres late: bias of d_ab = delay_b - delay_a.

    Only differences of delays are observable: the sum over all anchors is not.
    """

    name = "anchor_delay"
    unit = "m"
    bound = 5.0
    negligible = 0.01
    typical = 0.3
    example = "0"
    physics = "the antenna delay of an anchor is not calibrated: it always seems farther away by the same distance"
    confounded_with = ("anchor_position", "pair_offset")
    distinguished_by = {
        "pair_offset": "TDoA3, where each anchor is heard in many pairs",
        "anchor_position": "a flight that passes the anchor on several sides, near and far",
    }
    reference = "DW1000 user manual, antenna delay calibration: 10 - 50 cm from module to module"
