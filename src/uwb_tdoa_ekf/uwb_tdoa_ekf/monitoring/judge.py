# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Judge which mistake of the survey, or of all TDOAs, explains a recording or the last seconds.

TDOAs that are heard together are a snapshot. It locates the tag under every hypothesis: as it is,
with the other sign, with another scale of the survey or of one anchor, and with two anchors
exchanged. A whole recording also has the order of ids that explains it best. All hypotheses compete
on the same snapshots. A mistake is named if it beats every rival.
A rival of a survey in another unit is the radio, whose errors depend on the place, as behind a body.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from itertools import combinations, permutations, product
import math
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.common.anchors import UNITS, Anchors
from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.radio import SPEED_OF_LIGHT

from ..core.ground import solve
from .anchor_watch import Piece, best_order
from .explain import SCALE, compare_losses, in_words
from .finding import ERROR, Finding

# most pairs of a snapshot; fewest anchors: three coordinates and a scale need four differences
PAIRS, HEARD = (32, 5)
SMALL = 0.05  # m, median size of TDOAs below which they are not in metres themselves
# fewest snapshots of a clear and of any result; snapshots that are kept in flight
FEWEST, MANY, KEPT = (4, 10, 20)
# most anchors for tests of each anchor and of each pair; it limits the work
SINGLE = 12
# An order of more than two ids must leave less than CLEARER of the loss of the best other hypothesis.
# Each wrong id must explain EACH of the loss, or all together if they are counted from another one: in
# a nearly symmetrical room several orders leave up to 3 % less than the right one.
CLEARER, EACH = 0.95, 0.008
# snapshots on which orders of ids are compared, to find some and to choose; orders that are improved;
# places, in half sizes of the room, from which the search begins
COMPARED, IMPROVED = (12, 60), 3
PLACES = np.array(list(product((-0.6, 0.0, 0.6), (-0.6, 0.0, 0.6), (-0.5, 0.5))))
# smallest factor, ratio of successive factors, largest factor
SMALLEST, RATIO, LARGEST = (1.5, 1.25, 1500.0)
# number of Gauss-Newton steps; longest step relative to the room
STEPS, NEAR = (8, 0.3)
# Anchors in a plane or in a line: start positions spread across it, too, by this share of their size.
# On it, no derivative leads away from it.
THIN = 0.4
STARTS = np.array(
    [[0.0, 0.0, 0.0], [0.6, 0.6, 0.6], [-0.6, -0.6, 0.6], [0.6, -0.6, -0.6], [-0.6, 0.6, -0.6]]
)
# Largest share of the loss of each rival that may remain, and smallest number of standard errors of
# the reduction; the same of the sign. Another scale, or another place of one anchor, explains a part
# of any error: 0.84 of the loss remains for a tape with errors of 0.1 m. On 13 measured recordings,
# 0.61 to 0.77 of the loss remains with the right sign, and 0.06 to 0.54 with the right ids.
LEFT, DEVIATIONS = 0.65, 3.5
OF_SIGN = (0.8, 3.0)
# Loss that errors of the radio cause, 0.18 m in each TDOA, and that moved anchors imitate. A body
# that shadows anchors: 0.11 at most, at factors below NO_RADIO that no unit has. Two anchors
# exchanged, or one in feet: 0.16 at least.
RADIO, NO_RADIO = 0.12, 4.0
# m by which the tag must have moved; share of the loss that is clear even after a few seconds and
# at rest
MOVED, CLEARLY = (0.3, 0.5)
# m per nanosecond; TDOAs in nanoseconds or feet look like a survey that is too small by this factor
NANOSECONDS = SPEED_OF_LIGHT / 1e9
AS_IT_IS, SCALED, SIGN, EXCHANGED, ALONE = range(5)  # kinds of hypotheses


Snapshot = tuple[np.ndarray, np.ndarray]  # rows of both anchors (k, 2), and TDOAs (k,) m


class Hypothesis(NamedTuple):
    """A mistake of the survey, or of the TDOAs.

    Attributes
    ----------
    kind : int
        AS_IT_IS, SCALED, SIGN, EXCHANGED or ALONE.
    name : str
        Unit that the factor stands for, or "".
    factor : float
        Factor by which all anchors, or one (ALONE), are too far from the origin.
    rows : tuple of int
        Row of that anchor, or of those with another id (EXCHANGED).
    at : tuple of int
        Rows at whose surveyed places these anchors are.
    """

    kind: int
    name: str = ""
    factor: float = 1.0
    rows: tuple[int, ...] = ()
    at: tuple[int, ...] = ()

    def positions(self, surveyed: np.ndarray) -> np.ndarray:
        """Return where the anchors are if the hypothesis is right, (N, 3) m."""
        if not self.rows:
            return surveyed / self.factor
        moved = surveyed.copy()
        moved[list(self.rows)] = surveyed[list(self.at)] / self.factor
        return moved


class Judge:
    """Store the loss of each hypothesis on Anchors and their TDOAs, for each snapshot."""

    def __init__(
        self, anchors: Anchors, kept: int | None = KEPT, doubtful: Sequence[int] | None = None
    ) -> None:
        """Create all hypotheses.

        Parameters
        ----------
        anchors : Anchors
            Surveyed anchors.
        kept : int or None
            Number of latest snapshots to keep; None keeps all.
        doubtful : sequence of int or None
            Rows of the anchors that may be exchanged, or may each be in another unit; None: all.
        """
        self._anchors = anchors
        self._hypotheses = _hypotheses(range(len(anchors)) if doubtful is None else doubtful)
        self._snapshots: deque[Snapshot] = deque(maxlen=kept)
        self._losses: deque[np.ndarray] = deque(maxlen=kept)  # (h,) losses of each snapshot
        self._places: deque[np.ndarray] = deque(maxlen=kept)  # (h, 3) positions of the tag, in m

    def add(self, snapshot: np.ndarray) -> None:
        """Add TDOAs that were heard together, (k, 3): rows of both anchors, and value in m."""
        if len(np.unique(snapshot[:, :2])) < HEARD or not np.median(np.abs(snapshot[:, 2])) > SMALL:
            return
        count = min(PAIRS, len(snapshot))
        some = snapshot[np.linspace(0, len(snapshot) - 1, count).round().astype(int)]
        self._snapshots.append((some[:, :2].astype(np.int64), some[:, 2].copy()))
        found = [self._located(one, *self._snapshots[-1]) for one in self._hypotheses]
        self._losses.append(np.array([loss for loss, _ in found]))
        self._places.append(np.array([place for _, place in found]))

    def _located(
        self, one: Hypothesis, rows: np.ndarray, d: np.ndarray
    ) -> tuple[float, np.ndarray]:
        """Return the loss of a Hypothesis on a snapshot, and the place of the tag (3,) m."""
        place = np.empty(3)
        ends = one.positions(self._anchors.positions)[rows]
        return locate(ends, -d if one.kind == SIGN else d, STARTS, place), place

    def forget(self) -> None:
        """Drop all snapshots, because from now on the TDOAs differ."""
        self._snapshots.clear()
        self._losses.clear()
        self._places.clear()

    def add_order(self) -> None:
        """Add the order of ids that explains all snapshots best to the hypotheses.

        In flight the Monitor finds it sooner, by where the tag was before. Here the search begins at
        places all over the room. The best orders are then improved by exchanges of two anchors.
        """
        surveyed = self._anchors.positions
        if len(self._losses) < FEWEST or len(surveyed) > SINGLE or not self._best:
            return
        low, high = surveyed.min(axis=0), surveyed.max(axis=0)
        across = np.maximum(high - low, THIN * np.linalg.norm(high - low))
        few, many = (
            [self._snapshots[k] for k in np.linspace(0, len(self._snapshots) - 1, n).astype(int)]
            for n in COMPARED
        )

        def loss(order: tuple[int, ...], some: Sequence[Snapshot] = few) -> float:
            one = _of_order(order)
            left = np.mean([self._located(one, *each)[0] for each in some])
            turned = len({(at - row) % len(order) for row, at in enumerate(order)}) == 1
            return float(left) * (1.0 + EACH * (1 if turned else len(one.rows)))

        found = set()
        for rows, d in few[::2]:
            for begin in 0.5 * (low + high) + 0.5 * PLACES * across:
                piece = Piece(rows[:, 0], rows[:, 1], d, begin, begin)
                found.add(tuple(best_order(surveyed, [piece])[0].tolist()))
        begun = [tuple(range(len(surveyed))), *sorted(found, key=loss)[:IMPROVED]]
        likely = {image for order in begun for image in _images(_improved(order, loss), surveyed)}
        of_many = partial(loss, some=many)
        best = _improved(min(likely, key=of_many), of_many)
        one, others = _of_order(best), float(np.mean(self._losses, axis=0).min())
        if len(one.rows) > 2 and of_many(best) < CLEARER * others:
            self._hypotheses.append(one)
            for number, each in enumerate(self._snapshots):
                left, place = self._located(one, *each)
                self._losses[number] = np.append(self._losses[number], left)
                self._places[number] = np.vstack([self._places[number], place])

    @property
    def full(self) -> bool:
        """Return whether it holds as many snapshots as it keeps."""
        return len(self._losses) == self._losses.maxlen

    @property
    def finding(self) -> Finding | None:
        """Return the Finding on the mistake that beats every rival, or None."""
        best = self._named()
        if best is None:
            return None
        found, losses = self._hypotheses[best], np.array(self._losses)
        rival, own = self._against(best)
        left, z = compare_losses(rival, own)
        evidence = f"{in_words(left, z)}, in {len(own)} snapshots"
        if found.kind == SIGN:
            return wrong_sign(evidence, left)
        if found.kind == EXCHANGED:
            return exchanged(self.order, evidence)
        if found.kind == ALONE:
            number = self._anchors.ids[found.rows[0]]
            return Finding(
                "anchor_scale",
                ERROR,
                cause=f"the position of anchor {number} is in {found.name}, not in metres",
                evidence=evidence,
                remedy=(
                    f"{number}: {{position: [x, y, z]}}  # what is there now, divided by "
                    f"{found.factor:.6g}"
                ),
                value=found.factor,
            )
        close = self._units_near(found.factor)
        mean = losses.mean(axis=0)
        named = self._hypotheses[min(close, key=lambda k: mean[k], default=best)]
        return wrong_scale(named.name, named.factor, evidence)

    @property
    def order(self) -> dict[int, int]:
        """Return {id as received: id of that anchor} if other ids explain more than any mistake, or {}."""
        found = self._hypotheses[self._best] if self._losses else Hypothesis(AS_IT_IS)
        rows, at = (
            self._anchors.ids[list(some)].tolist() if found.kind == EXCHANGED else []
            for some in (found.rows, found.at)
        )
        return dict(zip(rows, at))

    @property
    def _best(self) -> int:
        """Return the number of the hypothesis that leaves least; 0 is the survey as it is."""
        return int(np.argmin(np.mean(self._losses, axis=0)))

    def _named(self) -> int | None:
        """Return the number of the hypothesis of a mistake that beats every rival, or None."""
        if len(self._losses) < FEWEST:
            return None
        best = self._best
        kind = self._hypotheses[best].kind
        if kind == AS_IT_IS or not self._beats(best):
            return None
        clearly = kind != SIGN and self._beats(best, share=CLEARLY)
        moved = len(self._losses) >= MANY and self._spread_of(best) > MOVED
        return best if clearly or moved else None

    def _beats(self, best: int, share: float = LEFT) -> bool:
        """Return whether a hypothesis beats its rivals by the margin.

        share : largest share of their loss that may remain
        """
        one, (rival, own) = self._hypotheses[best], self._against(best)
        if len(own) < FEWEST:
            return False
        left, z = compare_losses(rival, own)
        if one.kind == SIGN:
            return left <= OF_SIGN[0] and z >= OF_SIGN[1]
        any_size = one.kind == SCALED and (
            abs(math.log(one.factor)) > math.log(NO_RADIO) or self._units_near(one.factor)
        )
        if not any_size and np.mean(rival - own) < RADIO:
            return False
        return left <= share and z >= DEVIATIONS

    def _units_near(self, factor: float) -> list[int]:
        """Return the numbers of scales of a unit that the data do not distinguish from a factor."""
        return [
            k
            for k, one in enumerate(self._hypotheses)
            if one.kind == SCALED
            and one.name
            and abs(math.log(one.factor / factor)) < 0.7 * math.log(RATIO)
        ]

    def _against(self, best: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the losses of the best rival, and those of a hypothesis.

        They are of the snapshots in which it changes anything: a tag hears a part of a hall.
        """
        mine, losses = self._hypotheses[best], np.array(self._losses)
        told = losses[:, best] != losses[:, 0]
        same = [(one.kind, one.rows) == (mine.kind, mine.rows) for one in self._hypotheses]
        rival = int(np.argmin(np.where(same, np.inf, losses.mean(axis=0))))
        return losses[told, rival], losses[told, best]

    def _spread_of(self, number: int) -> float:
        """Return the root mean square distance of the tag from its median place, in m."""
        places = np.array([places[number] for places in self._places])
        off = places - np.median(places, axis=0)
        return float(np.sqrt(np.mean(np.sum(off**2, axis=1))))


def wrong_sign(evidence: str, value: float = math.nan) -> Finding:
    """Return the Finding that the sign of all TDOAs is wrong."""
    return Finding(
        "tdoa_sign",
        ERROR,
        cause="the sign of all TDOAs is wrong",
        evidence=evidence,
        remedy="message.distance_difference = distance_to_b - distance_to_a  # not a - b",
        value=value,
    )


def exchanged(table: dict[int, int], evidence: str, value: float = math.nan) -> Finding:
    """Return the Finding that ids are mixed up, {id as received: id of that anchor}."""
    one, other = [*table][:2]
    cause, or_else = f"two anchors are exchanged, {one} and {other}", ""
    if len(table) > 2:
        or_else = "; or give the survey of this room, if this is that of another"
        names = ", ".join(f"{wrong} is {right}" for wrong, right in table.items())
        cause = f"the ids of anchors are mixed up: what is called {names}"
    return Finding(
        "ids_exchanged",
        ERROR,
        cause=cause,
        evidence=evidence,
        remedy=f"id = {table}.get(id, id)  # or exchange their positions{or_else}",
        value=float(one) if math.isnan(value) else value,
    )


def wrong_scale(name: str, factor: float, evidence: str) -> Finding:
    """Return the Finding on a survey that is too large by a factor, the unit `name` or "".

    With a factor near NANOSECONDS, the TDOAs are in another unit, not the survey.
    """
    if abs(math.log(factor / NANOSECONDS)) < math.log(RATIO):
        return Finding(
            "tdoa_unit",
            ERROR,
            cause="TDOAs are in nanoseconds or in feet, not in metres",
            evidence=evidence,
            remedy=(
                f"message.distance_difference *= {NANOSECONDS}  # of nanoseconds; of feet 0.3048"
            ),
            value=NANOSECONDS,
        )
    size = f"{factor:,.5g} times too large"
    if not name:
        size = f"about {max(factor, 1.0 / factor):.3g} times too {'large' if factor > 1.0 else 'small'}"
    unit = f"in {name}, not" if name else "not"
    return Finding(
        "survey_scale",
        ERROR,
        cause=f"the survey is {unit} in metres: its positions are {size}",
        evidence=evidence,
        remedy=f"x, y, z = x / {factor:.6g}, y / {factor:.6g}, z / {factor:.6g}  # of every anchor",
        value=factor,
    )


def _hypotheses(doubtful: Sequence[int]) -> list[Hypothesis]:
    """Return the hypotheses, with those on single anchors if few are doubtful (rows)."""
    count_of_scales = math.floor(math.log(LARGEST / SMALLEST) / math.log(RATIO)) + 1
    scales = SMALLEST * RATIO ** np.arange(count_of_scales)
    made = [Hypothesis(AS_IT_IS), Hypothesis(SIGN)]
    made += [Hypothesis(SCALED, "", factor) for factor in np.append(scales, 1.0 / scales).tolist()]
    made += [Hypothesis(SCALED, name, factor) for name, factor in UNITS.items()]
    if len(doubtful) <= SINGLE:
        for row in doubtful:
            made += [Hypothesis(ALONE, name, by, (row,), (row,)) for name, by in UNITS.items()]
        made += [
            Hypothesis(EXCHANGED, rows=rows, at=rows[::-1]) for rows in combinations(doubtful, 2)
        ]
    return made


def _of_order(order: Sequence[int]) -> Hypothesis:
    """Return the Hypothesis that anchor k is at the place of order[k]."""
    rows = tuple(row for row, at in enumerate(order) if row != at)
    return Hypothesis(EXCHANGED, rows=rows, at=tuple(order[row] for row in rows))


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


def _improved(order: tuple[int, ...], loss: Callable[[tuple[int, ...]], float]) -> tuple[int, ...]:
    """Return an order that no exchange of two anchors improves, from `order` on."""
    least, better = loss(order), order
    while better:
        order, better = better, ()
        for one, other in combinations(range(len(order)), 2):
            trial = [*order]
            trial[one], trial[other] = order[other], order[one]
            if (left := loss(tuple(trial))) < least:
                least, better = left, tuple(trial)
    return order


@compiled
def locate(ends: np.ndarray, d: np.ndarray, starts: np.ndarray, place: np.ndarray) -> float:
    """Return the mean Geman-McClure loss, 0 to 1, at the best position of the tag.

    The search is a robust Gauss-Newton iteration from several starts, during which the scale of the
    loss decreases.

    Parameters
    ----------
    ends : (k, 2, 3) array
        Positions of both anchors of each TDOA, in m.
    d : (k,) array
        TDOAs, in m.
    starts : (s, 3) array
        Start positions, in half sizes of the room.
    place : (3,) array
        Filled with the best position, in m.
    """
    n, low, high = len(d), np.empty(3), np.empty(3)
    for j in range(3):  # corners of the room around the anchors
        low[j], high[j] = ends[:, :, j].min(), ends[:, :, j].max()
    size = math.sqrt(np.sum((high - low) ** 2))
    least, p, gradient = np.inf, np.empty(3), np.empty(3)
    normal = np.empty((3, 4))  # normal equations, the right side in the last column
    for start in range(len(starts)):
        for j in range(3):
            across = max(high[j] - low[j], THIN * size)
            p[j] = 0.5 * (low[j] + high[j]) + 0.5 * starts[start, j] * across
        for step in range(STEPS + 1):  # the last one evaluates the loss only
            scale, loss = max(0.3 * size * 0.5**step, SCALE) if step < STEPS else SCALE, 0.0
            normal[:, :] = 0.0
            for i in range(n):
                residual = d[i]  # measured minus predicted
                for side in range(2):
                    length = 1e-18
                    for j in range(3):
                        length += (p[j] - ends[i, side, j]) ** 2
                    length = math.sqrt(length)
                    residual += length if side == 0 else -length
                    for j in range(3):
                        unit = (p[j] - ends[i, side, j]) / length
                        gradient[j] = -unit if side == 0 else gradient[j] + unit
                square = (residual / scale) ** 2
                loss += square / (1.0 + square)
                weight = 1.0 / (1.0 + square) ** 2
                for j in range(3):
                    for k in range(3):
                        normal[j, k] += weight * gradient[j] * gradient[k]
                    normal[j, 3] += weight * gradient[j] * residual
            if step == STEPS:
                if loss / n < least:
                    least = loss / n
                    place[:] = p
                break
            for j in range(3):
                normal[j, j] += 1e-6
            solve(normal)
            length = math.sqrt(np.sum(normal[:, 3] ** 2))
            p += min(1.0, NEAR * size / max(length, 1e-12)) * normal[:, 3]
    return least
