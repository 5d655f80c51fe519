"""An anchor does not stand where the survey says."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..foundation.errors import InputError
from ..foundation.geometry import ranges
from .base import Effect, check_anchor, known_anchors, once_per_anchors
from .marks import Shift
from .samples import RADIO, tile
from .wording import counted, listed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..foundation.anchors import Anchors
    from .samples import Samples


class AnchorPosition(Effect):
    """Anchor i really stands `values["i.x"]`, ... metres away from its surveyed position, along the
    world's axes.
    """

    name = "anchor_position"
    unit = "m"
    bound = 5.0
    negligible = 0.01
    typical = 0.15
    example = "0.x"
    physics = (
        "the antenna of an anchor is not where the survey has it: the range is wrong by the "
        "shift along the "
        "line of sight"
    )
    confounded_with = ("anchor_delay", "truth_frame", "tag_lever_arm")
    distinguished_by = {
        "tag_lever_arm": "a flight that turns through all headings and passes on all sides of the anchor",
        "truth_frame": "a flight through the whole room; several anchors that moved alike are a frame",
    }
    reference = (
        "geometry; survey repeatability of a total station is millimetres, of a tape some "
        "centimetres"
    )
    portable = False
    channels = tuple(RADIO)

    @classmethod
    def check_key(cls, key: str) -> None:
        anchor, _, axis = key.partition(".")
        if axis not in ("x", "y", "z") or not axis:
            raise InputError(
                f"effects: {cls.name}: parameter {key!r} is not an anchor and an axis; write "
                "'3.x: 0.05'."
            )
        check_anchor(cls.name, anchor, key)

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        each = [tuple(f"{i}.{axis}" for axis in "xyz") for i in known_anchors(anchors)]
        return [sum(each, ()), *each, *((key,) for keys in each for key in keys)]

    @once_per_anchors
    def _moved(self, anchors: Anchors) -> np.ndarray:
        positions = anchors.positions.copy()
        rows = {i: row for row, i in enumerate(known_anchors(anchors))}
        for key, value in self.values.items():
            anchor, axis = key.split(".")
            if anchor in rows:
                positions[rows[anchor], "xyz".index(axis)] += value
        return positions

    def bias(self, samples: Samples) -> np.ndarray:
        return samples.true(positions=self._moved(samples.anchors)) - samples.true()

    def regressors(self, samples: Samples, keys: Sequence[str]) -> np.ndarray:
        ids, rows = samples.anchors.ids[samples.rows], samples.rows
        unit = -ranges(tile(samples, samples.p), self._moved(samples.anchors)[rows])[1]
        out = np.empty((len(samples), len(keys)))
        for column, key in enumerate(keys):
            anchor, axis = key.split(".")
            out[:, column] = samples.difference((ids == int(anchor)) * unit[:, "xyz".index(axis)])
        return out

    def advice(self) -> tuple[str, ...]:
        shifts: dict[str, dict[str, str]] = {}
        for key, value in self.significant().items():
            anchor, axis = key.split(".")
            shifts.setdefault(anchor, {})[axis] = (
                f"{self.size(key)} towards {'+' if value > 0.0 else '-'}{axis}"
            )
        if not shifts:
            return ()
        moved = {anchor: listed(by[axis] for axis in sorted(by)) for anchor, by in shifts.items()}
        each = [
            f"{f'anchor {anchor}' if len(moved) > 1 else 'it'} seems off by {by}"
            for anchor, by in moved.items()
        ]
        return (
            f"Measure {counted(sorted(shifts, key=int), 'anchor')} again before you move "
            f"{'them' if len(moved) > 1 else 'it'}: {'; '.join(each)}. "
            "If the survey proves right, ranges to there are wrong by direction.",
        )

    def marks(self, anchors: Anchors) -> tuple[Shift, ...]:
        each: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        for key, value in self.values.items():
            anchor, axis = key.split(".")
            by, std = each.setdefault(int(anchor), (np.zeros(3), np.full(3, np.nan)))
            by["xyz".index(axis)], std["xyz".index(axis)] = value, self.std.get(key, np.nan)
        return tuple(Shift(anchor, *shift) for anchor, shift in each.items())
