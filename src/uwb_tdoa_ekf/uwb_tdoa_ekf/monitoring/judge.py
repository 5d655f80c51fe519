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
from collections.abc import Sequence
from itertools import combinations
import math
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.common.anchors import UNITS, Anchors
from uwb_tdoa_bias.common.radio import SPEED_OF_LIGHT

from .explain import STARTS, Snapshot, compare_losses, in_words, locate
from .finding import ERROR, Finding
from .mixed_ids import order_of_recording

# most pairs of a snapshot; fewest anchors: three coordinates and a scale need four differences
PAIRS, HEARD = (32, 5)
SMALL = 0.05  # m, median size of TDOAs below which they are not in metres themselves
# fewest snapshots of a clear and of any result; snapshots that are kept in flight
FEWEST, MANY, KEPT = (4, 10, 20)
# most anchors for tests of each anchor and of each pair; it limits the work
SINGLE = 12
# An order of more than two ids must leave less than CLEARER of the loss of the best other hypothesis.
CLEARER = 0.95
# smallest factor, ratio of successive factors, largest factor
SMALLEST, RATIO, LARGEST = (1.5, 1.25, 1500.0)
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
        # loss and position of the tag, (3,) m, with each hypothesis, for each snapshot
        self._found: deque[list[tuple[float, np.ndarray]]] = deque(maxlen=kept)

    def add(self, snapshot: np.ndarray) -> None:
        """Add TDOAs that were heard together, (k, 3): rows of both anchors, and value in m."""
        if len(np.unique(snapshot[:, :2])) < HEARD or not np.median(np.abs(snapshot[:, 2])) > SMALL:
            return
        count = min(PAIRS, len(snapshot))
        some = snapshot[np.linspace(0, len(snapshot) - 1, count).round().astype(int)]
        self._snapshots.append((some[:, :2].astype(np.int64), some[:, 2].copy()))
        self._found.append([self._located(one, *self._snapshots[-1]) for one in self._hypotheses])

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
        self._found.clear()

    def add_order(self) -> None:
        """Add the order of ids that explains all snapshots best to the hypotheses.

        In flight the Monitor finds it sooner, by where the tag was before.
        """
        surveyed = self._anchors.positions
        if len(self._found) < FEWEST or len(surveyed) > SINGLE or not self._best:
            return
        order, loss = order_of_recording(surveyed, self._snapshots)
        if len(order) > 2 and loss < CLEARER * self._losses.mean(axis=0).min():
            rows, at = zip(*order)
            one = Hypothesis(EXCHANGED, rows=rows, at=at)
            self._hypotheses.append(one)
            for each, found in zip(self._snapshots, self._found):
                found.append(self._located(one, *each))

    @property
    def _losses(self) -> np.ndarray:
        """Return the loss of each hypothesis on each snapshot, (k, h)."""
        return np.array([[loss for loss, _ in found] for found in self._found])

    @property
    def full(self) -> bool:
        """Return whether it holds as many snapshots as it keeps."""
        return len(self._found) == self._found.maxlen

    @property
    def finding(self) -> Finding | None:
        """Return the Finding on the mistake that beats every rival, or None."""
        best = self._named()
        if best is None:
            return None
        found, losses = self._hypotheses[best], self._losses
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
        found = self._hypotheses[self._best] if self._found else Hypothesis(AS_IT_IS)
        rows, at = (
            self._anchors.ids[list(some)].tolist() if found.kind == EXCHANGED else []
            for some in (found.rows, found.at)
        )
        return dict(zip(rows, at))

    @property
    def _best(self) -> int:
        """Return the number of the hypothesis that leaves least; 0 is the survey as it is."""
        return int(np.argmin(self._losses.mean(axis=0)))

    def _named(self) -> int | None:
        """Return the number of the hypothesis of a mistake that beats every rival, or None."""
        if len(self._found) < FEWEST:
            return None
        best = self._best
        kind = self._hypotheses[best].kind
        if kind == AS_IT_IS or not self._beats(best):
            return None
        clearly = kind != SIGN and self._beats(best, share=CLEARLY)
        moved = len(self._found) >= MANY and self._spread_of(best) > MOVED
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
        mine, losses = self._hypotheses[best], self._losses
        told = losses[:, best] != losses[:, 0]
        same = [(one.kind, one.rows) == (mine.kind, mine.rows) for one in self._hypotheses]
        rival = int(np.argmin(np.where(same, np.inf, losses.mean(axis=0))))
        return losses[told, rival], losses[told, best]

    def _spread_of(self, number: int) -> float:
        """Return the root mean square distance of the tag from its median place, in m."""
        places = np.array([found[number][1] for found in self._found])
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
