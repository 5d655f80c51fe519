"""Where positioning fails however precise it is: where the TDOAs of k + 1 anchors have two
positions.

With m_0 one of k + 1 anchors and r the tag's distance to it, the TDOAs D_i = |x - m_i| - r turn
    (r + D_i)^2 = |x - m_i|^2
into k equations that are linear in x and r,
    a_i . (x - m_0) + D_i r = (|a_i|^2 - D_i^2) / 2,   a_i = m_i - m_0:
a line in the space of (x, r), x = m_0 + p + q r with A q = -D. It meets the cone |x - m_0| = r
where
    (|q|^2 - 1) r^2 + 2 p.q r + |p|^2 = 0.
One root is the tag. The product of the two is |p|^2 / (|q|^2 - 1): where |q| < 1 the other root is
negative and belongs to no position, where |q| > 1 it is positive and belongs to a second position
with the same TDOAs. So the position is unique where |q|^2 - 1 < 0, and |q| = 1 is the bifurcation
curve (k = 2) or surface (k = 3). For k = 2, times det(A)^2, this is the polynomial of Compagnoni et
al. (Inverse Problems 30, 2014, 035004) that Grasso et al. use in sec. 2.3.1. A tag of known height
among anchors of other heights only adds constants to the right-hand sides, and nothing to |q|.
"""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.geometry import ranges

from .installation import principal_extents

if TYPE_CHECKING:
    from uwb_tdoa_bias.foundation.anchors import Anchors

FLAT_SUBSET = (
    0.05  # thickness over length; anchors so close to a line (plane) mirror every position in it
)
MOST_SUBSETS = 2000
_CHUNK = 500_000  # numbers in the largest array of one step


class Subsets:
    """The pairings whose solutions are asked for: all choices of k + 1 anchors that are not flat.

    rows : (Q, k + 1) rows of the anchors; left_out : number of flat ones, which mirror every
        position and are no use.
    Of more than MOST_SUBSETS choices, only those of anchors that come close together in the round
    are taken.
    """

    def __init__(self, anchors: Anchors, dimensions: int) -> None:
        """anchors : Anchors; dimensions : k, 2 or 3. Raises InputError if all choices are flat."""
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
        """|q|^2 - 1 of every subset: (n, Q), negative where the position is the only one with its
        TDOAs.

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
        """Share of the subsets with two positions: (n,), 0 where every pairing has one."""
        return np.mean(self.discriminant(points) > 0.0, axis=1)

    def slopes(self, points: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Derivatives of the sum of weights (n, Q) times the discriminants along the anchors'
        positions: (N, 3) 1/m.

        With A q = -D and u_j the direction from anchor j to the tag, d|q|^2 / dm_j = 2 c_j (q -
        u_j), where c_j is q times the column of j in q = columns @ distances; along a known height,
        where q has no part, -2 c_j u_j.
        """
        distances, unit = ranges(points[:, None], self.anchors.positions)
        size, k = len(self.rows), self.dimensions
        total = np.zeros_like(self.anchors.positions)
        for chunk in np.array_split(
            np.arange(len(points)), max(1, len(points) * size * len(total) // _CHUNK)
        ):
            q = (distances[chunk] @ self._q.reshape(size * k, -1).T).reshape(-1, size, k)
            share = (
                2.0 * weights[chunk, :, None] * np.einsum("nqk,qkj->nqj", q, self._q)
            )  # 0 for anchors not in q
            total[:, :k] += np.einsum("nqj,nqk->jk", share, q)
            total -= np.einsum("nqj,njk->jk", share, unit[chunk])
        return total

    def mirrors(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The other positions with the same TDOAs: (row of the point (m,), subset (m,), position
        (m, 3) m).

        Only where there is one. The height stays, if known.
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
    """(Q, k) choices of k out of n, all within the shortest stretch of the ring that is needed to
    keep within MOST_SUBSETS.
    """
    every = np.array(list(combinations(range(min(n, 40)), k)))
    if n <= 40 and len(every) <= MOST_SUBSETS:
        return every
    stretch = k
    while n * len(list(combinations(range(stretch), k - 1))) <= MOST_SUBSETS:
        stretch += 1
    starts = np.array([(0, *rest) for rest in combinations(range(1, stretch), k - 1)])
    return (starts[None] + np.arange(n)[:, None, None]).reshape(-1, k) % n
