# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Detect whether the survey, or a single anchor, has another unit.

TDOAs that are heard together locate the tag in surveys of every scale. TDOAs in metres have an
absolute scale: with the tag among more than four anchors, only one scale of the survey fits. The
same TDOAs also locate the tag with other errors corrected. A scale is reported only if it explains
more than every other correction.
"""

from __future__ import annotations

from collections import deque
from itertools import combinations
import math
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.radio import SPEED_OF_LIGHT
from uwb_tdoa_bias.common.survey_faults import UNITS

from .explain import SCALE, compare_losses, in_words
from .finding import ERROR, Finding

# most pairs of a snapshot; fewest anchors: three coordinates and a scale need four differences
PAIRS, HEARD = (32, 5)
SMALL = 0.05  # m, median size of TDOAs below which they are not in metres themselves
# fewest snapshots of a clear and of any result; snapshots that are kept in flight
FEWEST, MANY, KEPT = (4, 20, 60)
# most anchors for tests of each anchor and of each pair; it limits the work
SINGLE = 12
# smallest factor, ratio of successive factors, largest factor
SMALLEST, RATIO, LARGEST = (1.5, 1.25, 1500.0)
# number of Gauss-Newton steps; longest step relative to the room
STEPS, NEAR = (8, 0.3)
STARTS = np.array(
    [[0.0, 0.0, 0.0], [0.6, 0.6, 0.6], [-0.6, -0.6, 0.6], [0.6, -0.6, -0.6], [-0.6, 0.6, -0.6]]
)
# Largest share of the loss that may remain, and smallest number of standard errors of the
# reduction. Another scale, or another place of one anchor, explains a part of any error: 0.84 of
# the loss remains for a tape with errors of 0.1 m. With a survey in feet, 0.50 remains on measured
# flights.
LEFT, DEVIATIONS = 0.65, 3.5
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
        Row of that anchor, or of both (EXCHANGED).
    """

    kind: int
    name: str = ""
    factor: float = 1.0
    rows: tuple[int, ...] = ()

    def positions(self, surveyed: np.ndarray) -> np.ndarray:
        """Return where the anchors are if the hypothesis is right, (N, 3) m.

        EXCHANGED anchors have the factor 1, and the order of a single one is its own.
        """
        if not self.rows:
            return surveyed / self.factor
        moved, rows = surveyed.copy(), list(self.rows)
        moved[rows] = surveyed[rows[::-1]] / self.factor
        return moved


class SurveyScale:
    """Store the loss of each hypothesis on the scale of Anchors, for each snapshot."""

    def __init__(self, anchors: Anchors, kept: int | None = KEPT) -> None:
        """Create all hypotheses.

        Parameters
        ----------
        anchors : Anchors
            Surveyed anchors.
        kept : int or None
            Number of latest snapshots to keep; None keeps all.
        """
        self._anchors = anchors
        self._hypotheses = _hypotheses(len(anchors))
        self._losses: deque[np.ndarray] = deque(maxlen=kept)  # (h,) losses of each snapshot
        self._places: deque[np.ndarray] = deque(maxlen=kept)  # (h, 3) positions of the tag, in m

    def add(self, snapshot: np.ndarray) -> None:
        """Add TDOAs that were heard together, (k, 3): rows of both anchors, and value in m."""
        if len(np.unique(snapshot[:, :2])) < HEARD or not np.median(np.abs(snapshot[:, 2])) > SMALL:
            return
        count = min(PAIRS, len(snapshot))
        some = snapshot[np.linspace(0, len(snapshot) - 1, count).round().astype(int)]
        rows, d = some[:, :2].astype(np.int64), some[:, 2].copy()
        losses = np.empty(len(self._hypotheses))
        places = np.empty((len(self._hypotheses), 3))
        for k, one in enumerate(self._hypotheses):
            positions = one.positions(self._anchors.positions)
            signed = -d if one.kind == SIGN else d
            losses[k] = locate(positions, rows, signed, STARTS, places[k])
        self._losses.append(losses)
        self._places.append(places)

    @property
    def finding(self) -> Finding | None:
        """Return the Finding on a wrong scale, or None."""
        if len(self._losses) < FEWEST:
            return None
        losses = np.array(self._losses)
        mean = losses.mean(axis=0)
        is_scale = np.array([one.kind in (SCALED, ALONE) for one in self._hypotheses])
        best = int(np.argmin(np.where(is_scale, mean, np.inf)))
        rival = int(np.argmin(np.where(is_scale, np.inf, mean)))
        left, z = compare_losses(losses[:, rival], losses[:, best])
        if left > LEFT or z < DEVIATIONS:
            return None
        moved = _spread(np.array([places[best] for places in self._places]))
        if left > CLEARLY and (len(losses) < MANY or moved < MOVED):
            return None
        evidence = f"{in_words(left, z)}, in {len(losses)} snapshots"
        found = self._hypotheses[best]
        if found.kind == ALONE:
            number = int(self._anchors.ids[found.rows[0]])
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
        # the data do not distinguish close scales: prefer that of a unit
        close = [
            k
            for k, one in enumerate(self._hypotheses)
            if one.kind == SCALED
            and one.name
            and abs(math.log(one.factor / found.factor)) < 0.7 * math.log(RATIO)
        ]
        named = self._hypotheses[min(close, key=lambda k: mean[k], default=best)]
        return _of_scale(named.name, named.factor, evidence)


def _of_scale(name: str, factor: float, evidence: str) -> Finding:
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
    cause, remedy = wrong_unit(name, factor)
    if not name:
        size = f"{factor:.3g} times too large"
        if factor < 1.0:
            size = f"{1.0 / factor:.3g} times too small"
        cause = f"the survey is not in metres: its positions are about {size}"
    return Finding(
        "survey_scale", ERROR, cause=cause, evidence=evidence, remedy=remedy, value=factor
    )


def wrong_unit(name: str, factor: float) -> tuple[str, str]:
    """Return (cause, remedy) of a survey in another unit, whose positions are too large."""
    cause = (
        f"the survey is in {name}, not in metres: its positions are {factor:,.5g} times too large"
    )
    line = f"x, y, z = x / {factor:.6g}, y / {factor:.6g}, z / {factor:.6g}  # of every anchor"
    return cause, line


def _hypotheses(count: int) -> list[Hypothesis]:
    """Return the hypotheses for a number of anchors."""
    count_of_scales = math.floor(math.log(LARGEST / SMALLEST) / math.log(RATIO)) + 1
    scales = SMALLEST * RATIO ** np.arange(count_of_scales)
    made = [Hypothesis(AS_IT_IS), Hypothesis(SIGN)]
    made += [Hypothesis(SCALED, "", factor) for factor in np.append(scales, 1.0 / scales).tolist()]
    made += [Hypothesis(SCALED, name, factor) for name, factor in UNITS.items()]
    if count <= SINGLE:
        for row in range(count):
            made += [Hypothesis(ALONE, name, factor, (row,)) for name, factor in UNITS.items()]
        made += [Hypothesis(EXCHANGED, rows=rows) for rows in combinations(range(count), 2)]
    return made


def _spread(places: np.ndarray) -> float:
    """Return the root mean square distance of places (n, 3) from their median, in m."""
    return float(np.sqrt(np.mean(np.sum((places - np.median(places, axis=0)) ** 2, axis=1))))


@compiled
def locate(
    positions: np.ndarray, rows: np.ndarray, d: np.ndarray, starts: np.ndarray, place: np.ndarray
) -> float:
    """Return the mean Geman-McClure loss, 0 to 1, at the best position of the tag.

    The search is a robust Gauss-Newton iteration from several starts, during which the scale of the
    loss decreases.

    Parameters
    ----------
    positions : (N, 3) array
        Anchor positions, in m.
    rows : (k, 2) int array
        Rows of both anchors of each TDOA.
    d : (k,) array
        TDOAs, in m.
    starts : (s, 3) array
        Start positions, in half sizes of the room.
    place : (3,) array
        Filled with the best position, in m.
    """
    n = len(d)
    # ends: positions of both anchors of each TDOA; low, high: corners of the room around them
    ends, low, high = np.empty((n, 2, 3)), np.full(3, np.inf), np.full(3, -np.inf)
    for i in range(n):
        for side in range(2):
            for j in range(3):
                ends[i, side, j] = positions[rows[i, side], j]
                low[j], high[j] = min(low[j], ends[i, side, j]), max(high[j], ends[i, side, j])
    size = math.sqrt(np.sum((high - low) ** 2))
    least, p, gradient = np.inf, np.empty(3), np.empty(3)
    normal = np.empty((3, 4))  # normal equations, the right side in the last column
    for start in range(len(starts)):
        for j in range(3):
            p[j] = 0.5 * (low[j] + high[j]) + 0.5 * starts[start, j] * (high[j] - low[j])
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
            _step(p, normal, NEAR * size)
    return least


@compiled
def _step(p: np.ndarray, normal: np.ndarray, longest: float) -> None:
    """Step p (3,) by the solution of normal equations, at most `longest` m far.

    The normal equations (3, 4) have the right side in the last column. They are overwritten.
    """
    for j in range(3):
        normal[j, j] += 1e-6
    for j in range(3):
        for k in range(j + 1, 3):
            share = normal[k, j] / normal[j, j]
            for m in range(j, 4):
                normal[k, m] -= share * normal[j, m]
    length = 0.0
    for j in range(2, -1, -1):
        for m in range(j + 1, 3):
            normal[j, 3] -= normal[j, m] * normal[m, 3]
        normal[j, 3] /= normal[j, j]
        length += normal[j, 3] ** 2
    share = min(1.0, longest / max(math.sqrt(length), 1e-12))
    for j in range(3):
        p[j] += share * normal[j, 3]
