"""Reflections from the floor, near the floor."""

import numpy as np

from .base import ArrivalEffect, tile
from .wording import significant, size

LOW, HIGH = 0.1, 0.4  # m, full strength below the first, none above the second


class FloorMultipath(ArrivalEffect):
    """Below 0.4 m above z = 0 a signal is late by `size` times the cosine of its elevation, fading out with height;
    what the reflections leave besides is taken as noise of the same size."""

    name = "floor_multipath"
    unit = "m"
    bound = 20.0
    negligible = 0.05
    typical = 1
    example = "size"
    physics = (
        "near the floor the reflection overlaps the direct path, most at grazing incidence, that is from low anchors"
    )
    confounded_with = ("tag_lever_arm", "truth_frame", "nlos")
    reference = "two-ray model; TDOAs on the floor are wrong by metres in the measured flights"
    portable = False
    fitted = False
    usable = False  # an estimate that is wrongly on the floor would believe no TDOA any more, and stay there

    @classmethod
    def groups(cls, anchors, pairs):
        return [("size",)]

    @staticmethod
    def strength(z):
        """1 on the floor, 0 above 0.4 m, of heights z (n,), m."""
        return np.clip((HIGH - z) / (HIGH - LOW), 0.0, 1.0)

    def delays(self, samples, rows):
        return self.values.get("size", 0.0) * self.delay_regressors(samples, rows, ("size",))[:, 0]

    def delay_regressors(self, samples, rows, keys):
        to_anchor = samples.anchors.positions[rows] - tile(samples, samples.p)
        grazing = np.hypot(to_anchor[:, 0], to_anchor[:, 1]) / np.maximum(np.linalg.norm(to_anchor, axis=1), 1e-9)
        return np.repeat((tile(samples, self.strength(samples.p[:, 2])) * grazing)[:, None], len(keys), axis=1)

    def noise_std(self, samples):
        return abs(self.values.get("size", 0.0)) * np.nan_to_num(self.strength(samples.p[:, 2]))

    def advice(self):
        if not significant(self):
            return ()
        return (
            f"Count on no position below {HIGH:g} m, or hang the lowest anchors higher: on the floor TDOAs are wrong "
            f"by about {size(self, 'size')}.",
        )
