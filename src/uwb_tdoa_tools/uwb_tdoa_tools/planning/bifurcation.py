# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find where the TDOAs of k + 1 anchors have two solutions, by a formula and by a solver.

With m_0 one of k + 1 anchors and r the tag's distance to it, the TDOAs D_i = |x - m_i| - r turn
    (r + D_i)^2 = |x - m_i|^2
into k equations that are linear in x and r,
    a_i . (x - m_0) + D_i r = (|a_i|^2 - D_i^2) / 2,   a_i = m_i - m_0.
Their solution is a line in the space of (x, r): x = m_0 + p + q r with A q = -D. The line meets
the cone |x - m_0| = r where
    (|q|^2 - 1) r^2 + 2 p.q r + |p|^2 = 0.
One root is the tag. The product of both roots is |p|^2 / (|q|^2 - 1). If |q| < 1, the other root
is negative and belongs to no position. If |q| > 1, it belongs to a second position with the same
TDOAs. So |q| = 1 is the bifurcation curve (k = 2) or surface (k = 3).

For k = 2, times det(A)^2, this is the polynomial of Compagnoni et al. (Inverse Problems 30, 2014,
035004) that Grasso et al. use in sec. 2.3.1. If the height is known and the anchors have other
heights, only the right-hand sides change, not |q|.

The solver starts from many places and does not use this formula.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.geometry import ranges

from .installation import principal_extents

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.anchors import Anchors


# thickness over length: anchors so close to a line (plane) mirror each position in it
FLAT_SUBSET = 0.05
MOST_SUBSETS = 2000
_CHUNK = 500_000  # numbers in the largest array of one step


class Subsets:
    """All choices of k + 1 anchors that are not flat.

    rows : (Q, k + 1) rows of the anchors; left_out : number of flat choices. A flat choice mirrors
    every position. If there are more than MOST_SUBSETS choices, only anchors that come close together
    in the round are combined.
    """

    def __init__(self, anchors: Anchors, dimensions: int) -> None:
        """Choose the subsets of Anchors for k dimensions, 2 or 3.

        Raises InputError if all choices are flat.
        """
        self.anchors, self.dimensions = anchors, dimensions
        candidates = _choices(len(anchors), dimensions + 1)
        corners = anchors.positions[candidates][:, :, :dimensions]
        extents = principal_extents(corners)
        flat = extents[:, -1] <= FLAT_SUBSET * extents[:, 0]
        self.rows, self.left_out = candidates[~flat], int(flat.sum())
        if not len(self.rows):
            raise InputError(
                f"anchors: every {dimensions + 1} of them are nearly in one "
                f"{'line' if dimensions == 2 else 'plane'}; "
                "spread them out."
            )
        corners = corners[~flat]
        inverse = np.linalg.inv(corners[:, 1:] - corners[:, :1])  # (Q, k, k)
        self._q = np.zeros((len(self.rows), dimensions, len(anchors)))  # q = self._q @ distances
        q = np.arange(len(self.rows))[:, None]
        self._q[q, :, self.rows[:, 1:]] = -inverse.swapaxes(1, 2)
        self._q[q[:, 0], :, self.rows[:, 0]] = inverse.sum(axis=2)

    def discriminant(self, points: np.ndarray) -> np.ndarray:
        """Return |q|^2 - 1 of each subset: (n, Q), negative where there is one solution.

        points : (n, 3) m.
        """
        size, k = len(self.rows), self.dimensions
        matrix = self._q.reshape(size * k, -1).T
        out = np.empty((len(points), size))
        at = 0
        for chunk in np.array_split(points, max(1, len(points) * size * k // _CHUNK)):
            q = _distances(chunk, self.anchors.positions) @ matrix
            out[at : at + len(chunk)] = (
                np.einsum("nqk,nqk->nq", *[q.reshape(len(chunk), size, k)] * 2) - 1.0
            )
            at += len(chunk)
        return out

    def ambiguous(self, points: np.ndarray) -> np.ndarray:
        """Return the share of the subsets with two solutions: (n,)."""
        return np.mean(self.discriminant(points) > 0.0, axis=1)

    def mirrors(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the other positions with the same TDOAs: (point (m,), subset (m,), position (m, 3) m).

        Only pairs of a point and a subset with two solutions are returned. A known height stays.
        """
        k = self.dimensions
        row, subset = np.nonzero(self.discriminant(points) > 0.0)
        reference = self.anchors.positions[self.rows[subset, 0]]
        distances = _distances(points, self.anchors.positions)[row]
        q = np.einsum("mkn,mn->mk", self._q[subset], distances)
        away = points[row] - reference
        r = np.linalg.norm(away, axis=1)
        p = away[:, :k] - q * r[:, None]
        squared = np.einsum("mk,mk->m", p, p) + np.einsum("mk,mk->m", away[:, k:], away[:, k:])
        other = squared / ((np.einsum("mk,mk->m", q, q) - 1.0) * np.maximum(r, 1e-12))
        return row, subset, np.hstack([reference[:, :k] + p + q * other[:, None], points[row, k:]])


def _distances(points: np.ndarray, anchors: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - anchors, axis=-1)


def _choices(n: int, k: int) -> np.ndarray:
    """Return choices of k out of n: (Q, k).

    If there are more than MOST_SUBSETS, each choice lies within the longest stretch of the ring that
    keeps their number below it.
    """
    every = np.array(list(combinations(range(min(n, 40)), k)))
    if n <= 40 and len(every) <= MOST_SUBSETS:
        return every
    stretch = k
    while n * len(list(combinations(range(stretch), k - 1))) <= MOST_SUBSETS:
        stretch += 1
    starts = np.array([(0, *rest) for rest in combinations(range(1, stretch), k - 1)])
    return (starts[None] + np.arange(n)[:, None, None]).reshape(-1, k) % n


SWEEPS = 40
SOLVED = 1e-9  # m, residual of a solution
APART = 3e-4  # of the anchors' extent: two solutions nearer than this are one
DIRECTIONS = 12  # of the starts in a plane; in space three times as many
# of the starts, over the anchors' extent
RADII = (0.03, 0.1, 0.3, 0.7, 1.5, 4.0, 12.0, 40.0, 150.0)


def solutions(points: np.ndarray, corners: np.ndarray, dimensions: int) -> np.ndarray:
    """Return the positions that a solver finds from many starts: (n, s, k) m.

    points : (n, 3) m; corners : (k + 1, 3) m, anchors; dimensions : k. Each of the s starts is a
    Levenberg-Marquardt descent on the k TDOAs of a point. NaN marks a descent without a solution.
    """
    centre = corners[:, :dimensions].mean(axis=0)
    extent = np.linalg.norm(corners - corners.mean(axis=0), axis=1).max()
    rays = _directions(dimensions)
    starts = centre + extent * np.concatenate([radius * rays for radius in RADII])
    x: np.ndarray = np.tile(starts, (len(points), 1))
    heights = np.repeat(points[:, 2:], len(starts), axis=0)[:, : 3 - dimensions]
    wanted = np.repeat(_tdoas(points, corners)[0], len(starts), axis=0)

    found = np.full_like(x, np.nan)
    row: np.ndarray = np.arange(len(x))  # of the points that are not solved yet
    cost, gradient, normal = _normal_equations(x, heights, wanted, corners)
    damping: np.ndarray = np.full(len(x), 1e-3)
    for _ in range(SWEEPS):
        scale = np.sqrt(np.maximum(np.einsum("nii->ni", normal), 1e-24))
        damped = normal / (scale[:, :, None] * scale[:, None, :]) + damping[:, None, None] * np.eye(
            dimensions
        )
        step = np.linalg.solve(damped, (gradient / scale)[..., None])[..., 0] / scale
        longest = extent + np.linalg.norm(x - centre, axis=1)
        step *= np.minimum(1.0, longest / np.maximum(np.linalg.norm(step, axis=1), 1e-300))[:, None]
        new = _normal_equations(x + step, heights, wanted, corners)
        better = new[0] < cost
        x[better] += step[better]
        for old, value in zip((cost, gradient, normal), new):
            old[better] = value[better]
        damping = np.clip(damping * np.where(better, 0.2, 5.0), 1e-14, 1e14)
        solved = cost < SOLVED**2
        found[row[solved]] = x[solved]
        row, x, heights, wanted, damping, cost, gradient, normal = (
            array[~solved] for array in (row, x, heights, wanted, damping, cost, gradient, normal)
        )
    return found.reshape(len(points), len(starts), dimensions)


def same_place(points: np.ndarray, found: np.ndarray, anchors: np.ndarray) -> np.ndarray:
    """Return whether positions (..., k) m are points (..., 3) m, within the solver's tolerance.

    The tolerance is a share of the extent of anchors (N, 3) m.
    """
    apart = APART * np.linalg.norm(np.ptp(anchors, axis=0))
    return np.linalg.norm(found - points[..., : found.shape[-1]], axis=-1) <= apart


def _normal_equations(
    x: np.ndarray, heights: np.ndarray, wanted: np.ndarray, corners: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    d, jacobian = _tdoas(np.hstack([x, heights]), corners)
    jacobian, residual = jacobian[:, :, : x.shape[1]], wanted - d
    cost = np.einsum("ni,ni->n", residual, residual)
    return cost, np.einsum("nik,ni->nk", jacobian, residual), jacobian.swapaxes(1, 2) @ jacobian


def _tdoas(x: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the TDOAs against the first corner and their derivatives: (n, k) m, (n, k, 3)."""
    distance, unit = ranges(x[:, None], corners)
    return distance[:, 1:] - distance[:, :1], unit[:, 1:] - unit[:, :1]


def _directions(dimensions: int) -> np.ndarray:
    """Return evenly spread unit vectors: (DIRECTIONS, 2), or a sphere of (3 DIRECTIONS, 3)."""
    if dimensions == 2:
        angle = 2.0 * np.pi * (np.arange(DIRECTIONS) + 0.31) / DIRECTIONS
        return np.stack([np.cos(angle), np.sin(angle)], axis=1)
    k = np.arange(3 * DIRECTIONS) + 0.5
    z, angle = 1.0 - 2.0 * k / (3 * DIRECTIONS), np.pi * (1.0 + np.sqrt(5.0)) * k
    return np.column_stack(
        [np.sqrt(1.0 - z**2) * np.cos(angle), np.sqrt(1.0 - z**2) * np.sin(angle), z]
    )
