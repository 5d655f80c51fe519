# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Find the order of anchor ids that are mixed up: an anchor transmits from the place of another.

`residuals` searches in flight. The position of the filter may be wrong by then. Each order
therefore gets its own best position near the filter's position. Orders are the survey, each
exchange of two suspects, and the permutation of all ids that explains the TDOAs best.

`order_of_recording` searches a whole recording. The place of the tag is unknown, so the search
begins at places all over the room. The best orders are then improved by exchanges of two anchors.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from itertools import combinations, permutations, product
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from uwb_tdoa_bias.common.geometry import ranges, tdoa

from .anchor_watch import CLIP, FEWEST
from .explain import STARTS, THIN, Snapshot, locate

# (row of an anchor, row of its place) of each anchor with another id; () without any
Order = tuple[tuple[int, int], ...]
Residuals = dict[Order, float]  # m, mean absolute residual with each Order
Places = dict[Order, np.ndarray]  # (3,) m, position of the tag in the latest Piece with each Order

SUSPECTS = 8  # number of anchors with the largest innovations, whose exchanges are tested
LARGE = 0.3  # m, smallest largest mean innovation at which exchanges are tested
LOCATED_STD = 1.0  # m, standard deviation of the position of the filter
# m, standard deviation of one TDOA; m, scale of the Geman-McClure weight; iterations for the
# position
STD, ROBUST, STEPS = (0.15, 0.4, 3)
ASSIGNMENTS = 6  # most steps of the search for a permutation
# largest ratio of the residual of an order to the residual of the survey, and to that of any
# other exchange
RIGHT, OF_OTHERS = (0.4, 0.8)
# m, least median residual of the survey at which permutations are tried: delays of a few anchors
# leave a smaller one, and a permutation might explain them
MIXED = 0.4
# alternative for an exchange: largest ratio to the survey if the reduction exceeds the second value,
# in m, and the reduction by any other exchange times the third value
MOST_LEFT, LEAST, ALONE = (0.65, 0.1, 2.5)
# A wrong id must explain EACH of the loss, or all together if they are counted from another one: in a
# nearly symmetrical room several orders leave up to 3 % less than the right one.
EACH = 0.008
# snapshots on which orders of ids are compared, to find some and to choose; orders that are improved;
# places, in half sizes of the room, from which the search begins
COMPARED, IMPROVED = (12, 60), 3
PLACES = np.array(list(product((-0.6, 0.0, 0.6), (-0.6, 0.0, 0.6), (-0.5, 0.5))))


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
    known = [piece._replace(p=piece.known) for piece in pieces]
    positions, ids, surveyed = positions[rows], dict(named), tuple(range(len(rows)))
    pairs = combinations(np.searchsorted(rows, sorted(tried)).tolist(), 2)
    # orders, and the Pieces that begin where the tag may be with them
    trials = [([surveyed, *(_exchanged(surveyed, *pair) for pair in pairs)], pieces)]
    as_surveyed = [_located(positions[None], piece)[0][0] for piece in pieces]
    if np.median(np.concatenate(as_surveyed)) > MIXED:
        for begun in (pieces, known):
            order, located = best_order(positions, begun)
            trials.append(([order], located))
    if len(ids) > 2 and ids.keys() <= set(rows.tolist()):
        at = [ids.get(row, row) for row in rows.tolist()]
        trials.append(([tuple(np.searchsorted(rows, at).tolist())], known))
    best: dict[Order, tuple[float, np.ndarray]] = {}
    for orders, some in trials:
        found = [_located(positions[np.array(orders)], piece) for piece in some]
        means = np.mean([off.mean(axis=1) for off, _ in found], axis=0).tolist()
        for order, mean, place in zip(orders, means, found[-1][1]):
            name = named_order(rows, order)
            if mean < best.get(name, (np.inf,))[0]:
                best[name] = mean, place
    left = {name: mean for name, (mean, _) in best.items()}
    return left, {name: place for name, (_, place) in best.items()}


def named_order(rows: np.ndarray, order: Sequence[int]) -> Order:
    """Return the Order of anchors `rows` (n,) that are at the places of rows[order]."""
    places = zip(rows.tolist(), rows[list(order)].tolist())
    return tuple((one, at) for one, at in places if one != at)


def _heard(pieces: Sequence[Piece]) -> tuple[np.ndarray, list[Piece]]:
    """Return the rows of the anchors that are heard, and the Pieces with places in these rows."""
    rows = np.unique(np.concatenate([end for piece in pieces for end in piece[:2]]))
    return rows, [
        piece._replace(a=np.searchsorted(rows, piece.a), b=np.searchsorted(rows, piece.b))
        for piece in pieces
    ]


def best_order(
    positions: np.ndarray, pieces: Sequence[Piece]
) -> tuple[tuple[int, ...], list[Piece]]:
    """Return the row of the place of each anchor that explains Pieces best, and located Pieces.

    Differences of distances determine each distance but for a constant. The assignment of these
    distances to places, and the position of the tag, are found in turns.

    positions : (N, 3) places of the anchors, all of which are heard, in m
    """
    count, pieces = len(positions), [*pieces]
    order = np.empty(0, int)
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
        before, order = order, linear_sum_assignment(cost)[1]
        if np.array_equal(order, before):
            break
        places = [_located(positions[order][None], piece)[1][0] for piece in pieces]
        pieces = [piece._replace(p=place) for piece, place in zip(pieces, places)]
    return tuple(order.tolist()), pieces


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
        information = np.swapaxes(weighted, 1, 2) @ jacobian + np.eye(3) / LOCATED_STD**2
        vector = np.einsum("knc,kn->kc", weighted, residual) - (place - p) / LOCATED_STD**2
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
        if left[mixed] < RIGHT * left[()] and left[mixed] < OF_OTHERS * left[best]:
            return mixed
    other = left[others[0]] if others else left[()]
    by_far = left[best] < RIGHT * left[()] and left[best] < OF_OTHERS * other
    gain = left[()] - left[best]
    alone = left[best] < MOST_LEFT * left[()] and gain > LEAST and gain > ALONE * (left[()] - other)
    return best if by_far or alone else ()


def order_of_recording(surveyed: np.ndarray, snapshots: Sequence[Snapshot]) -> tuple[Order, float]:
    """Return the Order that explains all snapshots best, and its loss with EACH for each wrong id.

    surveyed : (N, 3) positions in the world frame, in m
    """
    low, high, rows = surveyed.min(axis=0), surveyed.max(axis=0), np.arange(len(surveyed))
    across = np.maximum(high - low, THIN * np.linalg.norm(high - low))
    few, many = (
        [snapshots[k] for k in np.linspace(0, len(snapshots) - 1, n).astype(int)] for n in COMPARED
    )

    def loss(order: tuple[int, ...], some: Sequence[Snapshot] = few) -> float:
        at, place = surveyed[list(order)], np.empty(3)
        left = np.mean([locate(at[ends], d, STARTS, place) for ends, d in some])
        turned = len(set((np.array(order) - rows) % len(rows))) == 1
        return float(left) * (1.0 + EACH * (1 if turned else np.count_nonzero(order != rows)))

    found = set()
    for ends, d in few[::2]:
        for begin in 0.5 * (low + high) + 0.5 * PLACES * across:
            piece = Piece(ends[:, 0], ends[:, 1], d, begin, begin)
            found.add(best_order(surveyed, [piece])[0])
    begun = [tuple(rows.tolist()), *sorted(found, key=loss)[:IMPROVED]]
    likely = {image for order in begun for image in _images(_improved(order, loss), surveyed)}
    of_many = partial(loss, some=many)
    best = _improved(min(likely, key=of_many), of_many)
    return named_order(rows, best), of_many(best)


def _improved(order: tuple[int, ...], loss: Callable[[tuple[int, ...]], float]) -> tuple[int, ...]:
    """Return an order that no exchange of two anchors improves, from `order` on."""
    pairs, least = list(combinations(range(len(order)), 2)), loss(order)
    while True:
        best = min((_exchanged(order, *pair) for pair in pairs), key=loss)
        if loss(best) >= least:
            return order
        order, least = best, loss(best)


def _exchanged(order: tuple[int, ...], one: int, other: int) -> tuple[int, ...]:
    """Return an order with the places of two anchors exchanged."""
    out = [*order]
    out[one], out[other] = order[other], order[one]
    return tuple(out)


def _images(order: tuple[int, ...], surveyed: np.ndarray) -> list[tuple[int, ...]]:
    """Return the orders that a nearly symmetrical room hardly distinguishes from `order`.

    surveyed : (N, 3) places of the anchors, in m
    """
    off, images = surveyed - 0.5 * (surveyed.min(axis=0) + surveyed.max(axis=0)), [order]
    for axes, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        away = np.linalg.norm((off[:, list(axes)] * signs)[:, None] - off, axis=2)
        nearest = away.argmin(axis=1)
        if len(set(nearest.tolist())) == len(surveyed):
            images.append(tuple(nearest[list(order)].tolist()))
    return images
