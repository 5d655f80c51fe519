"""The radial-basis-function network of Grasso et al.

(Sensors 2022, 22, 9136), appendix A, and its extension to 3D.
"""

from __future__ import annotations

from itertools import product

import numpy as np

SHARE = 0.5  # c1: what a node contributes to the value at its own place (eq. A7)
SMALLEST_RATIO = 1e-6  # of a neighbour's value to a node's, in the logarithm of eq. A5
CHUNK = 2000  # places at a time


class AngularNetwork:
    """One Gaussian at every node, whose width depends on the direction in which one looks from
    there (eqs. A1 - A8).

    A width is chosen so that the Gaussian has fallen to its neighbour's share of the neighbour's
    value where that neighbour is (A3 - A5), and interpolated over the direction (A6). The value at
    a node with all its neighbours is then its own, but for the tails of nodes further off.

    The neighbours are the 8 around a node of a plane, linearly over the angle as published; in
    space the 26 around it, and over the direction by the inverse of one minus the cosine (Shepard),
    which takes a neighbour's width in its own direction.

    Where eq. A5 has no real positive width, it is repaired as little as possible: c2 is not
    negative (it would be where a neighbour's value exceeds 8 times the node's, 26 times in space,
    and the "Gaussian" would then grow with distance), and a neighbour of no value counts as
    SMALLEST_RATIO of the node's. The number of neighbours in eq. A3 stays 8 (26) at the rim, where
    there are fewer, as published: values there come out too close to the smallest one.
    """

    def __init__(self, cell: np.ndarray, at: np.ndarray, values: np.ndarray, step: float) -> None:
        """cell : (n, d) int, place in the grid; at : (n, d) m; values : (n, k); step : of the grid,
        m.
        """
        self._at, d = np.asarray(at, dtype=float), at.shape[1]
        self._cutoff = 2.0 * step  # the 1 m of eq. A8, on the paper's grid of 0.5 m
        self._offset = np.minimum(values.min(axis=0), 0.0)  # b_min, A1
        self._values = values - self._offset
        offsets = np.array([offset for offset in product((-1, 0, 1), repeat=d) if any(offset)])
        neighbour, there = _neighbours(cell, offsets)
        away = self._at[neighbour] - self._at[:, None]
        distance = np.linalg.norm(away, axis=2)
        there = there & np.asarray(distance > 0.0)
        c3 = (1.0 - SHARE) / (len(offsets) * SHARE)  # A4
        own = np.where(self._values > 0.0, self._values, 1.0)
        ratio = np.clip(c3 * self._values[neighbour] / own[:, None], SMALLEST_RATIO, 1.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            self._widths = -np.log(ratio) / distance[:, :, None] ** 2  # A5: (n, K, k)
            self._towards = np.where(there[:, :, None], away / distance[:, :, None], 0.0)
        self._widths[~there] = 0.0
        self._there = there
        self._alone = ~there.any(axis=1)
        self._width_alone = -np.log(c3) / step**2  # as if all neighbours were alike
        self._width_of = _over_angle if d == 2 else _over_direction

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Values at places x (m, d), m: (m, k). Far from every node: the smallest value, or 0 if
        none is negative (A8).
        """
        return np.concatenate(
            [self._at_places(part) for part in np.array_split(x, len(x) // CHUNK + 1)]
        )

    def _at_places(self, x: np.ndarray) -> np.ndarray:
        away = x[:, None] - self._at
        squared = np.einsum("mnd,mnd->mn", away, away)
        place, node = np.nonzero(squared < self._cutoff**2)
        squared, away = squared[place, node, None], away[place, node]
        there = self._there[node]
        width = self._width_of(away, self._towards[node], there, self._widths[node])
        width[self._alone[node]] = self._width_alone
        terms = SHARE * self._values[node] * np.exp(-width * squared)  # A7
        return self._offset + np.stack(
            [np.bincount(place, column, len(x)) for column in terms.T], axis=1
        )


def _neighbours(cell: np.ndarray, offsets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the nodes in the cells at `offsets` from each node, (n, K), and whether there is one,
    (n, K) bool.
    """
    shifted = cell - cell.min(axis=0) + 1
    shape = tuple(shifted.max(axis=0) + 2)
    key = np.ravel_multi_index(tuple(shifted.T), shape)
    order = np.argsort(key)
    wanted = np.ravel_multi_index(tuple(np.moveaxis(shifted[:, None] + offsets, 2, 0)), shape)
    place = np.minimum(np.searchsorted(key[order], wanted), len(key) - 1)
    found = order[place]
    return found, key[found] == wanted


def _over_angle(
    away: np.ndarray, towards: np.ndarray, there: np.ndarray, widths: np.ndarray
) -> np.ndarray:
    """Widths (P, k) in the directions `away` (P, 2), linear over the angle between the neighbours
    to the left and right.
    """
    full = 2.0 * np.pi
    angle = np.arctan2(away[:, 1], away[:, 0])[:, None] - np.arctan2(
        towards[:, :, 1], towards[:, :, 0]
    )
    behind = np.where(there, np.mod(angle, full), np.inf)
    ahead = np.where(there, np.mod(-angle, full), np.inf)
    row, last, following = np.arange(len(away)), np.argmin(behind, axis=1), np.argmin(ahead, axis=1)
    before, after = behind[row, last], ahead[row, following]
    span = before + after
    with np.errstate(invalid="ignore"):
        part = np.where(
            np.isfinite(span) & (span > 0.0), before / np.where(span > 0.0, span, 1.0), 0.0
        )[:, None]
    return (1.0 - part) * widths[row, last] + part * widths[row, following]


def _over_direction(
    away: np.ndarray, towards: np.ndarray, there: np.ndarray, widths: np.ndarray
) -> np.ndarray:
    """Widths (P, k) in the directions `away` (P, 3)."""
    length = np.linalg.norm(away, axis=1, keepdims=True)
    cosine = np.einsum("pd,pkd->pk", away / np.maximum(length, 1e-12), towards)
    weight = np.where(there, 1.0 / (1.0 - np.minimum(cosine, 1.0) + 1e-9), 0.0)
    total = weight.sum(axis=1, keepdims=True)
    return np.einsum("pk,pkc->pc", weight / np.where(total > 0.0, total, 1.0), widths)
