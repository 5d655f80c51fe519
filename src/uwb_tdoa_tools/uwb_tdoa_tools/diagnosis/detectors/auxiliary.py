# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Detectors of effects of auxiliary sensors that last for an interval, and the interval search."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np

from uwb_tdoa_bias.effects.sensor import FloorStep, IntervalEffect, VelocitySlip

from ..regression.fit import Fit
from ..regression.table import RegressionTable
from ..regression.terms import Candidate, Term
from .base import Detector

BIN = 1.0  # s, resolution of the limits of an interval
SHORTEST = 2  # bins, shortest interval
LONGEST = 0.7  # share of a flight; a longer effect counts as constant
WHOLE = 0.95  # share of the information on an anchor; more counts as constant
LEAST_GAIN = 10.0  # smallest gain, twice a log-likelihood


def best_interval(
    t: np.ndarray,
    score: np.ndarray,
    power: np.ndarray,
    prior: float,
    signed: bool = False,
    rows: slice | np.ndarray = slice(None),
) -> tuple[float, dict[str, float], float]:
    """Return the best (gain, {limit: value}, price of the search) over intervals of t (n,), s.

    score, power : (m,) weighted products of a regressor with the residual and with itself
    prior : information of the prior of its size
    signed : whether its size may be negative
    rows : (m,) rows of t of score and power; at others the regressor is zero
    """
    first = t.min()
    bins = ((t[rows] - first) / BIN).astype(int)
    n = int((t.max() - first) / BIN) + 1
    taken, bins = np.unique(bins, return_inverse=True)  # bins with data; few in a hall
    total = np.concatenate([[0.0], np.cumsum(np.bincount(bins, score))])
    known = np.concatenate([[0.0], np.cumsum(np.bincount(bins, power))])
    i, j = np.triu_indices(len(taken) + 1, 1)
    begin, end = taken[np.minimum(i, len(taken) - 1)], taken[j - 1] + 1
    short = (
        (end - begin >= SHORTEST)
        & (end - begin <= LONGEST * n)
        & (known[j] - known[i] <= WHOLE * known[-1])
    )
    i, j, begin, end = i[short], j[short], begin[short], end[short]
    inside = total[j] - total[i]
    gain = (inside if signed else np.maximum(inside, 0.0)) ** 2 / (known[j] - known[i] + prior)
    if not len(gain):
        return 0.0, {}, 0.0
    best = int(np.argmax(gain))
    limits = {"start": float(first + begin[best] * BIN), "end": float(first + end[best] * BIN)}
    return gain[best], limits, 2.0 * np.log(len(gain))


class IntervalDetector(Detector):
    """Search for an IntervalEffect over all intervals of one flight, one after the other."""

    effect: ClassVar[type[IntervalEffect]]
    searched_first = True

    def search(
        self, table: RegressionTable, model: Fit, chosen: Sequence[Candidate]
    ) -> list[Candidate]:
        (channel,) = self.effect.channels
        if table.flights != 1 or channel not in table.present:  # flights share no time
            return []
        numbers = (int(key.partition(".")[0]) for key in self.keys_chosen(chosen))
        number = 1 + max(numbers, default=0)
        rows, key = table.rows_of(channel), f"{number}.{self.effect.part}"
        part = next(part for _, name, _, part in table.parts if name == channel)
        x = part.columns(self.effect(), (key,))[:, 0]
        information = model.information(table)[rows]
        score, power = x * information * model.residual[rows], x * x * information
        gain, limits, price = best_interval(
            table.t[rows], score, power, self.effect.row.prior_std**-2, signed=True
        )
        if gain <= LEAST_GAIN + price:
            return []
        effect = self.effect(
            {f"{number}.{limit}": value for limit, value in limits.items()}, source="diagnose"
        )
        return [Candidate((Term(effect, (key,)),), price)]


class FloorStepDetector(IntervalDetector):
    """Search for steps of the ground below the tag."""

    effect = FloorStep


class VelocitySlipDetector(IntervalDetector):
    """Search for intervals of lost velocity."""

    effect = VelocitySlip
