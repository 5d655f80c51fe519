# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Compute the gain in likelihood of sets of columns in closed form.

Products of all columns with the base of the model are computed once per group. A group is an axis
of a channel. The gain of a candidate then follows from a small system of equations (Schur
complement).
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np

from .algebra import Matrix, product, weighted
from .fit import Fit, prior_sizes, solve
from .table import AXES, RegressionTable
from .terms import Candidate, Column

# Largest set of columns that may be skipped. It is skipped if the gains of its single columns, twice a
# log-likelihood, sum up to NOTHING or less.
FEW, NOTHING = 3, 3.0
# Columns per product with the base: limits memory, since all columns are never copied at once.
AT_ONCE = 128


@dataclass(frozen=True, eq=False)
class Gain:
    """The gain of a candidate added to a base.

    beta : (k,) values of the candidate's columns
    determined : effective number of parameters that the data determine beyond the base
    gain : increase of twice the log-likelihood
    """

    beta: np.ndarray
    determined: float
    gain: float


class Scorer:
    """Compute gains of sets of Columns added to a base.

    Weights, scales and inflation are fixed to one Fit.
    """

    def __init__(
        self, table: RegressionTable, base: Sequence[Column], model: Fit, others: Sequence[Column]
    ) -> None:
        """Compute the products of all columns with the base.

        base : Columns in the model; model : Fit that gives the weights; others : Columns to score
        """
        # The columns of the base come first.
        self._place = {column: k for k, column in enumerate(dict.fromkeys([*base, *others]))}
        self._base = np.arange(len(base))
        columns, weights = list(self._place), model.information(table)
        if table.sparse:
            effects = _effects(columns, len(base))
            self._parts = [
                _sparse_part(table, columns, effects, len(base), weights, rows)
                for _, rows in table.groups
            ]
        else:
            self._parts = [self._part(table, columns, weights, rows) for _, rows in table.groups]
        self._group_sizes = [model.size[group] for group, _ in table.groups]
        self._channels = [table.channels[group // AXES] for group, _ in table.groups]
        self._sizes = prior_sizes(columns)
        sizes = self._sizes[self._base]
        # The fit of the base alone, with which each gain is compared.
        gram = sum((part.cross[:, self._base] for part in self._parts), start=np.zeros(()))
        vector = sum((part.vector[self._base] for part in self._parts), start=np.zeros(()))
        beta, _, self._determined = solve(gram, vector, sizes)
        self._inverse = (
            np.linalg.inv(gram * np.outer(sizes, sizes) + np.eye(len(sizes)))
            if len(sizes)
            else gram
        )
        self._squares = [part.squares(beta, self._base) for part in self._parts]
        self._penalty = float(np.sum((beta / sizes) ** 2))
        self._alone = self._gains_alone(beta) if table.sparse else None

    def _part(
        self,
        table: RegressionTable,
        columns: list[Column],
        weights: np.ndarray,
        rows: np.ndarray | slice,
    ) -> _Part:
        """Return the _Part of some rows of a dense RegressionTable. weights : (n,) of all rows."""
        weights, y = weights[rows], table.y[rows]
        base_columns = [columns[place] for place in self._base.tolist()]
        base = weighted(table.matrix(base_columns, rows), weights)
        cross, vector = np.empty((len(self._base), len(columns))), np.empty(len(columns))
        acting = np.zeros(len(columns), dtype=bool)
        for first in range(0, len(columns), AT_ONCE):
            some = slice(first, first + AT_ONCE)
            x = table.matrix(columns[some], rows)
            cross[:, some], vector[some] = product(base, x), x.T @ (weights * y)
            acting[some] = x.any(axis=0)
        return _Part(table, columns, rows, weights, cross, vector, float(weights @ y**2), acting)

    def _gains_alone(self, beta: np.ndarray) -> np.ndarray:
        """Return the least-squares gain of each column alone, (columns,), twice a log-likelihood.

        beta : (base,) values of the base
        """
        base, sizes = self._base, self._sizes
        cross = sum((part.cross for part in self._parts), start=np.zeros(()))
        left = (sum(part.vector for part in self._parts) - cross.T @ beta) * sizes
        cross = cross * np.outer(sizes[base], sizes)
        own = sum(
            (part.products.squares for part in self._parts if part.products is not None),
            start=np.zeros(()),
        )
        own = own * sizes**2 + 1.0 - np.sum(cross * (self._inverse @ cross), axis=0)
        return left**2 / np.maximum(own, 1e-9)

    def may_gain(self, columns: Sequence[Column]) -> bool:
        """Return whether some Columns can gain enough to be scored.

        Among thousands of anchors most small sets gain nothing; the gains of single columns show
        it.
        """
        if self._alone is None or len(columns) > FEW:
            return True
        return float(sum(self._alone[self._place[column]] for column in columns)) > NOTHING

    def gain(self, columns: Sequence[Column]) -> Gain | None:
        """Return the Gain of adding some Columns; None if the base has all columns."""
        all_places = np.array([self._place[column] for column in columns])
        new = np.unique(all_places[all_places >= len(self._base)])
        if not len(new):
            return None
        base, sizes = self._base, self._sizes
        both = np.concatenate([base, new])
        cross = sum(part.cross[:, new] for part in self._parts) * np.outer(sizes[base], sizes[new])
        own = [part.gram(new) for part in self._parts]
        vector = sum(part.vector[both] for part in self._parts) * sizes[both]
        # Block inverse of the posterior information of base and new columns, in units of the prior.
        half = self._inverse @ cross
        schur = np.linalg.inv(
            sum(own) * np.outer(sizes[new], sizes[new]) + np.eye(len(new)) - cross.T @ half
        )
        z_new = schur @ (vector[len(base) :] - half.T @ vector[: len(base)])
        z = np.concatenate([self._inverse @ (vector[: len(base)] - cross @ z_new), z_new])
        determined = (
            len(both) - np.trace(self._inverse) - np.trace(schur) - np.sum((half @ schur) * half)
        )
        beta, gain = z * sizes[both], self._penalty - float(z @ z)
        # A group with unknown noise variance gains size * log(squares before / squares after).
        for size, part, gram, before in zip(self._group_sizes, self._parts, own, self._squares):
            gain += size * np.log(before / part.squares(beta, both, gram))
        values = dict(zip(both.tolist(), beta.tolist()))
        return Gain(
            np.array([values[place] for place in all_places.tolist()]),
            float(determined - self._determined),
            float(gain),
        )

    def price(self, candidate: Candidate, determined: float, choices: int) -> float:
        """Return the gain that a Candidate must exceed, twice a log-likelihood.

        determined : its effective number of parameters; choices : number of candidates
        """
        rows = sum(
            size
            for size, name in zip(self._group_sizes, self._channels)
            if name in candidate.channels
        )
        return (
            determined * np.log(max(rows, 10.0)) + 2.0 * np.log(max(choices, 2)) + candidate.price
        )


@dataclass(frozen=True, eq=False)
class _Part:
    """Products of columns with the base, for the rows of one group.

    weights : (n,) of the rows, the diagonal of W; power : y' W y
    cross : (base, k) X_base' W X; vector : (k,) X' W y
    acting : (k,) bool, columns that are not zero in these rows; None for sparse columns
    products : products between columns of one effect, for sparse columns only
    """

    table: RegressionTable
    columns: list[Column]
    rows: np.ndarray | slice
    weights: np.ndarray
    cross: np.ndarray
    vector: np.ndarray
    power: float
    acting: np.ndarray | None = None
    products: _Products | None = None

    def gram(self, places: np.ndarray) -> np.ndarray:
        """Return X' W X of the columns at some places."""
        if self.products is not None:
            return self.products.gram(places)
        if self.acting is not None and not self.acting[places].any():
            return np.zeros((len(places), len(places)))
        x = self.table.matrix([self.columns[place] for place in places], self.rows)
        return x.T @ (x * self.weights[:, None])

    def squares(self, beta: np.ndarray, places: np.ndarray, own: np.ndarray | None = None) -> float:
        """Return the weighted sum of squared residuals for beta.

        beta : (k,) values of the columns at `places`, the columns of the base first
        own : gram of the columns after the base
        """
        base = self.cross.shape[0]
        first, last = beta[:base], beta[base:]
        out = (
            self.power
            - 2.0 * beta @ self.vector[places]
            + first @ self.cross[:, places[:base]] @ first
        )
        if own is not None:
            out += 2.0 * first @ self.cross[:, places[base:]] @ last + last @ own @ last
        return max(float(out), 1e-12)


def _effects(columns: Sequence[Column], base: int) -> list[np.ndarray]:
    """Return the places of the columns of each effect, without the base."""
    places: dict[Hashable, list[int]] = {}
    for place, column in enumerate(columns[base:], start=base):
        places.setdefault(column.effect, []).append(place)
    return list(map(np.array, places.values()))


@dataclass(frozen=True, eq=False)
class _Products:
    """X' W X of sparse columns, computed once for many candidates.

    x : (n, k); weights : (n,); squares : (k,) diagonal
    effect, number : (k,) index of the effect of a column, and of the column within that effect
    grams : {effect: gram of its columns}, for effects with several columns
    """

    x: Matrix
    weights: np.ndarray
    squares: np.ndarray
    effect: np.ndarray
    number: np.ndarray
    grams: dict[int, np.ndarray]

    @classmethod
    def of(cls, x: Matrix, weights: np.ndarray, effects: Sequence[np.ndarray]) -> _Products:
        effect, number = np.full((2, x.shape[1]), -1)
        for k, places in enumerate(effects):
            effect[places], number[places] = k, np.arange(len(places))
        squares = x.power(2).T @ weights
        grams = {
            k: _gram(x[:, places], weights) for k, places in enumerate(effects) if len(places) > 1
        }
        return cls(x, weights, squares, effect, number, grams)

    def gram(self, places: np.ndarray) -> np.ndarray:
        """Return X' W X of the columns at some places."""
        first = int(self.effect[places[0]])
        if len(places) == 1:
            return self.squares[places][:, None]
        if first >= 0 and (self.effect[places] == first).all():
            numbers = self.number[places]
            return self.grams[first][np.ix_(numbers, numbers)]
        return _gram(self.x[:, places], self.weights)


def _gram(x: Matrix, weights: np.ndarray) -> np.ndarray:
    """Return X' W X of a sparse matrix (n, k), (k, k)."""
    # Most columns are 0 here: they belong to TDOAs or to an axis of another sensor.
    filled = np.flatnonzero(np.diff(x.indptr))
    out = np.zeros((x.shape[1], x.shape[1]))
    if len(filled):
        some = x[:, filled]
        out[np.ix_(filled, filled)] = product(some, weighted(some, weights))
    return out


def _sparse_part(
    table: RegressionTable,
    columns: list[Column],
    effects: Sequence[np.ndarray],
    base: int,
    weights: np.ndarray,
    rows: np.ndarray | slice,
) -> _Part:
    """Return the _Part of some rows of a sparse RegressionTable.

    Products between two effects are computed on demand.

    effects : places of the columns of each effect; base : number of leading columns in the base
    weights : (n,) of all rows
    """
    weights, y, x = weights[rows], table.y[rows], table.matrix(columns, rows)
    # This order multiplies x as stored in memory.
    cross = product(x, weighted(x[:, :base], weights)).T
    return _Part(
        table,
        columns,
        rows,
        weights,
        cross,
        x.T @ (weights * y),
        float(weights @ y**2),
        products=_Products.of(x, weights, effects),
    )
