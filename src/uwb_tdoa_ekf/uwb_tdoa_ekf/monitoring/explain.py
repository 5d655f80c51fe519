"""How well can any motion explain a stream of TDOAs? A filter without inertial sensor says so by
its innovations.

Two hypotheses about one stream, e.g. that its signs are right or all wrong, are compared by what
they leave unexplained, block by block: systematic errors disturb both alike, so that their
difference tells more than either.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import TYPE_CHECKING

import numpy as np

from ..core.config import FilterConfig
from ..core.engine import feed
from ..core.measurements import usable_tdoas
from ..core.memory import IMU_SAMPLE, Measurements, new_state

if TYPE_CHECKING:
    from ..core.memory import FilterState

SCALE = 0.5  # m, of the Geman-McClure loss: an innovation of that size leaves a half unexplained
BLOCK = 2.0  # s
SETTLE = 2.0  # s from the first TDOA on that do not count: the start is being found
FEW, LEAST = 10, 4  # TDOAs of a block that say nothing, and blocks that do
CONFIG = FilterConfig(use_imu=False)
NO_IMU = np.empty(0, IMU_SAMPLE)


@dataclass(frozen=True)
class Unexplained:
    """blocks : {number: mean loss, 0 to 1} of the blocks of stamps in which more than next to
    nothing was heard.
    """

    blocks: dict

    @classmethod
    def of(cls, t: np.ndarray, innovation: np.ndarray) -> Unexplained:
        """t (n,) s, rising; innovation (n,) m, not finite where the TDOA was of no use: that
        explains nothing.
        """
        if not len(t):
            return cls({})
        loss, number = _loss(innovation), _numbers(t)
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
    """(ratio, z): the mean loss of Unexplained `other` over that of `one`, and by how many standard
    errors `other` leaves less unexplained; over the blocks that both have. (NaN, 0) with fewer than
    four of them.
    """
    both = one.blocks.keys() & other.blocks.keys()
    if len(both) < LEAST:
        return math.nan, 0.0
    a, b = (
        np.array([blocks[number] for number in sorted(both)])
        for blocks in (one.blocks, other.blocks)
    )
    error = np.std(a - b, ddof=1) / math.sqrt(len(a))
    return float(np.mean(b) / max(np.mean(a), 1e-9)), float(np.mean(a - b) / max(error, 1e-9))


def unexplained(
    tdoa: np.ndarray,
    positions: np.ndarray,
    imu: np.ndarray = NO_IMU,
    config: FilterConfig = CONFIG,
    limit: float = math.inf,
) -> Unexplained:
    """Unexplained of (n,) of TDOA between anchors at (N, 3) m, by a filter with a FilterConfig. imu
    : (m,) of IMU_SAMPLE that it uses, too. Both in the order of their stamps. limit : as soon as it
    is certain that the mean loss is above it, Unexplained without a block.
    """
    t, state, parameters = tdoa["t"], new_state(positions), config.parameters()
    number = _numbers(t)
    # of blocks, and of what is before the first one
    edges = np.append(np.unique(number, return_index=True)[1], len(t))
    counted = (np.diff(edges) > FEW) & (number[edges[:-1]] >= 0)
    # those before the first TDOA of each
    of_imu = (0, *imu["t"].searchsorted(t[edges[1:-1]]), len(imu))
    most, loss, out = limit * (1.0 + 1e-9) * np.count_nonzero(counted), 0.0, np.empty(len(t))
    for k, (first, end) in enumerate(zip(edges, edges[1:])):
        out[first:end] = innovations(
            state, tdoa[first:end], positions, imu[of_imu[k] : of_imu[k + 1]], parameters
        )
        loss += float(np.mean(_loss(out[first:end]))) if counted[k] else 0.0
        if loss > most:
            return Unexplained({})
    return Unexplained.of(t, out)


def innovations(
    state: FilterState,
    tdoa: np.ndarray,
    positions: np.ndarray,
    imu: np.ndarray = NO_IMU,
    parameters: np.ndarray = CONFIG.parameters(),
) -> np.ndarray:
    """(n,) m of TDOAs as for `unexplained`, NaN where one is of no use, by the filter of a
    FilterState, which goes on from there.
    parameters : (1,) of config.PARAMETERS.
    """
    out, good = np.full(len(tdoa), np.nan), usable_tdoas(tdoa, positions)
    out[good] = feed(state, parameters, Measurements(imu, tdoa[good]))[1]["innovation"]
    return out


def _numbers(t: np.ndarray) -> np.ndarray:
    """(n,) numbers of the blocks in which stamps t (n,) s, rising, are; negative before the first
    one.
    """
    return np.floor((t - t[:1] - SETTLE) / BLOCK).astype(np.int64)


def _loss(innovation: np.ndarray) -> np.ndarray:
    """(n,), 0 to 1, of innovations (n,) m; not finite: 1."""
    square = np.where(np.isfinite(innovation), innovation, np.inf) ** 2
    return 1.0 - SCALE**2 / (SCALE**2 + square)
