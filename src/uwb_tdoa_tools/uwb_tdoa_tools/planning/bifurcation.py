# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find where the TDOAs of k + 1 anchors have two solutions, by a formula.

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

`other_solutions` weighs all TDOAs of a round. With d(x) the distances from x to the N anchors that
are heard at p, D the anchor pairs of the TDOAs of a round, F the covariance of these TDOAs, and
Q = D' F^-1 D the information matrix of the distances, 1/m^2 (`precision.round_weights`),
    f(x) = (d(x) - d(p))' Q (d(x) - d(p))
is the squared misfit, in standard deviations, of a tag at x with the TDOAs of a tag at p. Its
smallest minimum is p, with 0. Levenberg-Marquardt searches a second one, from the mirrored places
of choices of k + 1 anchors; k is the number of unknown coordinates, 2 or 3. An estimator that weighs
all TDOAs prefers the second minimum with probability Phi(-sqrt(f) / 2).

One more anchor raises f everywhere, but it may also make a second minimum. A long valley may come
apart in two minima, or a minimum outside of the room may move into it. That is a property of this
definition, not of the search.
"""

from __future__ import annotations

from itertools import combinations
import math

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.errors import InputError

from ..simulation.rooms import Room
from .precision import Installation, principal_extents, round_weights

# thickness over length: anchors so close to a line (plane) mirror each position in it
FLAT_SUBSET = 0.05
MOST_SUBSETS = 2000
# numbers in the largest array of one step: of mirrored places, of second minima
_OF_PLACES, _OF_MINIMA = 500_000, 2_000_000


class Subsets:
    """All choices of k + 1 anchors that are not flat.

    rows : (Q, k + 1) rows of the anchors. A flat choice mirrors every position. If there are more
    than MOST_SUBSETS choices, only anchors that come close together in the round are combined.
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
        self.rows = candidates[~flat]
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
        for chunk in np.array_split(points, max(1, len(points) * size * k // _OF_PLACES)):
            q = _distances(chunk, self.anchors.positions) @ matrix
            out[at : at + len(chunk)] = (
                np.einsum("nqk,nqk->nq", *[q.reshape(len(chunk), size, k)] * 2) - 1.0
            )
            at += len(chunk)
        return out

    def ambiguous(self, points: np.ndarray) -> np.ndarray:
        """Return the share of the subsets with two solutions: (n,)."""
        return np.mean(self.discriminant(points) > 0.0, axis=1)


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


FLIP = 0.5  # m; a minimum nearer than this is no failure, but imprecision
CLEAR = 4.65  # standard deviations of misfit from which on at most 1 % of the estimates flip
NEAREST = 8  # anchors whose choices of k + 1 are mirrored
DESCENTS = 12  # from the mirrored places of least misfit
MAX_STEPS = 60  # of a descent
SETTLED = 0.01  # a descent ends where another step would lower f by less than this
LONGEST = 5.0  # m, of a step
AROUND = 2.0  # m outside of the room, to which starts farther out are moved
SAME = 0.5 * FLIP  # m between starts that count as one
_FLAT = 1e-6  # of the volume of a cube; k + 1 anchors of less are in one plane (line)


def other_solutions(
    points: np.ndarray, installation: Installation, room: Room, columns: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Return the second minimum of least misfit inside a room: (misfit (n,), place (n, 3) m).

    The misfit is in standard deviations; inf and NaN if no descent ends inside the room
    and more than FLIP away.
    points : (n, 3) m; columns : (n, K) rows of the anchors that are heard at each point; None for all.
    """
    anchors = installation.anchors
    if columns is None:
        columns = np.tile(np.arange(len(anchors)), (len(points), 1))
    heard = columns.shape[1]
    choices = np.array(list(combinations(range(min(NEAREST, heard)), installation.unknowns + 1)))
    corners = np.stack([room.lower, room.upper])
    out = np.empty((len(points), 4))
    at_once = max(1, _OF_MINIMA // max(heard**2, len(anchors)))
    for begin in range(0, len(points), at_once):
        some = slice(begin, begin + at_once)
        variances = installation.noise.variance(points[some], anchors)
        variance = np.take_along_axis(variances, columns[some], axis=1)
        weights = np.ascontiguousarray(round_weights(variance, installation))
        heard_at = np.ascontiguousarray(columns[some])
        _search(points[some], anchors.positions, heard_at, weights, corners, choices, out[some])
    return np.sqrt(out[:, 0]), out[:, 1:]


@compiled
def _search(
    points: np.ndarray,
    positions: np.ndarray,
    columns: np.ndarray,
    weights: np.ndarray,
    room: np.ndarray,
    choices: np.ndarray,
    out: np.ndarray,
) -> None:
    """Fill out (n, 4): misfit squared and place, m; inf and NaN without a second minimum.

    points, columns : as of `other_solutions`; positions : (N, 3) m of anchors
    weights : (n, K, K) 1/m^2, Q; room : (2, 3) m, its corners
    choices : (C, k + 1) indices into the heard anchors, nearest first
    """
    heard, unknowns = columns.shape[1], choices.shape[1] - 1
    anchors, distances, end = np.empty((heard, 3)), np.empty(heard), np.empty(3)
    starts, values = np.empty((len(choices), 3)), np.empty(len(choices))
    for n in range(len(points)):
        point = points[n]
        out[n, 0] = np.inf
        out[n, 1:] = np.nan
        for i in range(heard):
            anchors[i] = positions[columns[n, i]]
            distances[i] = _distance(point, anchors[i])
        nearest = np.argsort(distances)
        for c in range(len(choices)):
            values[c] = np.inf
            if _mirror(point, anchors, distances, nearest[choices[c]], starts[c]):
                for axis in range(unknowns):
                    low, high = room[0, axis] - AROUND, room[1, axis] + AROUND
                    starts[c, axis] = min(max(starts[c, axis], low), high)
                values[c] = _misfit(starts[c], anchors, distances, weights[n])
        best = np.argsort(values)
        for c in range(min(DESCENTS, len(choices))):
            start = starts[best[c]]
            skipped = not values[best[c]] < np.inf or _distance(start, point) < SAME
            for better in range(c):
                skipped = skipped or _distance(start, starts[best[better]]) < SAME
            if skipped:
                continue
            f = _descend(start, point, anchors, distances, weights[n], unknowns, end)
            for axis in range(unknowns):
                f = f if room[0, axis] <= end[axis] <= room[1, axis] else np.inf
            if f < out[n, 0] and _distance(end, point) > FLIP:
                out[n, 0] = f
                out[n, 1:] = end


@compiled
def _mirror(
    point: np.ndarray, anchors: np.ndarray, true: np.ndarray, rows: np.ndarray, out: np.ndarray
) -> bool:
    """Put the other solution of k + 1 anchors into `out`; return whether there is one.

    See `bifurcation`. If the anchors are in a plane (line), it is the place on its other side.
    """
    k, first = len(rows) - 1, anchors[rows[0]]
    matrix, right, q = np.eye(3), np.zeros(3), np.empty(3)
    size = 1e-9
    for i in range(k):
        for j in range(k):
            matrix[j, i] = anchors[rows[i + 1], j] - first[j]
            size = max(size, abs(matrix[j, i]))
    out[:] = point
    if abs(_volume(matrix[0], matrix[1], matrix[2])) < _FLAT * size**k:
        normal = np.cross(matrix[:, 0], matrix[:, 4 - k])
        length = math.sqrt(np.sum(normal**2))
        if length < _FLAT * size ** (k - 1):
            return False
        normal /= length
        out -= 2.0 * np.sum((point - first) * normal) * normal
        return True
    r = true[rows[0]]
    for i in range(k):
        right[i] = r - true[rows[i + 1]]
    _solve(matrix, right, q)
    squared, product = 0.0, 0.0
    for j in range(3):
        squared += q[j] ** 2
        product += (point[j] - first[j] - q[j] * r) ** 2
    if squared <= 1.0:
        return False
    other = product / ((squared - 1.0) * max(r, 1e-12))
    for j in range(k):
        out[j] += q[j] * (other - r)
    return True


@compiled
def _solve(matrix: np.ndarray, right: np.ndarray, out: np.ndarray) -> None:
    """Put x with sum_j matrix[j] x_j = right into `out`, (3,), by Cramer's rule.

    It takes 6 ns, np.linalg.solve 360 ns. A descent calls it in each step.
    """
    volume = _volume(matrix[0], matrix[1], matrix[2])
    out[0] = _volume(right, matrix[1], matrix[2]) / volume
    out[1] = _volume(matrix[0], right, matrix[2]) / volume
    out[2] = _volume(matrix[0], matrix[1], right) / volume


@compiled
def _volume(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> float:
    return (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        - a[1] * (b[0] * c[2] - b[2] * c[0])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


@compiled
def _distance(p: np.ndarray, q: np.ndarray) -> float:
    return math.sqrt((p[0] - q[0]) ** 2 + (p[1] - q[1]) ** 2 + (p[2] - q[2]) ** 2)


@compiled
def _misfit(x: np.ndarray, anchors: np.ndarray, true: np.ndarray, weight: np.ndarray) -> float:
    """Return f at x."""
    change, total = np.empty(len(anchors)), 0.0
    for i in range(len(anchors)):
        change[i] = _distance(x, anchors[i]) - true[i]
        row = 0.0
        for j in range(i):
            row += weight[i, j] * change[j]
        total += change[i] * (2.0 * row + weight[i, i] * change[i])
    return max(total, 0.0)


@compiled
def _descend(
    start: np.ndarray,
    point: np.ndarray,
    anchors: np.ndarray,
    true: np.ndarray,
    weight: np.ndarray,
    unknowns: int,
    end: np.ndarray,
) -> float:
    """Return f at the end of a descent, and put the place into `end`.

    Returns inf if the descent does not end, or ends at the point itself.
    """
    x, f = start.copy(), _misfit(start, anchors, true, weight)
    both, weighed = np.empty((len(anchors), 4)), np.empty((len(anchors), 4))
    normal, damped, right, step = np.empty((4, 4)), np.eye(3), np.zeros(3), np.empty(3)
    damping = 1e-2
    for _ in range(MAX_STEPS):
        for i in range(len(anchors)):
            r = _distance(x, anchors[i])
            for k in range(3):
                both[i, k] = (x[k] - anchors[i, k]) / max(r, 1e-9)
            both[i, 3] = r - true[i]
        np.dot(weight, both, weighed)
        np.dot(both.T, weighed, normal)
        right[:unknowns] = -normal[:unknowns, 3]
        lower = False
        for _ in range(12):  # until a step leads down
            damped[:unknowns, :unknowns] = normal[:unknowns, :unknowns]
            for a in range(unknowns):
                damped[a, a] += damping * normal[a, a] + 1e-12
            _solve(damped, right, step)
            length = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
            gain = step[0] * right[0] + step[1] * right[1] + step[2] * right[2]
            if gain < SETTLED and damping <= 1e-2 and length < 0.5 * FLIP:
                end[:] = x
                return f
            for a in range(3):
                end[a] = x[a] + step[a] * min(1.0, LONGEST / max(length, 1e-12))
            new = _misfit(end, anchors, true, weight)
            if new < f:
                lower = True
                x[:], f = end, new
                damping = max(0.2 * damping, 1e-6)
                break
            damping *= 6.0
        if not lower:  # a corner of f, at an anchor: it is lower there than around
            end[:] = x
            return f
        if _distance(x, point) < FLIP:
            return np.inf
    return np.inf
