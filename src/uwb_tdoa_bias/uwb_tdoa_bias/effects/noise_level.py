"""One pair is noisier than the others."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .base import Effect
from .pair_offset import PairOffset, check_pair
from .wording import listed

if TYPE_CHECKING:
    from ..foundation.flight import Flight
    from .samples import Samples


class NoiseLevel(Effect):
    """The link "a-b", in both directions, has white noise of `values["a-b"]` metres on top of what
    all have.
    """

    name = "noise_level"
    unit = "m"
    bound = 10.0
    negligible = 0.03
    typical = 0.2
    example = "0-1"
    physics = "a weak or disturbed link: its arrivals scatter more"
    confounded_with = ("outlier_rate", "noise_correlation")
    reference = "DW1000 user manual: ranging precision over received power"
    portable = False
    fitted = False

    groups = PairOffset.groups

    @classmethod
    def check_key(cls, key: str) -> None:
        check_pair(cls.name, key)

    def noise_std(self, samples: Samples) -> np.ndarray:
        a, b = samples.anchors.ids[samples.a], samples.anchors.ids[samples.b]
        variance = np.zeros(len(samples))
        for key, value in self.values.items():
            i, k = map(int, key.split("-"))
            variance += value**2 * (((a == i) & (b == k)) | ((a == k) & (b == i)))
        return np.sqrt(variance)

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        from .samples import Samples

        tdoa, n = flight.tdoa, len(flight.tdoa)
        a, b = (
            np.maximum(flight.anchors.index(tdoa.a), 0),
            np.maximum(flight.anchors.index(tdoa.b), 0),
        )
        samples = Samples(tdoa.t, a, b, np.zeros((n, 3)), np.full((n, 4), np.nan), flight.anchors)
        rng = rng or np.random.default_rng()
        return replace(
            flight, tdoa=replace(tdoa, d=tdoa.d + self.noise_std(samples) * rng.standard_normal(n))
        )

    def advice(self) -> tuple[str, ...]:
        noisy = [f"those of {key} by {self.size(key)}" for key in self.significant()]
        if not noisy:
            return ()
        links = listed(key.replace("-", " and ") for key in self.significant())
        return (
            (
                f"Check the antennas of anchors {links} and the sight between them: TDOAs scatter "
                f"more, {listed(noisy)}."
            ),
        )
