"""How well can any motion explain a stream of TDOAs? A filter without inertial sensor says so by its innovations.

Two hypotheses about one stream, e.g. that its signs are right or all wrong, are compared by what they leave
unexplained, block by block: systematic errors disturb both alike, so that their difference tells more than either.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import TYPE_CHECKING

import numpy as np

from ..core.config import FilterConfig
from ..core.engine import feed
from ..core.measurements import usable_all
from ..core.memory import IMU_SAMPLE, TDOA, Measurements, new_state, structured

if TYPE_CHECKING:
    from ..core.memory import FilterState

SCALE = 0.5  # m, of the Geman-McClure loss: an innovation of that size leaves a half unexplained
BLOCK = 2.0  # s
SETTLE = 2.0  # s from the first TDOA on that do not count: the start is being found
FEW, LEAST = 10, 4  # TDOAs of a block that say nothing, and blocks that do
CONFIG = FilterConfig(use_imu=False)
_NO_IMU = np.empty(0, IMU_SAMPLE)


@dataclass(frozen=True)
class Unexplained:
    """blocks : {number: mean loss, 0 to 1} of the blocks of stamps in which more than next to nothing was heard."""

    blocks: dict

    @classmethod
    def of(cls, t: np.ndarray, innovation: np.ndarray) -> Unexplained:
        """t (n,) s, rising; innovation (n,) m, not finite where the TDOA was of no use: that explains nothing."""
        if not len(t):
            return cls({})
        square = np.where(np.isfinite(innovation), innovation, np.inf) ** 2
        loss = 1.0 - SCALE**2 / (SCALE**2 + square)
        number = np.floor((t - t[0] - SETTLE) / BLOCK).astype(np.int64)
        counted = number >= 0
        numbers, rows = np.unique(number[counted], return_inverse=True)
        count = np.bincount(rows, minlength=len(numbers))
        mean = np.bincount(rows, loss[counted], minlength=len(numbers)) / np.maximum(count, 1)
        return cls({int(n): float(m) for n, m, k in zip(numbers, mean, count) if k > FEW})

    @property
    def mean(self) -> float:
        """Mean loss; NaN without a block."""
        return float(np.mean(list(self.blocks.values()))) if self.blocks else math.nan


def compare(one: Unexplained, other: Unexplained) -> tuple[float, float]:
    """(ratio, z): the mean loss of Unexplained `other` over that of `one`, and by how many standard errors `other`
    leaves less unexplained; over the blocks that both have. (NaN, 0) with fewer than four of them."""
    both = one.blocks.keys() & other.blocks.keys()
    if len(both) < LEAST:
        return math.nan, 0.0
    a, b = (np.array([blocks[number] for number in sorted(both)]) for blocks in (one.blocks, other.blocks))
    error = np.std(a - b, ddof=1) / math.sqrt(len(a))
    return float(np.mean(b) / max(np.mean(a), 1e-9)), float(np.mean(a - b) / max(error, 1e-9))


def unexplained(t: np.ndarray, a: np.ndarray, b: np.ndarray, d: np.ndarray, positions: np.ndarray) -> Unexplained:
    """Unexplained of TDOAs in order of their stamps: t (n,) s; a, b (n,) rows of positions (N, 3) m; d (n,) m."""
    return Unexplained.of(t, innovations(new_state(positions), t, a, b, d, positions))


def innovations(
    state: FilterState, t: np.ndarray, a: np.ndarray, b: np.ndarray, d: np.ndarray, positions: np.ndarray
) -> np.ndarray:
    """(n,) m of TDOAs as for `unexplained`, NaN where one is of no use, by the filter of a FilterState, which goes on from there."""
    out, no_variance = np.full(len(t), np.nan), np.zeros(len(t))
    good = usable_all(a, b, d, no_variance, positions)
    measured = Measurements(_NO_IMU, structured(TDOA, t, a, b, d, no_variance)[good])
    out[good] = feed(state, CONFIG.parameters(), measured)[1]["innovation"]
    return out
