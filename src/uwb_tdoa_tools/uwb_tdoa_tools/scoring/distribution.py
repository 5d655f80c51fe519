"""How samples of one quantity are distributed, of a size that does not depend on how many there
are.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
import math
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

RATIO = 1.01  # of the limits of a bin of a histogram
SMALLEST = 1e-9  # what is smaller, counts as this


@dataclass
class Distribution:
    """How many samples, their sum, their largest, and bins : {k: how many are from RATIO**k to
    RATIO**(k + 1)}.
    """

    count: int
    total: float
    largest: float
    bins: Counter[int]

    @classmethod
    def of(cls, values: np.ndarray | Sequence[float]) -> Distribution:
        """Of values (n,), not below 0; NaN makes all figures NaN."""
        if not len(values):
            return cls(0, 0.0, -math.inf, Counter())
        sizes = np.clip(np.nan_to_num(values), SMALLEST, 1.0 / SMALLEST)
        places, counts = np.unique(
            np.floor(np.log(sizes) / math.log(RATIO)).astype(int), return_counts=True
        )
        return cls(
            len(values),
            float(np.sum(values)),
            float(np.max(values)),
            Counter(dict(zip(places.tolist(), counts.tolist()))),
        )

    def __add__(self, other: Distribution) -> Distribution:
        largest = float(np.max([self.largest, other.largest]))  # NaN of NaN
        return Distribution(
            self.count + other.count, self.total + other.total, largest, self.bins + other.bins
        )

    @property
    def mean(self) -> float:
        """NaN of nothing."""
        return self.total / self.count if self.count else math.nan

    @property
    def median(self) -> float:
        """To 1 %; NaN of nothing."""
        if not self.count or math.isnan(self.total):
            return math.nan
        half, below = 0.5 * self.count, 0
        for place in sorted(self.bins):
            if below + self.bins[place] >= half:
                return RATIO ** (place + (half - below) / self.bins[place])
            below += self.bins[place]
        raise AssertionError("the bins hold fewer than were counted")

    def as_list(self) -> list[Any]:
        """Plain numbers; NaN and infinity are texts."""
        return [
            self.count,
            repr(self.total),
            repr(self.largest),
            [number for item in sorted(self.bins.items()) for number in item],
        ]

    @classmethod
    def from_list(cls, numbers: list[Any]) -> Distribution:
        """Of what `as_list` gives."""
        count, total, largest, bins = numbers
        return cls(count, float(total), float(largest), Counter(dict(zip(bins[::2], bins[1::2]))))
