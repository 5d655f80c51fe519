# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Multipath near the floor: the direct path is lost, and a receiver takes an echo for it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..common.anchors import Anchors
from .anchor import SearchedDelay
from .base import ANCHOR, UNLIMITED, Row, cached_by_anchors, counted, id_texts, measured
from .samples import Samples, tile

PLACE = ("x", "y")
HEIGHT = 0.12  # m, default of "i.height"
SWITCH = 1.5  # an anchor is late at times between height / SWITCH and height * SWITCH
REACH = 1.0  # m, distance from the place over which the echo becomes another one
MAIN_SHARE = 0.5  # of the largest delay; advice names anchors with a larger delay


class FloorMultipath(SearchedDelay):
    """Anchor i is "i.delay" metres late while the tag is lower than "i.height" metres above z = 0.

    Below two thirds of the height it is always late. Above one and a half times the height it is never
    late. In between it is late less often with height. At a distance d, m, from the place ("x", "y") of
    the observation, the bias fades as exp(-d^2 / (2 m^2)). Whether an anchor is late counts as noise.
    "i.noise" metres are added to this noise if several echoes alternate.
    """

    row = Row(
        name="floor_multipath",
        unit="m",
        bound=20.0,
        negligible=0.05,
        prior_std=3,
        example="0.delay",
        physics=(
            "between low antennas the reflection from the floor cancels the direct path, and the "
            "next echo, metres longer, is taken for it"
        ),
        reference=(
            "two-ray model (Rappaport, Wireless Communications, ch. 4): path difference "
            "2 h1 h2 / d; 3 m late on the floor in the measured flights"
        ),
        confounded_with=("nlos", "anchor_position", "truth_frame"),
        distinguished_by={"nlos": "the same place half a metre higher"},
    )
    is_hypothesis = True  # correcting it would keep a wrong estimate on the floor
    key_form = (
        rf"x|y|{ANCHOR}\.(delay|height|noise)",
        "x, y, or an anchor and one of delay, height, noise",
    )
    conditions = (*PLACE, "height")

    @classmethod
    def bound_of(cls, key: str) -> float:
        return UNLIMITED if key in PLACE else cls.row.bound

    @classmethod
    def within_bounds(cls, values: dict[str, float]) -> bool:
        heights = (value for key, value in values.items() if key.endswith(".height"))
        return super().within_bounds(values) and all(height > 0.0 for height in heights)

    @cached_by_anchors
    def of_each(self, anchors: Anchors) -> tuple[np.ndarray, ...]:
        """Return (delays, heights, noises) of some Anchors, each (anchors,) m."""
        return tuple(
            np.array([self.values.get(f"{i}.{part}", default) for i in id_texts(anchors)])
            for part, default in (("delay", 0.0), ("height", HEIGHT), ("noise", 0.0))
        )

    def near_ground_delays(self, anchors: Anchors) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (delays, their standard deviations, place) of some Anchors for a tag on the floor.

        delays : (anchors,) m, NaN where unknown; standard deviations : (anchors,) m
        place : (2,) m, x and y where they were observed, NaN if unknown
        """
        keys = [f"{i}.delay" for i in id_texts(anchors)]
        delays = np.array([self.values.get(key, np.nan) for key in keys])
        stds = np.array([self.std.get(key, 0.0) for key in keys])
        place = np.array([self.values.get(name, np.nan) for name in PLACE])
        return delays, np.hypot(self.of_each(anchors)[2], stds), place

    def _late(self, samples: Samples, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (share of time that an anchor is late, similarity of the echo), each (k * n,)."""
        z, heights = tile(samples, samples.p[:, 2]), self.of_each(samples.anchors)[1][rows]
        log_ratio = np.log(np.maximum(z, 1e-6) / heights) / np.log(SWITCH)
        distance2 = np.zeros(len(samples))
        for k, name in enumerate(PLACE):
            if name in self.values:
                distance2 += (samples.p[:, k] - self.values[name]) ** 2
        similarity = np.exp(-0.5 * distance2 / REACH**2)
        return np.clip(0.5 - 0.5 * log_ratio, 0.0, 1.0), tile(samples, similarity)

    def bias(self, samples: Samples) -> np.ndarray:
        return samples.difference(self.delays(samples, samples.rows))

    def delays(self, samples: Samples, rows: np.ndarray) -> np.ndarray:
        """Return the mean delays of anchors in rows (k * n,), m; the samples are repeated k times."""
        share, similarity = self._late(samples, rows)
        return self.of_each(samples.anchors)[0][rows] * share * similarity

    def delay_regressors(
        self, samples: Samples, rows: np.ndarray, keys: Sequence[str]
    ) -> np.ndarray:
        share, similarity = self._late(samples, rows)
        late, ids = share * similarity, samples.anchors.ids[rows]
        return np.stack([late * (ids == int(key.partition(".")[0])) for key in keys], axis=1)

    def noise_std(self, samples: Samples) -> np.ndarray:
        rows = np.concatenate([samples.a, samples.b])
        share, similarity = self._late(samples, rows)
        delays, _, noises = (values[rows] for values in self.of_each(samples.anchors))
        power = delays**2 * (share - (share * similarity) ** 2) + noises**2 * share
        return np.sqrt(np.nan_to_num(np.maximum(power, 0.0)).reshape(2, -1).sum(axis=0))

    def advice(self) -> tuple[str, ...]:
        delays = self.significant_delays()
        if not delays:
            return ()
        latest = max(delays, key=delays.__getitem__)
        main = [i for i, delay in delays.items() if delay > MAIN_SHARE * delays[latest]]
        anchors = sorted(main, key=int)
        highest = max(self.values.get(f"{i}.height", HEIGHT) for i in anchors)
        who, late = counted(anchors, "anchor"), self.std.get(f"{latest}.delay")
        verb = "are up to" if len(anchors) > 1 else "is"
        return (
            f"Mount the tag's antenna higher on the vehicle, by {highest:.2f} m or more, or take "
            f"off from a box as high: below that {who} {verb} "
            f"{measured(delays[latest], late, 'm')} late.",
            f"Hang {who} higher: near the floor low antennas lose the direct path, high ones do not.",
        )
