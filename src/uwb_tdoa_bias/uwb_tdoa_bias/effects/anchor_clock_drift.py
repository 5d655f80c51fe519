"""The clock of one anchor runs away."""

import numpy as np

from .base import Effect, check_anchor, known_anchors


class AnchorClockDrift(Effect):
    """Anchor i gets later by `values[i]` metres a second, counted from the first TDOA of the recording."""

    name = "anchor_clock_drift"
    unit = "m/s"
    bound = 1.0
    negligible = 5e-4
    typical = 0.01
    example = "0"
    physics = "the correction of an anchor's clock lags behind its crystal, which warms up: its delay grows with time"
    confounded_with = ("anchor_delay", "nlos")
    distinguished_by = {
        "nlos": "a longer flight: a drift goes on, an obstacle ends",
        "anchor_delay": "a longer flight",
    }
    reference = "Sidorenko et al., Sensors 2019, 19, 2942; DW1000 user manual: 2.15 mm per degree"
    portable = False

    @classmethod
    def check_key(cls, key):
        check_anchor(cls.name, key, key)

    @classmethod
    def groups(cls, anchors, pairs):
        ids = known_anchors(anchors)
        return [ids, *((key,) for key in ids)]

    def bias(self, samples):
        rate = np.array([self.values.get(str(i), 0.0) for i in samples.anchors.ids.tolist()])
        return (rate[samples.b] - rate[samples.a]) * (samples.t - samples.start)

    def regressors(self, samples, keys):
        ids, wanted = samples.anchors.ids, np.array([int(key) for key in keys])
        sign = (ids[samples.b][:, None] == wanted).astype(float) - (ids[samples.a][:, None] == wanted)
        return sign * (samples.t - samples.start)[:, None]
