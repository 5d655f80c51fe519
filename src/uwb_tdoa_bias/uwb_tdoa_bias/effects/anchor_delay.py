"""A constant delay of one anchor."""

import numpy as np

from ..errors import InputError
from .base import Effect


class AnchorDelay(Effect):
    """Everything heard from anchor i arrives `values[i]` metres late: bias of d_ab = delay_b - delay_a.

    Only differences of delays are observable: the sum over all anchors is not.
    """

    name = "anchor_delay"
    unit = "m"
    bound = 5.0
    confounded_with = ("anchor_position", "pair_offset")
    reference = "DW1000 user manual, antenna delay calibration: 10 - 50 cm from module to module"

    @classmethod
    def check_key(cls, key):
        if not key.isdigit():
            raise InputError(f"effects: anchor_delay: parameter {key!r} is not an anchor id; write '3: 0.05' for 5 cm.")

    def bias(self, samples):
        delay = np.array([self.values.get(str(i), 0.0) for i in samples.anchors.ids])
        return delay[samples.b] - delay[samples.a]

    def regressors(self, samples, keys):
        ids = samples.anchors.ids
        wanted = np.array([int(key) for key in keys])
        return (ids[samples.b][:, None] == wanted).astype(float) - (ids[samples.a][:, None] == wanted)
