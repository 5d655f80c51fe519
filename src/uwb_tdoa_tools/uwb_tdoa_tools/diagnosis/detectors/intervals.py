"""Searches for intervals of a flight."""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ..regression.terms import Candidate, Term
from .base import Detector

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.effects.interval_error import IntervalEffect

    from ..regression.fit import Fit
    from ..regression.table import RegressionTable

BIN = 1.0  # s
SHORTEST = 2  # bins
LONGEST = 0.7  # share of a flight; what lasts longer is constant
WHOLE = 0.95  # share of all that is known of an anchor, beyond which it is constant too
LEAST_GAIN = 10.0  # twice a log-likelihood


def best_interval(
    t: np.ndarray,
    score: np.ndarray,
    power: np.ndarray,
    prior: float,
    signed: bool = False,
    rows: slice | np.ndarray = slice(None),
) -> tuple[float, dict[str, float], float]:
    """Best (gain, {limit: value}, price of the search) over intervals of t (n,), s.

    score, power (m,): products with the residual and with itself of a regressor, both weighted, at
    `rows` of t, the others zero; prior : information of what sizes are plausible; signed : whether
    sizes below 0 are.
    """
    first = t.min()
    bins = ((t[rows] - first) / BIN).astype(int)
    n = int((t.max() - first) / BIN) + 1
    taken, bins = np.unique(
        bins, return_inverse=True
    )  # of an anchor of a hall, those in which it is heard
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
    """Tries all intervals of one flight for an IntervalEffect."""

    effect: ClassVar[type[IntervalEffect]]
    disguises = True

    def search(
        self, table: RegressionTable, model: Fit, chosen: Sequence[Candidate]
    ) -> list[Candidate]:
        (channel,) = self.effect.channels
        if (
            table.flights != 1 or channel not in table.present
        ):  # only a flight alone has a time of its own
            return []
        mine = [
            key
            for candidate in chosen
            if candidate.name == self.effect.name
            for key in candidate.terms[0].keys
        ]
        number = 1 + max((int(key.partition(".")[0]) for key in mine), default=0)
        rows, key = table.rows_of(channel), f"{number}.{self.effect.part}"
        part = next(part for _, name, _, part in table.parts if name == channel)
        x = part.columns(self.effect(), (key,))[:, 0]
        information = model.information(table)[rows]
        score, power = x * information * model.residual[rows], x * x * information
        gain, limits, price = best_interval(
            table.t[rows], score, power, self.effect.typical**-2, signed=True
        )
        if gain <= LEAST_GAIN + price:
            return []
        effect = self.effect(
            {f"{number}.{limit}": value for limit, value in limits.items()}, source="diagnose"
        )
        return [Candidate((Term(effect, (key,)),), price)]
