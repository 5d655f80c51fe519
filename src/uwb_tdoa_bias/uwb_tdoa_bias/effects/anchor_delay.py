"""A constant delay of one anchor."""

import numpy as np

from .base import Effect, check_anchor, known_anchors


class AnchorDelay(Effect):
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

    @classmethod
    def check_key(cls, key):
        check_anchor(cls.name, key, key)

    @classmethod
    def groups(cls, anchors, pairs):
        ids = known_anchors(anchors)
        return [ids, *((key,) for key in ids)]

    def bias(self, samples):
        delay = np.array([self.values.get(str(i), 0.0) for i in samples.anchors.ids.tolist()])
        return delay[samples.b] - delay[samples.a]

    def regressors(self, samples, keys):
        ids = samples.anchors.ids
        wanted = np.array([int(key) for key in keys])
        return (ids[samples.b][:, None] == wanted).astype(float) - (ids[samples.a][:, None] == wanted)
