"""The stamps of the TDOAs are off."""

from dataclasses import replace

import numpy as np

from ..foundation.geometry import tdoa_jacobian
from .base import Effect


class TdoaTimeOffset(Effect):
    """TDOAs are stamped `offset` seconds after the instant they were taken at. Corrected by moving the stamps."""

    name = "tdoa_time_offset"
    unit = "s"
    bound = 1.0
    negligible = 0.002
    typical = 0.05
    example = "offset"
    physics = "the radio's stamps lag behind the IMU's: by buffers, or because they are taken on arrival at the host"
    confounded_with = ("truth_time_offset",)
    reference = "UTIL web page: about 10 ms of radio latency"

    @classmethod
    def groups(cls, anchors, pairs):
        return [("offset",)]

    @property
    def offset(self):
        """s"""
        return self.values.get("offset", 0.0)

    def regressors(self, samples, keys):
        jacobian = tdoa_jacobian(samples.p, samples.position_a, samples.position_b)
        return np.repeat(-np.sum(jacobian * samples.v, axis=1)[:, None], len(keys), axis=1)

    def inject(self, flight, rng=None):
        return replace(flight, tdoa=replace(flight.tdoa, t=flight.tdoa.t + self.offset))

    def correct_streams(self, flight):
        return replace(flight, tdoa=replace(flight.tdoa, t=flight.tdoa.t - self.offset))
