"""On the floor the direct path is lost, and an echo is taken for it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..foundation.errors import InputError
from .base import ArrivalEffect, check_anchor, once_per_anchors
from .samples import tile
from .wording import counted, measured

if TYPE_CHECKING:
    from collections.abc import Hashable, Sequence

    from ..foundation.anchors import Anchors
    from .samples import Samples

PARTS, PLACE = ("delay", "height", "noise"), ("x", "y")
HEIGHT = 0.12  # m, where no other one is given
SWITCH = 1.5  # times the height, and 1 over it, between which an anchor is late at times
REACH = 1.0  # m from the place where it was seen, over which the echo becomes another one


class FloorMultipath(ArrivalEffect):
    """While the tag is lower than "i.height" metres above z = 0 (0.12 if not given), anchor i is
    "i.delay" metres late: always below two thirds of that height, never above one and a half times
    it, and in between ever less often. ("x", "y") is where that was seen: with the distance d from
    there the bias fades as exp(-d^2 / (2 m^2)). That an anchor may be late or not is taken as
    noise, besides "i.noise" metres where it is late by several echoes in turn.
    """

    name = "floor_multipath"
    channels = ("tdoa",)
    unit = "m"
    bound = 20.0
    negligible = 0.05
    typical = 3
    example = "0.delay"
    physics = (
        "between low antennas the reflection from the floor cancels the direct path, and the next "
        "echo, metres longer, is taken for it"
    )
    confounded_with = ("nlos", "anchor_position", "truth_frame")
    distinguished_by = {"nlos": "the same place half a metre higher"}
    reference = (
        "two-ray model (Rappaport, Wireless Communications, ch. 4): path difference 2 h1 h2 / d; "
        "3 m late on the floor in the measured flights"
    )
    portable = False
    fitted = False
    weighed = True  # an estimate that is wrong there would be held by what is taken out for it

    @classmethod
    def check_key(cls, key: str) -> None:
        anchor, _, part = key.partition(".")
        if key in PLACE:
            return
        if part not in PARTS:
            raise InputError(
                f"effects: {cls.name}: parameter {key!r} is not x, y, or an anchor and one of "
                f"{', '.join(PARTS)}."
            )
        check_anchor(cls.name, anchor, key)

    @classmethod
    def bound_of(cls, key: str) -> float:
        return 1e6 if key in PLACE else cls.bound

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        return [()]

    @property
    def identity(self) -> tuple[Hashable, ...]:
        return (
            self.name,
            *sorted(
                (key, value) for key, value in self.values.items() if not key.endswith(".delay")
            ),
        )

    @classmethod
    def plausible(cls, values: dict[str, float]) -> bool:
        return super().plausible(values) and all(
            value > 0.0 for key, value in values.items() if key.endswith(".height")
        )

    @once_per_anchors
    def of_each(self, anchors: Anchors) -> tuple[np.ndarray, ...]:
        """(delays, heights, noises), each (anchors,) m, of some Anchors."""
        ids = anchors.ids.tolist()
        return tuple(
            np.array([self.values.get(f"{i}.{part}", default) for i in ids])
            for part, default in zip(PARTS, (0.0, HEIGHT, 0.0))
        )

    def on_floor(self, anchors: Anchors) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(delays of some Anchors at a tag on the floor, NaN where not known, their standard
        deviations, each (anchors,) m; x and y, (2,) m, of where that was seen, NaN if that is not
        known).
        """
        delays, _, noises = self.of_each(anchors)
        known = np.array([f"{i}.delay" in self.values for i in anchors.ids.tolist()])
        stds = np.array([self.std.get(f"{i}.delay", 0.0) for i in anchors.ids.tolist()])
        return (
            np.where(known, delays, np.nan),
            np.hypot(noises, stds),
            np.array([self.values.get(name, np.nan) for name in PLACE]),
        )

    def _late(self, samples: Samples, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(share of the time that the anchors in `rows` (k * n,) are late there, as far as it is
        the same echo), each (k * n,).
        """
        z, heights = tile(samples, samples.p[:, 2]), self.of_each(samples.anchors)[1][rows]
        share = np.clip(
            0.5 - 0.5 * np.log(np.maximum(z, 1e-6) / heights) / np.log(SWITCH), 0.0, 1.0
        )
        away = [
            samples.p[:, k] - self.values[name]
            for k, name in enumerate(PLACE)
            if name in self.values
        ]
        same = np.exp(-0.5 * sum((part**2 for part in away), np.zeros(len(samples))) / REACH**2)
        return share, tile(samples, same)

    def delays(self, samples: Samples, rows: np.ndarray) -> np.ndarray:
        share, same = self._late(samples, rows)
        return self.of_each(samples.anchors)[0][rows] * share * same

    def delay_regressors(
        self, samples: Samples, rows: np.ndarray, keys: Sequence[str]
    ) -> np.ndarray:
        share, same = self._late(samples, rows)
        late, ids = share * same, samples.anchors.ids[rows]
        return np.stack([late * (ids == int(key.partition(".")[0])) for key in keys], axis=1)

    def noise_std(self, samples: Samples) -> np.ndarray:
        rows = np.concatenate([samples.a, samples.b])
        share, same = self._late(samples, rows)
        delays, _, noises = (values[rows] for values in self.of_each(samples.anchors))
        power = delays**2 * (share - (share * same) ** 2) + noises**2 * share
        return np.sqrt(np.nan_to_num(np.maximum(power, 0.0)).reshape(2, -1).sum(axis=0))

    def advice(self) -> tuple[str, ...]:
        late = {key: value for key, value in self.significant().items() if key.endswith(".delay")}
        if not late:
            return ()
        most = max(late, key=late.__getitem__)
        anchors = sorted(
            (key.partition(".")[0] for key, value in late.items() if value > 0.5 * late[most]),
            key=int,
        )
        highest = max(self.values.get(f"{i}.height", HEIGHT) for i in anchors)
        who, many = counted(anchors, "anchor"), len(anchors) > 1
        return (
            f"Mount the tag's antenna higher on the vehicle, by {highest:.2f} m or more, or "
            f"take off from a box as high: below that {who} "
            f"{'are' if many else 'is'} "
            f"{'up to ' if many else ''}{measured(late[most], self.std.get(most), 'm')} late.",
            (
                f"Hang {who} higher: near the floor low antennas lose the direct path, high ones "
                "do not."
            ),
        )
