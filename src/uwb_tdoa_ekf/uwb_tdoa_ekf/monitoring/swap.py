# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Detect two exchanged anchors: each transmits from the surveyed position of the other.

The position of the filter may be wrong by then. Each hypothesis of an exchange therefore gets its
own best position near the filter's position. The survey without an exchange gets one too.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from uwb_tdoa_bias.common.geometry import ranges, tdoa

from .slices import CLIP, FEWEST

# m, mean absolute residual by rows of two exchanged anchors; () without an exchange
Residuals = dict[tuple[int, ...], float]

SUSPECTS = 8  # number of anchors with the largest innovations, whose exchanges are tested
LARGE = 0.3  # m, smallest largest mean innovation at which exchanges are tested
PLACE_STD = 1.0  # m, standard deviation of the position of the filter
# m, standard deviation of one TDOA; m, scale of the Geman-McClure weight; iterations for the
# position
STD, ROBUST, STEPS = (0.15, 0.4, 3)
# largest ratio of the residual of an exchange to the residual of the survey, and to that of any
# other exchange
SHARE, OF_OTHERS = (0.4, 0.8)
# alternative: largest ratio to the survey if the reduction exceeds the second value, in m, and the
# reduction by any other exchange times the third value
MOST_LEFT, LEAST, ALONE = (0.65, 0.1, 2.5)


def residuals(
    positions: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    d: np.ndarray,
    p: np.ndarray,
    named: Sequence[int] = (),
) -> Residuals:
    """Return the Residuals of a slice with each exchange of two suspects, and with none.

    The result is {} if all innovations are small and no exchange is already reported.

    Parameters
    ----------
    positions : (N, 3) array
        Surveyed positions in the world frame, in m.
    a, b : (n,) int array
        Rows of the anchors of each TDOA.
    d : (n,) array
        Measured TDOAs, in m.
    p : (3,) array
        Position of the filter in the world frame, in m.
    named : sequence of int
        Rows of two anchors that are tested in any case.
    """
    rows, both = np.unique(np.concatenate([a, b]), return_inverse=True)
    # keep only the anchors that are heard
    a, b, positions, n = (both[: len(a)], both[len(a) :], positions[rows], len(rows))
    if len(a) < FEWEST:
        return {}
    error = np.abs(d - tdoa(p, positions[a], positions[b]))
    mean = (np.bincount(a, error, n) + np.bincount(b, error, n)) / (
        np.bincount(a, minlength=n) + np.bincount(b, minlength=n)
    )
    tried = set(np.flatnonzero(np.isin(rows, named)).tolist()) if len(named) else set()
    if mean.max() >= LARGE:
        tried |= set(np.argsort(-mean)[:SUSPECTS].tolist())
    pairs = list(combinations(sorted(tried), 2))
    if not pairs:
        return {}
    order = np.tile(np.arange(n), (len(pairs) + 1, 1))
    for k, (one, other) in enumerate(pairs, 1):
        order[k, [one, other]] = other, one
    left = _left(positions[order], a, b, d, p).tolist()
    return dict(zip([(), *((int(rows[i]), int(rows[k])) for i, k in pairs)], left))


def _left(
    positions: np.ndarray, a: np.ndarray, b: np.ndarray, d: np.ndarray, p: np.ndarray
) -> np.ndarray:
    """Return the mean absolute residual of each anchor arrangement at its best position, (m,) m.

    Parameters
    ----------
    positions : (m, N, 3) array
        Arrangements of the anchors, in m.
    a, b : (n,) int array
        Anchors of each TDOA.
    d : (n,) array
        Measured TDOAs, in m.
    p : (3,) array
        Position of the filter, in m.
    """
    place = np.tile(p, (len(positions), 1))
    for _ in range(STEPS):
        away, towards = ranges(place[:, None], positions)
        residual, jacobian = d - (away[:, b] - away[:, a]), towards[:, b] - towards[:, a]
        weighted = jacobian / (STD * (1.0 + (residual / ROBUST) ** 2))[:, :, None] ** 2
        information = np.swapaxes(weighted, 1, 2) @ jacobian + np.eye(3) / PLACE_STD**2
        vector = np.einsum("knc,kn->kc", weighted, residual) - (place - p) / PLACE_STD**2
        place = place + np.linalg.solve(information, vector[:, :, None])[:, :, 0]
    away = ranges(place[:, None], positions)[0]
    return np.asarray(np.minimum(np.abs(d - (away[:, b] - away[:, a])), CLIP).mean(axis=1))


def mean_of(slices: Sequence[Residuals]) -> Residuals:
    """Return the mean of the Residuals of several slices, for exchanges that all slices tested."""
    return {
        key: sum(one[key] for one in slices) / len(slices)
        for key in slices[0]
        if all(key in one for one in slices)
    }


def clear_exchange(left: Residuals) -> tuple[int, ...]:
    """Return the rows of the two exchanged anchors if one exchange is clearly best, else ()."""
    if len(left) < 2:
        return ()
    best, *others = sorted((key for key in left if key), key=left.__getitem__)
    other = left[others[0]] if others else left[()]
    by_far = left[best] < SHARE * left[()] and left[best] < OF_OTHERS * other
    gain = left[()] - left[best]
    alone = left[best] < MOST_LEFT * left[()] and gain > LEAST and gain > ALONE * (left[()] - other)
    return best if by_far or alone else ()
