# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Score terms on hold-out data."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .algebra import counts, product, weighted
from .fit import NU, Fit, prior_sizes, solve
from .select import Selection
from .table import RegressionTable
from .terms import Column, columns_of

FOLDS = 4  # folds of the cross-validation over blocks of time
CLIP = 5.0  # spreads, limit of a residual


@dataclass(frozen=True, order=True)
class HeldOut:
    """The hold-out score of a Candidate.

    gain : increase of twice the log-likelihood of hold-out rows, in independent rows
    t : t value of the gain over blocks of time
    explained : explained share of the variance, of the axis or channel that gains most
    """

    gain: float
    t: float
    explained: float


def held_out(selection: Selection, by_flight: bool = False) -> list[HeldOut]:
    """Return the hold-out score of each chosen Candidate by cross-validation.

    Each fold is predicted by fits to the other folds, with and without the candidate. Weights and
    scales are fixed to the fit of all rows.

    by_flight : True makes each flight a fold; False deals blocks of time in turn to FOLDS folds
    """
    table, model, chosen = selection.table, selection.fit, selection.chosen
    folds = _Folds(
        table, model, columns_of(chosen), table.flight if by_flight else table.block % FOLDS
    )
    whole = folds.residual(columns_of(chosen))
    out = []
    for k, candidate in enumerate(chosen):
        rest = folds.residual(columns_of(chosen[:k] + chosen[k + 1 :]))
        touched = counts(table.matrix(candidate.columns), 1) > 0
        gain = (_loss(table, model, rest) - _loss(table, model, whole)) / model.inflation[
            table.group
        ]
        blocks, of_blocks = (
            np.unique(table.block[touched]),
            np.bincount(table.block[touched], gain[touched]),
        )
        sums = of_blocks[blocks] if touched.any() else np.zeros(1)
        t = sums.sum() / max(np.sqrt(len(sums)) * sums.std(), 1e-9)
        out.append(
            HeldOut(float(sums.sum()), float(t), _explained(table, model, rest, whole, touched))
        )
    return out


class _Folds:
    """Normal equations of all columns, fold by fold."""

    def __init__(
        self, table: RegressionTable, model: Fit, columns: Sequence[Column], folds: np.ndarray
    ) -> None:
        self.table, self.folds = table, folds
        self._place = {column: k for k, column in enumerate(columns)}
        self._x, self._sizes = table.matrix(columns), prior_sizes(columns)
        x = weighted(self._x, model.information(table))
        self._parts = {}
        for fold in np.unique(folds):
            rows = folds == fold
            self._parts[fold] = product(x[rows], self._x[rows]), x[rows].T @ table.y[rows]
        self._gram, self._vector = (sum(part[k] for part in self._parts.values()) for k in range(2))

    def residual(self, columns: Sequence[Column]) -> np.ndarray:
        """Return the residual of each row under the fit of the other folds, (n,)."""
        out = self.table.y.copy()
        if not columns:
            return out
        at = np.array([self._place[column] for column in columns])
        for fold, (gram, vector) in self._parts.items():
            beta, _, _ = solve(
                (self._gram - gram)[np.ix_(at, at)], (self._vector - vector)[at], self._sizes[at]
            )
            rows = self.folds == fold
            out[rows] -= self._x[rows][:, at] @ beta
        return out


def _loss(table: RegressionTable, model: Fit, residual: np.ndarray) -> np.ndarray:
    """Return minus twice the log-likelihood of Student's t of each row, (n,).

    residual : (n,)
    """
    return (NU + 1.0) * np.log1p((residual / model.scale[table.group]) ** 2 / NU)


def _explained(
    table: RegressionTable, model: Fit, before: np.ndarray, after: np.ndarray, touched: np.ndarray
) -> float:
    """Return the explained share of the variance of the group that gains most.

    Residuals are clipped at CLIP spreads.

    before, after : (n,) residuals; touched : (n,) bool, rows on which the candidate acts
    """
    best = 0.0
    for k in np.unique(table.group[touched]):
        mine = (table.group == k) & touched
        limit = CLIP * max(np.median(np.abs(before[mine])) * 1.4826, model.scale[k])
        power = [np.mean(np.clip(r[mine], -limit, limit) ** 2) for r in (before, after)]
        best = max(best, 1.0 - power[1] / max(power[0], 1e-300))
    return float(best)
