# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects of pairs of anchors: offsets and signs of TDOAs, and their noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from ..common.anchors import Anchors
from ..common.flight import Flight
from .base import OF_PAIR, DetectedEffect, Effect, LabelEffect, Row, listed, with_each
from .samples import Samples

OUTLIERS = 0.5, 5.0  # m, smallest and largest error of an injected outlier
GRID = 0.01  # s, spacing of the random process of an injected noise_correlation
CORRELATION_TIME = 0.5  # s, default of noise_correlation


class PairEffect(Effect):
    """An effect with one parameter per pair of anchors, "a-b"."""

    portable = False
    key_form = OF_PAIR

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        keys: list[str] = []  # each pair once, in the direction that comes first
        for a, b in [] if pairs is None else np.asarray(pairs).tolist():
            if f"{b}-{a}" not in keys and f"{a}-{b}" not in keys:
                keys.append(f"{a}-{b}")
        return with_each(tuple(keys))

    def where(self) -> str:
        return listed(key.replace("-", " and ") for key in self.significant())


class PairOffset(PairEffect):
    """d_ab of the ordered pair "a-b" is `values["a-b"]` metres too large, d_ba too small."""

    row = Row(
        name="pair_offset",
        unit="m",
        bound=5.0,
        negligible=0.01,
        prior_std=0.3,
        example="0-1",
        physics=(
            "the tag subtracts the time of flight that two anchors measured between them; its "
            "error is a constant of the pair"
        ),
        reference="Bitcraze documentation of TDoA2: anchor-to-anchor time of flight",
        confounded_with=("anchor_delay", "anchor_position"),
        remedy="Let anchors {where} measure the time of flight between them again: {found}.",
        phrase="the TDOA of {key} is {size} too {way}",
        ways=("large", "small"),
    )
    uses_pose = False

    def bias(self, samples: Samples) -> np.ndarray:
        rows = {i: row for row, i in enumerate(samples.anchors.ids.tolist())}
        offsets = np.zeros((len(rows), len(rows)))
        for key, value in self.values.items():
            a, b = (rows.get(i) for i in ids_of(key))
            if a is not None and b is not None:
                offsets[a, b] += value
                offsets[b, a] -= value
        return offsets[samples.a, samples.b]

    def regressors(self, samples: Samples, keys: Sequence[str]) -> np.ndarray:
        forth_and_back = (of_pair(samples, key) for key in keys)
        return np.stack([1.0 * forth - back for forth, back in forth_and_back], axis=1)


class PairSign(LabelEffect):
    """d_ab of the ordered pair "a-b" has the sign of d_ba if its value is -1."""

    row = Row(
        name="pair_sign",
        unit="1",
        bound=1.0,
        negligible=0.5,
        prior_std=0.9,
        example="0-1",
        physics=(
            "a driver orders the anchors of a pair, or subtracts, differently for some of them"
        ),
        reference="Tdoa.msg: d_ab = |p - b| - |p - a|",
    )
    key_form = OF_PAIR
    expected = "-1 for the other sign, or 1"

    @staticmethod
    def possible(value: float) -> bool:
        return value in (-1.0, 1.0)

    def relabelled(
        self, a: np.ndarray, b: np.ndarray, d: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        sign = np.ones(len(d))
        for key, value in self.values.items():
            first, second = ids_of(key)
            sign[(np.asarray(a) == first) & (np.asarray(b) == second)] *= value
        return a, b, sign * d

    def advice(self) -> tuple[str, ...]:
        wrong = [key for key, value in self.values.items() if value < 0.0]
        if not wrong:
            return ()
        return (
            "Look in the driver for what orders the pair: the sign of the TDOA of "
            f"{listed(wrong)} is wrong.",
        )


class NoiseLevel(PairEffect):
    """The pair "a-b", in both directions, has additional white noise of `values["a-b"]` metres."""

    row = Row(
        name="noise_level",
        unit="m",
        bound=10.0,
        negligible=0.03,
        prior_std=0.2,
        example="0-1",
        physics="a weak or disturbed link: its arrivals scatter more",
        reference="DW1000 user manual: ranging precision over received power",
        confounded_with=("outlier_rate", "noise_correlation"),
        remedy=(
            "Check the antennas of anchors {where} and the sight between them: TDOAs scatter "
            "more, {found}."
        ),
        phrase="those of {key} by {size}",
    )
    fitted = False

    def noise_std(self, samples: Samples) -> np.ndarray:
        variance = np.zeros(len(samples))
        for key, value in self.values.items():
            forth, back = of_pair(samples, key)
            variance += value**2 * (forth | back)
        return np.sqrt(variance)

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        rng, tdoa, n = rng or np.random.default_rng(), flight.tdoa, len(flight.tdoa)
        a, b = (np.maximum(flight.anchors.index(ids), 0) for ids in (tdoa.a, tdoa.b))
        samples = Samples(tdoa.t, a, b, np.zeros((n, 3)), np.full((n, 4), np.nan), flight.anchors)
        noise = self.noise_std(samples) * rng.standard_normal(n)
        return replace(flight, tdoa=replace(tdoa, d=tdoa.d + noise))


class NoiseCorrelation(DetectedEffect):
    """The arrivals of each anchor have a first-order Gauss-Markov error.

    Its standard deviation is `std`, m, its correlation time is `time`, s. It cannot be corrected:
    the filter takes it as noise.
    """

    row = Row(
        name="noise_correlation",
        unit="m, s",
        bound=60.0,
        negligible=0.03,
        prior_std=0.2,
        example="std",
        physics=(
            "multipath and attitude change slowly: errors of successive arrivals of an anchor are "
            "alike"
        ),
        reference="third-party analysis of the UTIL identification data: noise correlated in time",
        confounded_with=("noise_level",),
    )
    parameters = ("std", "time")
    conditions = ("time",)
    other_units = {"time": "s"}

    def noise_std(self, samples: Samples) -> np.ndarray:
        return np.full(len(samples), np.sqrt(2.0) * abs(self.values.get("std", 0.0)))

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        rng, tdoa = rng or np.random.default_rng(), flight.tdoa
        if len(tdoa) == 0:
            return flight
        std, time = self.values.get("std", 0.0), self.values.get("time", CORRELATION_TIME)
        grid = np.arange(tdoa.t[0], tdoa.t[-1] + 2 * GRID, GRID)
        keep = np.exp(-GRID / max(time, 1e-3))
        process = rng.standard_normal((len(grid), len(flight.anchors)))
        process[1:] *= np.sqrt(1.0 - keep**2)
        for k in range(1, len(grid)):
            process[k] += keep * process[k - 1]
        rows = np.searchsorted(grid, tdoa.t, side="right") - 1
        a, b = flight.anchors.index(tdoa.a), flight.anchors.index(tdoa.b)
        error = np.where((a >= 0) & (b >= 0), std * (process[rows, b] - process[rows, a]), 0.0)
        return replace(flight, tdoa=replace(tdoa, d=tdoa.d + error))

    def advice(self) -> tuple[str, ...]:
        return ()  # every room has multipath; the filter takes it as noise


class OutlierRate(Effect):
    """A `share` of the TDOAs has another error: 0.5 to 5 m, of either sign.

    The robust weights of the filter are the remedy: there is no bias to correct.
    """

    row = Row(
        name="outlier_rate",
        unit="1",
        bound=1.0,
        negligible=0.02,
        prior_std=0.05,
        example="share",
        physics=(
            "lost or mixed-up packets and reflections: single measurements that have nothing to do "
            "with the geometry"
        ),
        reference="crazyflie-firmware issues 277, 305, 375",
        confounded_with=("noise_level",),
        remedy=(
            "Look for lost or mixed-up packets and for reflections: {found} of the TDOAs are "
            "plainly wrong."
        ),
        phrase="{size}",
        shown=("%", 100.0),
    )
    portable = False
    fitted = False
    usable = False

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        rng, tdoa = rng or np.random.default_rng(), flight.tdoa
        hit = rng.random(len(tdoa)) < self.values.get("share", 0.0)
        size = np.copysign(rng.uniform(*OUTLIERS, len(tdoa)), rng.uniform(-1.0, 1.0, len(tdoa)))
        return replace(flight, tdoa=replace(tdoa, d=tdoa.d + np.where(hit, size, 0.0)))


def ids_of(key: str) -> tuple[int, int]:
    """Return the two anchor ids of a key "a-b"."""
    first, second = key.split("-")
    return int(first), int(second)


def of_pair(samples: Samples, key: str) -> tuple[np.ndarray, np.ndarray]:
    """Return which samples, (n,) bool, are of the pair in its direction, and in the other."""
    (first, second), ids = ids_of(key), samples.anchors.ids
    a, b = ids[samples.a], ids[samples.b]
    return (a == first) & (b == second), (a == second) & (b == first)
