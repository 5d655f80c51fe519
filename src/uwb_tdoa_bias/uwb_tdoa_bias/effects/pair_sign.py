"""The TDOAs of some pairs are subtracted the wrong way round."""

from __future__ import annotations

import numpy as np

from .label_error import LabelEffect
from .pair_offset import check_pair
from .wording import listed


class PairSign(LabelEffect):
    """d_ab of the ordered pair "a-b" comes with the sign of d_ba, where its value is -1."""

    name = "pair_sign"
    unit = "1"
    bound = 1.0
    negligible = 0.5
    typical = 0.9
    example = "0-1"
    physics = "a driver orders the anchors of a pair, or subtracts, differently for some of them"
    confounded_with = ()
    reference = "Tdoa.msg: d_ab = |p - b| - |p - a|"
    expected = "-1 for the other sign, or 1"

    @classmethod
    def check_key(cls, key: str) -> None:
        check_pair(cls.name, key)

    @staticmethod
    def possible(value: float) -> bool:
        return value in (-1.0, 1.0)

    def relabelled(
        self, a: np.ndarray, b: np.ndarray, d: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        sign = np.ones(len(d))
        for key, value in self.values.items():
            one, two = map(int, key.split("-"))
            sign[(np.asarray(a) == one) & (np.asarray(b) == two)] *= value
        return a, b, sign * d

    def mislabelled(
        self, a: np.ndarray, b: np.ndarray, d: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.relabelled(a, b, d)

    def advice(self) -> tuple[str, ...]:
        wrong = [key for key, value in self.values.items() if value < 0.0]
        if not wrong:
            return ()
        return (
            (
                "Look in the driver for what orders the pair: the sign of the TDOA of "
                f"{listed(wrong)} is wrong."
            ),
        )
