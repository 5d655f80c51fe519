"""The stamps of the ground truth are off."""

from dataclasses import replace

import numpy as np

from ..foundation.geometry import tdoa_jacobian
from .base import Effect, need_truth


class TruthTimeOffset(Effect):
    """Ground truth is stamped `offset` seconds after the instant it was taken at. Corrected by moving its stamps: it
    changes what is compared, not the estimate."""

    name = "truth_time_offset"
    unit = "s"
    bound = 1.0
    negligible = 0.002
    typical = 0.05
    example = "offset"
    physics = "motion-capture poses reach the log late, over a radio link"
    confounded_with = ("tdoa_time_offset",)
    reference = "UTIL web page: motion-capture poses logged on board have about 10 ms of radio latency"
    channels = ("tdoa", "gyro")  # on the accelerometer it is less than its vibration

    @classmethod
    def groups(cls, anchors, pairs):
        return [("offset",)]

    @property
    def offset(self):
        """s"""
        return self.values.get("offset", 0.0)

    def regressors(self, samples, keys):
        # the tag is already farther on its way than the truth of that stamp says
        jacobian = tdoa_jacobian(samples.p, samples.position_a, samples.position_b)
        return np.repeat(np.sum(jacobian * samples.v, axis=1)[:, None], len(keys), axis=1)

    def inject(self, flight, rng=None):
        need_truth(self, flight)
        return replace(flight, truth=replace(flight.truth, t=flight.truth.t + self.offset))

    def correct_streams(self, flight):
        if flight.truth is None:
            return flight
        return replace(flight, truth=replace(flight.truth, t=flight.truth.t - self.offset))
