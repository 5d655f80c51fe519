# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measure how well any motion, or place, explains TDOAs.

A stream is judged by the innovations of an IMU-free filter. TDOAs that are heard together, a
snapshot, are judged at the best position of the tag (`locate`).

Two hypotheses about one stream, for example right and wrong signs, are compared block by block by
their unexplained loss. Systematic errors affect both, so the difference is more significant than
either loss.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled

from ..core.config import FilterConfig
from ..core.engine import feed
from ..core.ground import solve
from ..core.memory import IMU_SAMPLE, FilterState, Measurements, new_state, usable_tdoas

SCALE = 0.5  # m, scale of the Geman-McClure loss: an innovation of this size has a loss of one half
# s, length of a block; the first does not count, because the filter initializes
BLOCK = 2.0
# a block with this many TDOAs or fewer does not count; smallest number of blocks
FEW, LEAST = 10, 4
# number of Gauss-Newton steps; longest step relative to the room
STEPS, NEAR = (8, 0.3)
# Anchors in a plane or in a line: start positions spread across it, too, by this share of their size.
# On it, no derivative leads away from it.
THIN = 0.4
STARTS = np.array(
    [[0.0, 0.0, 0.0], [0.6, 0.6, 0.6], [-0.6, -0.6, 0.6], [0.6, -0.6, -0.6], [-0.6, 0.6, -0.6]]
)
CONFIG = FilterConfig(use_imu=False)
NO_IMU = np.empty(0, IMU_SAMPLE)

Snapshot = tuple[np.ndarray, np.ndarray]  # rows of both anchors (k, 2), and TDOAs (k,) m


@dataclass(frozen=True)
class Unexplained:
    """Store the mean loss of each block of a stream.

    Attributes
    ----------
    blocks : dict
        {number of the block: mean loss, 0 to 1}, for blocks with more than FEW TDOAs.
    """

    blocks: dict

    @classmethod
    def of(cls, t: np.ndarray, innovation: np.ndarray) -> Unexplained:
        """Return the Unexplained of innovations.

        Parameters
        ----------
        t : (n,) array
            Ascending stamps, in s.
        innovation : (n,) array
            Innovations, in m. A value that is not finite marks an unusable TDOA and has the loss 1.
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
        """Return the mean loss over all blocks; NaN without a block."""
        return float(np.mean(list(self.blocks.values()))) if self.blocks else math.nan


def compare(one: Unexplained, other: Unexplained) -> tuple[float, float]:
    """Return (ratio, z) of two Unexplained over their common blocks; (NaN, 0) for too few blocks.

    Parameters
    ----------
    one, other : Unexplained
        Losses of two hypotheses on the same stream.

    Returns
    -------
    ratio : float
        Mean loss of `other` over the mean loss of `one`.
    z : float
        Number of standard errors by which the loss of `other` is smaller.
    """
    both = one.blocks.keys() & other.blocks.keys()
    if len(both) < LEAST:
        return math.nan, 0.0
    numbers = sorted(both)
    return compare_losses(
        np.array([one.blocks[number] for number in numbers]),
        np.array([other.blocks[number] for number in numbers]),
    )


def compare_losses(one: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Return the same (ratio, z) of two losses (n,) of the same data."""
    error = np.std(one - other, ddof=1) / math.sqrt(len(one))
    ratio = np.mean(other) / max(np.mean(one), 1e-9)
    return float(ratio), float(np.mean(one - other) / max(error, 1e-9))


def in_words(ratio: float, z: float) -> str:
    """Return a phrase on (ratio, z), the evidence of a Finding."""
    return f"{100.0 * (1.0 - ratio):.0f} % less stays unexplained then, {z:.1f} standard errors"


def unexplained(
    tdoa: np.ndarray,
    positions: np.ndarray,
    imu: np.ndarray = NO_IMU,
    config: FilterConfig = CONFIG,
    limit: float = math.inf,
) -> Unexplained:
    """Return the Unexplained of TDOAs, computed with a filter.

    Parameters
    ----------
    tdoa : (n,) array of TDOA
        In the order of their stamps.
    positions : (N, 3) array
        Anchor positions in the world frame, in m.
    imu : (m,) array of IMU_SAMPLE
        Inertial samples for the filter, in the order of their stamps.
    config : FilterConfig
        Parameters of the filter.
    limit : float
        If the mean loss is certain to exceed this limit, return an Unexplained without blocks.
    """
    t, state, parameters = tdoa["t"], new_state(positions), config.parameters()
    number = _numbers(t)
    # first row of each block, and of the rows before the first block
    edges = np.append(np.unique(number, return_index=True)[1], len(t))
    counted = (np.diff(edges) > FEW) & (number[edges[:-1]] >= 0)
    # number of inertial samples before the first TDOA of each block
    of_imu = (0, *imu["t"].searchsorted(t[edges[1:-1]]), len(imu))
    count, loss, out = max(np.count_nonzero(counted), 1), 0.0, np.empty(len(t))
    for k, (first, end) in enumerate(zip(edges, edges[1:])):
        out[first:end] = innovations(
            state, tdoa[first:end], positions, imu[of_imu[k] : of_imu[k + 1]], parameters
        )
        loss += float(np.mean(_loss(out[first:end]))) if counted[k] else 0.0
        if loss / count > limit * (1.0 + 1e-9):
            return Unexplained({})
    return Unexplained.of(t, out)


def innovations(
    state: FilterState,
    tdoa: np.ndarray,
    positions: np.ndarray,
    imu: np.ndarray = NO_IMU,
    parameters: np.ndarray = CONFIG.parameters(),
) -> np.ndarray:
    """Return the innovations of TDOAs, (n,) m, NaN for unusable TDOAs, and advance the filter.

    Parameters
    ----------
    state : FilterState
        Changed in place.
    tdoa, positions, imu
        As for `unexplained`.
    parameters : (1,) array of config.PARAMETERS
        Parameters of the filter.
    """
    out, good = np.full(len(tdoa), np.nan), usable_tdoas(tdoa, positions)
    out[good] = feed(state, parameters, Measurements(imu, tdoa[good]))[1]["innovation"]
    return out


def _numbers(t: np.ndarray) -> np.ndarray:
    """Return the block numbers of ascending stamps t (n,) s; negative before the first block."""
    return np.floor((t - t[:1] - BLOCK) / BLOCK).astype(np.int64)


def _loss(innovation: np.ndarray) -> np.ndarray:
    """Return the Geman-McClure loss of innovations (n,), in m: (n,), 0 to 1; not finite gives 1."""
    square = np.where(np.isfinite(innovation), innovation, np.inf) ** 2
    return 1.0 - SCALE**2 / (SCALE**2 + square)


@compiled
def locate(ends: np.ndarray, d: np.ndarray, starts: np.ndarray, place: np.ndarray) -> float:
    """Return the mean Geman-McClure loss, 0 to 1, at the best position of the tag.

    The search is a robust Gauss-Newton iteration from several starts, during which the scale of the
    loss decreases.

    Parameters
    ----------
    ends : (k, 2, 3) array
        Positions of both anchors of each TDOA, in m.
    d : (k,) array
        TDOAs, in m.
    starts : (s, 3) array
        Start positions, in half sizes of the room.
    place : (3,) array
        Filled with the best position, in m.
    """
    n, low, high = len(d), np.empty(3), np.empty(3)
    for j in range(3):  # corners of the room around the anchors
        low[j], high[j] = ends[:, :, j].min(), ends[:, :, j].max()
    size = math.sqrt(np.sum((high - low) ** 2))
    least, p, gradient = np.inf, np.empty(3), np.empty(3)
    normal = np.empty((3, 4))  # normal equations, the right side in the last column
    for start in range(len(starts)):
        for j in range(3):
            across = max(high[j] - low[j], THIN * size)
            p[j] = 0.5 * (low[j] + high[j]) + 0.5 * starts[start, j] * across
        for step in range(STEPS + 1):  # the last one evaluates the loss only
            scale, loss = max(0.3 * size * 0.5**step, SCALE) if step < STEPS else SCALE, 0.0
            normal[:, :] = 0.0
            for i in range(n):
                residual = d[i]  # measured minus predicted
                for side in range(2):
                    length = 1e-18
                    for j in range(3):
                        length += (p[j] - ends[i, side, j]) ** 2
                    length = math.sqrt(length)
                    residual += length if side == 0 else -length
                    for j in range(3):
                        unit = (p[j] - ends[i, side, j]) / length
                        gradient[j] = -unit if side == 0 else gradient[j] + unit
                square = (residual / scale) ** 2
                loss += square / (1.0 + square)
                weight = 1.0 / (1.0 + square) ** 2
                for j in range(3):
                    for k in range(3):
                        normal[j, k] += weight * gradient[j] * gradient[k]
                    normal[j, 3] += weight * gradient[j] * residual
            if step == STEPS:
                if loss / n < least:
                    least = loss / n
                    place[:] = p
                break
            for j in range(3):
                normal[j, j] += 1e-6
            solve(normal)
            length = math.sqrt(np.sum(normal[:, 3] ** 2))
            p += min(1.0, NEAR * size / max(length, 1e-12)) * normal[:, 3]
    return least
