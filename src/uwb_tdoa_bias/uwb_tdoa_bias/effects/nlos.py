"""One anchor is blocked, for a while or from a region."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..foundation.errors import InputError
from .base import ArrivalEffect, check_anchor
from .marks import Region
from .samples import tile
from .wording import measured

if TYPE_CHECKING:
    from collections.abc import Hashable, Sequence

    from ..foundation.anchors import Anchors
    from .samples import Samples

PARTS = ("delay", "start", "end", "x", "y", "z", "radius")


class Nlos(ArrivalEffect):
    """Anchor i is "i.delay" metres late: from "i.start" to "i.end" seconds after the first TDOA, or
    while the tag is within "i.radius" metres of ("i.x", "i.y", "i.z"); what is not given does not
    limit it.
    """

    name = "nlos"
    channels = ("tdoa",)
    unit = "m, s"
    bound = 100.0
    negligible = 0.02
    typical = 0.5
    example = "0.delay"
    physics = (
        "something between tag and anchor: the direct path is slowed or lost, and a later one is "
        "taken for it"
    )
    confounded_with = ("anchor_delay", "anchor_clock_drift", "anchor_position")
    distinguished_by = {
        "anchor_delay": "the same path again without the obstacle, or from another side",
    }
    reference = "UTIL identification data: metal 0.2 - 0.6 m, wood 0.03 - 0.24 m, people up to 2 m"
    portable = False
    fitted = False

    @classmethod
    def check_key(cls, key: str) -> None:
        anchor, _, part = key.partition(".")
        if part not in PARTS:
            raise InputError(
                f"effects: {cls.name}: parameter {key!r} is not an anchor and one of "
                f"{', '.join(PARTS)}."
            )
        check_anchor(cls.name, anchor, key)

    @classmethod
    def bound_of(cls, key: str) -> float:
        return 1e6 if key.endswith(("start", "end", ".x", ".y", ".z")) else cls.bound

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
            values[key] >= 0.0 for key in values if key.endswith(".delay")
        )

    def _blocked(self, samples: Samples, rows: np.ndarray, anchor: str) -> np.ndarray:
        """(k * n,) bool"""
        get = self.values.get
        since = tile(samples, samples.t) - samples.start
        blocked = samples.anchors.ids[rows] == int(anchor)
        blocked &= (since >= get(f"{anchor}.start", -np.inf)) & (
            since <= get(f"{anchor}.end", np.inf)
        )
        if f"{anchor}.radius" in self.values:
            near = (
                np.linalg.norm(samples.p - self._centre(anchor), axis=1)
                <= self.values[f"{anchor}.radius"]
            )  # False where NaN
            blocked &= tile(samples, near)
        return blocked

    def delays(self, samples: Samples, rows: np.ndarray) -> np.ndarray:
        keys = [key for key in self.values if key.endswith(".delay")]
        return self.delay_regressors(samples, rows, keys) @ np.array(
            [self.values[key] for key in keys]
        )

    def delay_regressors(
        self, samples: Samples, rows: np.ndarray, keys: Sequence[str]
    ) -> np.ndarray:
        out = np.zeros((len(rows), len(keys)))
        for column, key in enumerate(keys):
            out[:, column] = self._blocked(samples, rows, key.partition(".")[0])
        return out

    def advice(self) -> tuple[str, ...]:
        out = []
        for anchor, delay in sorted(self._significant_delays().items(), key=lambda item: -item[1]):
            late = measured(delay, self.std.get(f"{anchor}.delay"), "m")
            place, when = self._place(anchor), self._time(anchor)
            if place:
                out.append(
                    f"Look what stands between anchor {anchor} and {place}: the anchor is "
                    f"heard {late} late while "
                    f"the tag is within {self.values[f'{anchor}.radius']:.1f} m of there{when}."
                )
            else:
                out.append(
                    f"Look what stood between anchor {anchor} and the tag{when}: it was heard "
                    f"{late} late."
                )
        return tuple(out)

    def marks(self, anchors: Anchors) -> tuple[Region, ...]:
        return tuple(
            Region(int(anchor), self._centre(anchor), self.values[f"{anchor}.radius"])
            for anchor in self._significant_delays()
            if f"{anchor}.radius" in self.values
        )

    def _significant_delays(self) -> dict[str, float]:
        """{anchor: delay}, m."""
        delays = {key: value for key, value in self.significant().items() if key.endswith(".delay")}
        return {key.partition(".")[0]: value for key, value in delays.items()}

    def _centre(self, anchor: str) -> np.ndarray:
        """(3,) m"""
        return np.array([self.values.get(f"{anchor}.{axis}", 0.0) for axis in "xyz"])

    def _place(self, anchor: str) -> str:
        if f"{anchor}.radius" not in self.values:
            return ""
        return "({:.1f}, {:.1f}, {:.1f}) m".format(*self._centre(anchor))

    def _time(self, anchor: str) -> str:
        """In words, with a space before them; "" without limits."""
        start, end = (self.values.get(f"{anchor}.{part}") for part in ("start", "end"))
        limits = [
            f"from {start:.0f} s on" if start is not None else "",
            f"until {end:.0f} s" if end is not None else "",
        ]
        if start is not None and end is not None:
            limits = [f"from {start:.0f} to {end:.0f} s"]
        return f", {' '.join(filter(None, limits))} after the first TDOA" if any(limits) else ""
