"""Errors that outlast one measurement."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from .base import Effect

if TYPE_CHECKING:
    from ..foundation.anchors import Anchors
    from ..foundation.flight import Flight
    from .samples import Samples


class NoiseCorrelation(Effect):
    """Each anchor's arrivals carry a random error of standard deviation `std` (m) that is forgotten
    over `time` (s, exponentially). It cannot be removed: the filter gets it as spread.
    """

    name = "noise_correlation"
    unit = "m, s"
    bound = 60.0
    negligible = 0.03
    typical = 0.2
    example = "std"
    physics = (
        "multipath and attitude change slowly: errors of successive arrivals of an anchor are alike"
    )
    confounded_with = ("noise_level",)
    reference = "third-party analysis of the UTIL identification data: noise correlated in time"
    portable = False
    fitted = False

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        return [("std", "time")]

    def noise_std(self, samples: Samples) -> np.ndarray:
        return np.full(len(samples), np.sqrt(2.0) * abs(self.values.get("std", 0.0)))

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        rng, tdoa = rng or np.random.default_rng(), flight.tdoa
        std, time, step = self.values.get("std", 0.0), max(self.values.get("time", 0.5), 1e-3), 0.01
        if len(tdoa) == 0:
            return flight
        grid = np.arange(tdoa.t[0], tdoa.t[-1] + 2 * step, step)
        keep = np.exp(-step / time)
        process = rng.standard_normal((len(grid), len(flight.anchors)))
        process[1:] *= np.sqrt(1.0 - keep**2)
        for k in range(1, len(grid)):
            process[k] += keep * process[k - 1]
        rows = np.searchsorted(grid, tdoa.t, side="right") - 1
        a, b = flight.anchors.index(tdoa.a), flight.anchors.index(tdoa.b)
        error = np.where((a >= 0) & (b >= 0), std * (process[rows, b] - process[rows, a]), 0.0)
        return replace(flight, tdoa=replace(tdoa, d=tdoa.d + error))

    def advice(self) -> tuple[str, ...]:
        return ()  # multipath is everywhere; the filter gets it as spread
