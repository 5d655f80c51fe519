"""Anchors are called by wrong ids."""

from __future__ import annotations

import numpy as np

from .base import check_anchor
from .label_error import LabelEffect
from .wording import listed


class AnchorIds(LabelEffect):
    """What comes with the id of a parameter is of the anchor that has its value in the survey.

    Corrected by giving it that id.
    """

    name = "anchor_ids"
    unit = "id"
    bound = 65535.0
    negligible = 0.5
    typical = 1.0
    example = "1"
    physics = (
        "modules were configured with, or put up by, the number of another anchor, or the survey "
        "lists them in another order"
    )
    confounded_with = ("anchor_position",)
    reference = (
        "Bitcraze documentation of the loco positioning system: every anchor is given its id by "
        "hand"
    )
    separable = False
    expected = "the id of an anchor, a whole number"

    @classmethod
    def check_key(cls, key: str) -> None:
        check_anchor(cls.name, key, key)

    @staticmethod
    def possible(value: float) -> bool:
        return value >= 0.0 and value == round(value)

    def relabelled(
        self, a: np.ndarray, b: np.ndarray, d: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self._with_ids(a, {int(key): int(value) for key, value in self.values.items()}, b, d)

    def mislabelled(
        self, a: np.ndarray, b: np.ndarray, d: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self._with_ids(a, {int(value): int(key) for key, value in self.values.items()}, b, d)

    @staticmethod
    def _with_ids(
        a: np.ndarray, table: dict[int, int], b: np.ndarray, d: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        out = []
        for ids in (np.asarray(a), np.asarray(b)):
            new = ids.copy()
            for one, other in table.items():
                new[ids == one] = other
            out.append(new)
        return out[0], out[1], d

    def advice(self) -> tuple[str, ...]:
        if not self.values:
            return ()
        wrong = listed(
            f"what is called {key} is anchor {value:.0f} of the survey"
            for key, value in self.values.items()
        )
        return (f"Give the anchors their ids again, or list them so in the survey: {wrong}.",)
