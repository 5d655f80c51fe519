"""Two anchors that were exchanged: each sends from where the other is said to be."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from uwb_tdoa_bias.foundation.geometry import tdoa

LARGE = 0.75  # m, median innovation of the TDOAs with either of the two
GAIN = 4.0  # how much less it must be with them exchanged
SUSPECTS = 4  # anchors with the largest innovations
WITHIN, SHARE = 1.0, 0.9  # m, in which this share of all TDOAs must be then: on a floor much else is wrong
FEWEST = 20  # TDOAs with either of the two


def swapped(positions: np.ndarray, a: np.ndarray, b: np.ndarray, d: np.ndarray, p: np.ndarray) -> tuple[int, ...]:
    """Rows of two anchors, the smaller first, which, exchanged, explain what is wrong, or ().

    positions : (N, 3) m; a, b : (n,) rows; d : (n,) m, measured; p : (n, 3) m, where the filter had the tag. A filter that
    has enough other anchors stays where the tag is.
    """
    rows, both = np.unique(np.concatenate([a, b]), return_inverse=True)
    a, b, positions, n = both[: len(a)], both[len(a) :], positions[rows], len(rows)  # of those that are heard
    error = np.abs(d - tdoa(p, positions[a], positions[b]))
    total = np.bincount(a, error, n) + np.bincount(b, error, n)
    mean = total / np.maximum(np.bincount(a, minlength=n) + np.bincount(b, minlength=n), 1)
    best = LARGE
    pair: tuple[int, ...] = ()
    suspects = [row for row in np.argsort(-mean)[:SUSPECTS].tolist() if mean[row] > LARGE]
    for i, k in combinations(suspects, 2):
        concerned = np.isin(a, (i, k)) | np.isin(b, (i, k))
        if concerned.sum() < FEWEST:
            continue
        now = np.median(error[concerned])
        exchanged = positions.copy()
        exchanged[[i, k]] = positions[[k, i]]
        left = np.abs(d - tdoa(p, exchanged[a], exchanged[b]))
        then = np.median(left[concerned])
        if now > LARGE and GAIN * then < now and then < best and np.quantile(left, SHARE) < WITHIN:
            best, pair = then, (int(rows[min(i, k)]), int(rows[max(i, k)]))
    return pair
