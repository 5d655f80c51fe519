# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Interpolate with the radial-basis-function network of Grasso et al., extended to 3D.

The source is Sensors 2022, 22, 9136, appendix A.
"""

from __future__ import annotations

from itertools import product

import numpy as np

SHARE = 0.5  # c1: share of a node in the value at its own place (eq. A7)
# smallest ratio of a neighbour's value to a node's in the logarithm of eq. A5
SMALLEST_RATIO = 1e-6
CHUNK = 2000  # places per call, which limits the memory


class AngularNetwork:
    """Interpolate with one Gaussian per node, whose width depends on the direction (eqs. A1 - A8).

    At the place of a neighbour, the Gaussian has fallen to the neighbour's share of the neighbour's
    value (A3 - A5). This determines the width in the direction of the neighbour. Between
    neighbours, the width is interpolated over the direction (A6). At a node with all its
    neighbours, the result is the node's value plus the tails of more distant nodes.

    In a plane a node has 8 neighbours, and the width is linear in the angle, as published. In space
    it has 26 neighbours. The weight of each is the inverse of one minus the cosine (Shepard). In
    the direction of a neighbour, the width is that of this neighbour.

    Where eq. A5 has no real positive width, two minimal repairs apply. First, c2 is not negative.
    It would be negative if a neighbour's value exceeds 8 times the node's, or 26 times in space.
    The "Gaussian" would then grow with distance. Second, a neighbour of value 0 counts as
    SMALLEST_RATIO of the node's value.

    The number of neighbours in eq. A3 stays 8 (26) at the rim, as published. Values at the rim are
    therefore too close to the smallest value.
    """

    def __init__(self, cell: np.ndarray, at: np.ndarray, values: np.ndarray, step: float) -> None:
        """Compute the widths of all nodes.

        Parameters
        ----------
        cell : (n, d) int array
            Place in the grid.
        at : (n, d) array
            Places of the nodes, in m.
        values : (n, k) array
            Values at the nodes.
        step : float
            Cell size of the grid, in m.
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
        self._width_alone = -np.log(c3) / step**2  # as if all neighbours had the value of the node
        self._width_of = _over_angle if d == 2 else _over_direction

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """Return the values at places x (m, d), in m: (m, k).

        Far from every node the result is the smallest value, or 0 if no value is negative (A8).
        """
        return np.concatenate(
            [self._at_places(part) for part in np.array_split(x, len(x) // CHUNK + 1)]
        )

    def _at_places(self, x: np.ndarray) -> np.ndarray:
        # Sum the Gaussians of all nodes within the cutoff, eq. A7.
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
    """Return the neighbours of each node.

    Parameters
    ----------
    cell : (n, d) int array
        Place of each node in the grid.
    offsets : (K, d) int array
        Steps to the K neighbours.

    Returns
    -------
    rows : (n, K) int array
        Rows of the neighbours.
    there : (n, K) bool array
        Whether the neighbour exists.
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
    """Return widths (P, k) in the directions `away` (P, 2), linear in the angle between neighbours.

    Parameters
    ----------
    away : (P, 2) array
        Directions, of any length.
    towards : (P, K, 2) array
        Unit vectors to the neighbours.
    there : (P, K) bool array
        Whether the neighbour exists.
    widths : (P, K, k) array
        Widths in the directions of the neighbours.
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
    """Return widths (P, k) in the directions `away` (P, 3), weighted by the cosine (Shepard).

    The other parameters are as for `_over_angle`, in three dimensions.
    """
    length = np.linalg.norm(away, axis=1, keepdims=True)
    cosine = np.einsum("pd,pkd->pk", away / np.maximum(length, 1e-12), towards)
    weight = np.where(there, 1.0 / (1.0 - np.minimum(cosine, 1.0) + 1e-9), 0.0)
    total = weight.sum(axis=1, keepdims=True)
    return np.einsum("pk,pkc->pc", weight / np.where(total > 0.0, total, 1.0), widths)
