"""Two anchors that were exchanged: each sends from where the other is said to be.

The place of the filter may be wrong by then. So each exchange gets the place, about that of the
filter, at which it explains a slice best, and so does the survey as it is.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.geometry import ranges, tdoa

if TYPE_CHECKING:
    from collections.abc import Sequence

    # m, mean absolute residual by the rows of two exchanged anchors; () : of none
    Residuals = dict[tuple[int, ...], float]

SUSPECTS = 8  # anchors with the largest innovations, whose exchanges are tried,
LARGE = 0.3  # m, if the largest is as large as that
PLACE_STD = 1.0  # m, by which the filter may be off
# m, of one TDOA; m, scale of the Geman-McClure weight; solutions for the place
STD, ROBUST, STEPS = (0.15, 0.4, 3)
CLIP = 1.5  # m; a larger residual counts as this
FEWEST = 10  # TDOAs of a slice
# of the residuals that an exchange may leave, of those as surveyed and of those of any other
# exchange;
SHARE, OF_OTHERS = (0.4, 0.8)
# or more, if it explains so much, m, and so many times as much as any other
MOST_LEFT, LEAST, ALONE = (0.65, 0.1, 2.5)


def residuals(
    positions: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    d: np.ndarray,
    p: np.ndarray,
    named: Sequence[int] = (),
) -> Residuals:
    """Residuals of a slice with each exchange of two suspects, and with none; {} where nothing is
    far off, and no exchange is named.

    positions : (N, 3) m; a, b : (n,) rows; d : (n,) m, measured; p : (3,) m, where the filter had
        the tag; named : rows of two anchors
    that are tried in any case.
    """
    rows, both = np.unique(np.concatenate([a, b]), return_inverse=True)
    # of those that are heard
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
    """(m,) m: mean absolute residual with each of several positions (m, N, 3) m of the anchors, at
    the place that fits best.
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
    """Mean of the Residuals of several slices, of the exchanges that were tried in all."""
    return {
        key: sum(one[key] for one in slices) / len(slices)
        for key in slices[0]
        if all(key in one for one in slices)
    }


def clear_exchange(left: Residuals) -> tuple[int, ...]:
    """Rows of the two anchors, exchanged, that explain what is wrong, and no other two; () of none."""
    if len(left) < 2:
        return ()
    best, *others = sorted((key for key in left if key), key=left.__getitem__)
    other = left[others[0]] if others else left[()]
    by_far = left[best] < SHARE * left[()] and left[best] < OF_OTHERS * other
    gain = left[()] - left[best]
    alone = left[best] < MOST_LEFT * left[()] and gain > LEAST and gain > ALONE * (left[()] - other)
    return best if by_far or alone else ()
