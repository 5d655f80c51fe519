# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Detect ids of anchors that are mixed up: an anchor transmits from the surveyed place of another.

The position of the filter may be wrong by then. Each hypothesis therefore gets its own best
position near the filter's position. Hypotheses are the survey, each exchange of two suspects, and
the permutation of all ids that explains the TDOAs best.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.common.geometry import ranges, tdoa

from .slices import CLIP, FEWEST

# (row of an anchor, row of its place) of each anchor with another id; () without any
Order = tuple[tuple[int, int], ...]
Residuals = dict[Order, float]  # m, mean absolute residual with each Order
Places = dict[Order, np.ndarray]  # (3,) m, position of the tag in the latest Piece with each Order

SUSPECTS = 8  # number of anchors with the largest innovations, whose exchanges are tested
LARGE = 0.3  # m, smallest largest mean innovation at which exchanges are tested
PLACE_STD = 1.0  # m, standard deviation of the position of the filter
# m, standard deviation of one TDOA; m, scale of the Geman-McClure weight; iterations for the
# position
STD, ROBUST, STEPS = (0.15, 0.4, 3)
ASSIGNMENTS = 6  # most steps of the search for a permutation
# largest ratio of the residual of an order to the residual of the survey, and to that of any
# other exchange
SHARE, OF_OTHERS = (0.4, 0.8)
# m, least median residual of the survey at which permutations are tried: delays of a few anchors
# leave a smaller one, and a permutation might explain them
MIXED = 0.4
# alternative for an exchange: largest ratio to the survey if the reduction exceeds the second value,
# in m, and the reduction by any other exchange times the third value
MOST_LEFT, LEAST, ALONE = (0.65, 0.1, 2.5)


class Piece(NamedTuple):
    """TDOAs that are heard while the tag is at one place.

    Attributes
    ----------
    a, b : (n,) int array
        Rows of the anchors of each TDOA.
    d : (n,) array
        Measured TDOAs, in m.
    p : (3,) array
        Position of the filter in the world frame, in m.
    known : (3,) array
        The same at which the search for a permutation begins: the filter moves away from where it
        was right.
    """

    a: np.ndarray
    b: np.ndarray
    d: np.ndarray
    p: np.ndarray
    known: np.ndarray


def suspects(positions: np.ndarray, piece: Piece, named: Order = ()) -> set[int]:
    """Return the rows of the anchors whose ids may be wrong, with those that are `named` already.

    The result is empty if all innovations are small and nothing is named.

    positions : (N, 3) surveyed positions in the world frame, in m
    """
    ends = np.concatenate([piece.a, piece.b])
    rows, place = np.unique(ends, return_inverse=True)
    if len(piece.a) < FEWEST:
        return set()
    error = np.abs(piece.d - tdoa(piece.p, positions[piece.a], positions[piece.b]))
    mean = np.bincount(place, np.tile(error, 2)) / np.bincount(place)
    tried = set(rows.tolist()) & set(dict(named))
    if mean.max() >= LARGE:
        tried |= set(rows[np.argsort(-mean)[:SUSPECTS]].tolist())
    return tried


def residuals(
    positions: np.ndarray, pieces: Sequence[Piece], tried: set[int], named: Order = ()
) -> tuple[Residuals, Places]:
    """Return Residuals and Places with each exchange of two anchors in `tried`, and with none.

    The permutation that explains most is among them, and the one that is `named`, if most TDOAs
    contradict the survey.

    positions : (N, 3) surveyed positions in the world frame, in m
    """
    rows, pieces = _heard(pieces)
    positions, ids = positions[rows], dict(named)
    orders = [np.arange(len(rows))]
    for pair in combinations(np.searchsorted(rows, sorted(tried)).tolist(), 2):
        orders.append(np.arange(len(rows)))
        orders[-1][[*pair]] = pair[::-1]
    found = [_located(positions[np.array(orders)], piece) for piece in pieces]
    names = [named_order(rows, order) for order in orders]
    left = dict(zip(names, np.mean([off.mean(axis=1) for off, _ in found], axis=0).tolist()))
    place = dict(zip(names, found[-1][1]))
    known, trials = [piece._replace(p=piece.known) for piece in pieces], []
    if np.median(np.concatenate([off[0] for off, _ in found])) > MIXED:
        trials = [best_order(positions, pieces), best_order(positions, known)]
    if len(ids) > 2 and ids.keys() <= set(rows.tolist()):
        at = [ids.get(row, row) for row in rows.tolist()]
        trials.append((np.searchsorted(rows, at), known))
    for order, located in trials:
        found = [_located(positions[order][None], piece) for piece in located]
        name, mean = named_order(rows, order), float(np.mean([off.mean() for off, _ in found]))
        if mean < left.get(name, np.inf):
            left[name], place[name] = mean, found[-1][1][0]
    return left, place


def named_order(rows: np.ndarray, order: np.ndarray) -> Order:
    """Return the Order of anchors `rows` (n,) that are at the places of rows[order]."""
    return tuple((int(one), int(at)) for one, at in zip(rows, rows[order]) if one != at)


def _heard(pieces: Sequence[Piece]) -> tuple[np.ndarray, list[Piece]]:
    """Return the rows of the anchors that are heard, and the Pieces with places in these rows."""
    rows = np.unique(np.concatenate([end for piece in pieces for end in piece[:2]]))
    return rows, [
        piece._replace(a=np.searchsorted(rows, piece.a), b=np.searchsorted(rows, piece.b))
        for piece in pieces
    ]


def best_order(positions: np.ndarray, pieces: Sequence[Piece]) -> tuple[np.ndarray, list[Piece]]:
    """Return the row of the place of each anchor that explains Pieces best, (N,), and located Pieces.

    Differences of distances determine each distance but for a constant. The assignment of these
    distances to places, and the position of the tag, are found in turns.

    positions : (N, 3) places of the anchors, all of which are heard, in m
    """
    count, order, pieces = len(positions), np.empty(0, int), [*pieces]
    levels = []  # rows of the heard anchors, and their distances less the mean, in m
    for piece in pieces:
        ends = np.eye(count)[piece.b] - np.eye(count)[piece.a]
        levels.append((ends.any(axis=0), np.linalg.lstsq(ends, piece.d, rcond=None)[0]))
    for _ in range(ASSIGNMENTS):
        cost = np.zeros((count, count))
        for piece, (heard, level) in zip(pieces, levels):
            away = ranges(piece.p, positions)[0]
            off = level[heard, None] + away[order[heard] if len(order) else heard].mean() - away
            cost[heard] += np.minimum(np.abs(off), CLIP)
        before, order = order, _assigned(cost)
        if np.array_equal(order, before):
            break
        places = [_located(positions[order][None], piece)[1][0] for piece in pieces]
        pieces = [piece._replace(p=place) for piece, place in zip(pieces, places)]
    return order, pieces


def _assigned(cost: np.ndarray) -> np.ndarray:
    """Return the column of each row, (n,), such that no exchange of two lowers the sum of costs."""
    order = np.arange(len(cost))
    while True:
        of = cost[:, order]
        gain = np.add.outer(np.diag(of), np.diag(of)) - of - of.T
        one, other = np.unravel_index(np.argmax(gain), gain.shape)
        if gain[one, other] < 1e-9:
            return order
        order[[one, other]] = order[[other, one]]


def _located(positions: np.ndarray, piece: Piece) -> tuple[np.ndarray, np.ndarray]:
    """Return the absolute residuals of each order at its best position, (m, n) m, and that, (m, 3).

    positions : (m, N, 3) orders of the anchors, in m
    """
    a, b, d, p, _ = piece
    place = np.tile(p, (len(positions), 1))
    for _ in range(STEPS):
        away, towards = ranges(place[:, None], positions)
        residual, jacobian = d - (away[:, b] - away[:, a]), towards[:, b] - towards[:, a]
        weighted = jacobian / (STD * (1.0 + (residual / ROBUST) ** 2))[:, :, None] ** 2
        information = np.swapaxes(weighted, 1, 2) @ jacobian + np.eye(3) / PLACE_STD**2
        vector = np.einsum("knc,kn->kc", weighted, residual) - (place - p) / PLACE_STD**2
        place = place + np.linalg.solve(information, vector[:, :, None])[:, :, 0]
    away = ranges(place[:, None], positions)[0]
    return np.minimum(np.abs(d - (away[:, b] - away[:, a])), CLIP), place


def clear_order(left: Residuals, before: Order = ()) -> Order:
    """Return the Order if one exchange or permutation is clearly best, else ().

    Some rooms are nearly symmetrical: the Order that was found `before` has precedence.
    """
    pairs: list[Order] = sorted((key for key in left if len(key) == 2), key=left.__getitem__)
    best, *others = pairs or [()]
    for mixed in sorted((key for key in left if len(key) > 2), key=lambda key: key != before):
        if left[mixed] < SHARE * left[()] and left[mixed] < OF_OTHERS * left[best]:
            return mixed
    other = left[others[0]] if others else left[()]
    by_far = left[best] < SHARE * left[()] and left[best] < OF_OTHERS * other
    gain = left[()] - left[best]
    alone = left[best] < MOST_LEFT * left[()] and gain > LEAST and gain > ALONE * (left[()] - other)
    return best if by_far or alone else ()
