# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Scan functions of two covariates: products of two simple shapes, as "late while fast and high".

The values of a covariate are sorted into bins. Two sums of each pair of bins give the gains of all
products: the weights, and the residuals times their weights. The columns of the model are not projected out, because there
are too many functions for this. So a gain is a lower bound. Separate fits score the best functions.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from uwb_tdoa_bias.effects import RADIO, SmoothTerm
from uwb_tdoa_bias.effects.samples import CATEGORIES, has_domain
from uwb_tdoa_bias.effects.smooth_term import OF_PLACE, shape_basis

from ..channels.views import CovariateView
from .table import RegressionTable
from .terms import Candidate, Term

# Flights, fewest for a map. With fewer, the map depends on their paths and does not generalize; two
# similar paths validate each other.
FOR_MAPS = 3
COARSE, FINE = 8, 16  # bins of a covariate in the search, and around its best products
REFINED = 6  # products that are searched again with FINE bins
WIDEST = 0.75  # share of the bins, longest interval
FINER = 9  # values around a knot of a product that are tried at last
SINGLE = "time", "yaw", "range_rate", "range_difference"  # of no product
LEAST_GAIN = 30.0  # smallest gain, twice a log-likelihood
FEWEST = 60  # rows of a subset
SECOND_PENALTY = 12.0  # more than a function of one covariate, twice a log-likelihood


@dataclass(frozen=True)
class Proposal:
    """A function, its gain and its price without its coefficients, twice a log-likelihood.

    key : the rows that it acts on
    """

    gain: float
    price: float
    key: tuple[str, str, str]
    term: SmoothTerm

    @property
    def candidate(self) -> Candidate:
        """Return the Candidate."""
        return Candidate((Term(self.term, self.term.keys_of((self.key[2],))),), self.price)


@dataclass(frozen=True, eq=False)
class _Subset:
    """Rows of a table that functions of one anchor, pair or axis act on.

    key : (channel, form, anchor or pair or axis)
    signs : (m,) of the function in the rows (m,); values : {covariate: (m,)}
    prior : information of the prior of a coefficient, 1 / variance
    """

    key: tuple[str, str, str]
    rows: np.ndarray
    signs: np.ndarray
    values: dict[str, np.ndarray]

    prior: float

    def weighted(self, weights: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the weights of its rows, and weighted residuals times signs, (m,) each.

        weights : (n,) of all rows of the table, 1 / variance
        """
        weight = weights[self.rows]
        return weight * self.signs**2, weight * self.signs * residual[self.rows]

    def best_product(
        self, weighted: tuple[np.ndarray, np.ndarray], pair: Sequence[_Bins]
    ) -> tuple[float, tuple[int, int]]:
        """Return (gain, indices of both shapes) of the product that gains most.

        The model is a level and a column h = f(x) g(y). The bins give the scalar products of all
        columns at once: <1, h> = F' W G, <h, h> = (F^2)' W G^2, <h, r> = F' V G. W and V are the
        weights and the weighted residuals in each pair of bins. F and G are the shapes in the bins,
        squared by element.

        weighted : as of `weighted`
        """
        x, y = pair
        m, n = len(x.shapes), len(y.shapes)
        cell = x.cell * n + y.cell
        power, vector = (np.bincount(cell, part, m * n).reshape(m, n) for part in weighted)
        # A fit has no level of an anchor in rows with an unknown value: those of the last bin.
        known = slice(-1 if self.key[1] == "anchor" else None)
        gains = gain_of_one(
            level=vector[known, known].sum(),
            power=power[known, known].sum(),
            first=x.shapes.T @ vector @ y.shapes,
            crossed=x.shapes.T @ power @ y.shapes,
            square=(x.shapes**2).T @ power @ y.shapes**2,
            prior=self.prior,
        )
        i, j = np.unravel_index(int(np.argmax(gains)), gains.shape)
        return float(gains[i, j]), (int(i), int(j))


class Products:
    """Functions of two covariates, of the views of a table."""

    def __init__(
        self, table: RegressionTable, views: Mapping[str, Sequence[CovariateView]]
    ) -> None:
        """Sort the rows.

        views : {channel: [CovariateView]}, of the rows of each channel
        """
        subsets = [subset for subset in _subsets(table, views) if subset.key[0] in RADIO]
        self._subsets = [(subset, _all_binned(subset)) for subset in subsets]
        # Maps hold functions of several coordinates, and generalize better.
        self._with_maps = table.flights >= FOR_MAPS
        pairs = sum(len(self._pairs(binned)) for _, binned in self._subsets)
        self._price = SmoothTerm.penalty + SECOND_PENALTY + 2.0 * np.log(max(pairs, 1))

    def _pairs(self, names: Iterable[str]) -> list[tuple[str, str]]:
        """Return the pairs of covariates of which products are tried.

        What happens at a place, but only for some time, does not recur in another flight. The
        covariates SINGLE follow the place and its angles in many flights.
        """
        pairs = combinations([name for name in names if name not in SINGLE], 2)
        return [pair for pair in pairs if not (self._with_maps and {*pair} <= {*OF_PLACE})]

    def __call__(self, weights: np.ndarray, residual: np.ndarray) -> list[Proposal]:
        """Return Proposals for a residual (n,), the largest gain minus price first.

        weights : (n,) of each row, 1 / variance
        """
        found = []
        for subset, binned in self._subsets:
            weighted = subset.weighted(weights, residual)
            for pair in self._pairs(binned):
                gain, _ = subset.best_product(weighted, [binned[name] for name in pair])
                if gain > LEAST_GAIN:
                    found.append((gain, subset, pair))
        found.sort(key=lambda item: -item[0])
        out = []
        for _, subset, pair in found[:REFINED]:
            both = [_Bins.of(name, subset.values[name], FINE) for name in pair]
            fine = [bins for bins in both if bins is not None]
            if len(fine) == len(both):
                weighted = subset.weighted(weights, residual)
                gain, indices = subset.best_product(weighted, fine)
                moved = [bins.around(k, subset.values[bins.name]) for bins, k in zip(fine, indices)]
                # These bins leave out the present knots, and are wide elsewhere.
                finer_gain, finer_indices = subset.best_product(weighted, moved)
                tried = len(fine[0].of_shapes) * len(fine[1].of_shapes) * FINER
                if finer_gain > gain:
                    fine, gain, indices = moved, finer_gain, finer_indices
                out.append(self._proposal(subset, fine, gain, indices, tried))
        return sorted(out, key=lambda one: one.price - one.gain)

    def _proposal(
        self,
        subset: _Subset,
        pair: Sequence[_Bins],
        gain: float,
        indices: tuple[int, int],
        tried: int,
    ) -> Proposal:
        """Return the Proposal of a product.

        The price includes twice the logarithm of the number of products that were tried, because
        the best of many gains by chance (multiple testing).

        indices : of the shape in each of both _Bins; tried : number of products that were tried
        """
        (shape, knots), (factor_shape, factor_knots) = (
            bins.of_shapes[k] for bins, k in zip(pair, indices)
        )
        channel, form, _ = subset.key
        term = SmoothTerm(
            channel=channel,
            covariate=pair[0].name,
            form=form,
            knots=knots,
            shape=shape,
            factor=pair[1].name,
            factor_shape=factor_shape,
            factor_knots=factor_knots,
        )
        return Proposal(gain, self._price + 2.0 * np.log(tried), subset.key, term)


@dataclass(frozen=True, eq=False)
class _Bins:
    """A covariate in bins, and the shapes over it.

    edges : (b + 1,) of the bins
    cell : (m,) bin of each row, the number of bins for an unknown value
    shapes : (b + 1, s) each shape without its level in each bin, 0 for unknown values
    of_shapes : [(name of the shape, knots)]
    """

    name: str
    edges: np.ndarray
    cell: np.ndarray
    shapes: np.ndarray
    of_shapes: list[tuple[str, tuple[float, ...]]]

    @classmethod
    def of(cls, name: str, values: np.ndarray, bins: int) -> _Bins | None:
        """Sort values (m,) into bins of equal numbers; None if they hardly vary."""
        known = np.isfinite(values)
        if known.sum() < FEWEST:
            return None
        edges = np.unique(np.quantile(values[known], np.linspace(0.005, 0.995, bins + 1)))
        if len(edges) < 4 or edges[-1] - edges[0] < 1e-3 * max(*np.abs(edges[[0, -1]]), 1e-3):
            return None
        return cls.between(name, values, edges)

    def around(self, index: int, values: np.ndarray) -> _Bins:
        """Return bins of the same values (m,), finer around the inner knots of a shape.

        index : of the shape in `of_shapes`
        """
        inner = np.searchsorted(self.edges, self.of_shapes[index][1][1:-1])
        near = [np.linspace(self.edges[k - 1], self.edges[k + 1], FINER) for k in inner]
        edges = np.unique(np.concatenate([self.edges[[0, -1]], *near])) if near else self.edges
        return _Bins.between(self.name, values, edges)

    @classmethod
    def between(cls, name: str, values: np.ndarray, edges: np.ndarray) -> _Bins:
        """Sort values (m,) into bins between edges (b + 1,)."""
        known, n = np.isfinite(values), len(edges) - 1
        cell = np.clip(np.searchsorted(edges, values, side="right") - 1, 0, n - 1)
        counted = np.bincount(cell[known], minlength=n)
        sums = np.bincount(cell[known], np.clip(values[known], edges[0], edges[-1]), n)
        centres = np.where(counted, sums / np.maximum(counted, 1), 0.5 * (edges[:-1] + edges[1:]))
        of_shapes = list(_shapes(tuple(map(float, edges))))
        shapes = np.zeros((n + 1, len(of_shapes)))
        for shape in dict.fromkeys(one for one, _ in of_shapes):
            places = [k for k, (one, _) in enumerate(of_shapes) if one == shape]
            knots = np.transpose([of_shapes[k][1] for k in places])
            shapes[:n, places] = shape_basis(shape, knots, centres[:, None])[..., 1]
        return cls(name, edges, np.where(known, cell, n), shapes, of_shapes)


def _all_binned(subset: _Subset) -> dict[str, _Bins]:
    """Return {covariate: its _Bins} of the covariates that vary."""
    every = {name: _Bins.of(name, values, COARSE) for name, values in subset.values.items()}
    return {name: bins for name, bins in every.items() if bins is not None}


def _shapes(edges: tuple[float, ...]) -> Iterator[tuple[str, tuple[float, ...]]]:
    """Yield (name, knots) of each shape between edges of bins."""
    low, high, inner = edges[0], edges[-1], edges[1:-1]
    yield "line", (low, high)
    for at in inner:
        yield "step", (low, at, high)
        yield "beyond", (low, at, high)
        yield "below", (low, at, high)
    widest = WIDEST * (len(edges) - 1)
    for i, j in combinations(range(len(edges)), 2):
        if 0 < i and j < len(edges) - 1 and j - i <= widest:
            yield "interval", (low, edges[i], edges[j], high)


def _subsets(
    table: RegressionTable, views: Mapping[str, Sequence[CovariateView]]
) -> Iterator[_Subset]:
    """Yield the rows of each anchor, pair or axis, with all covariates of which rows have one value."""
    if table.sparse:  # too many anchors
        return
    for channel, some in views.items():
        start = table.rows_of(channel).start
        several: dict[tuple[str, str, str], list[CovariateView]] = {}
        for view in some:
            single = view.form != "arrival" and not view.means
            if single and view.covariate not in CATEGORIES and has_domain(view.covariate):
                several.setdefault((view.channel, view.form, view.key), []).append(view)
        for key, of_key in several.items():
            rows = of_key[0].rows
            if len(rows) < FEWEST:
                continue
            signs = np.sum([side for side, _ in of_key[-1].sides], axis=0)
            values = {}
            for view in of_key:
                if len(view.sides) == 1:
                    values[view.covariate] = view.sides[0][1]
                else:
                    of_first = view.sides[0][0] != 0.0
                    values[view.covariate] = np.where(of_first, view.sides[0][1], view.sides[1][1])
            line = SmoothTerm(channel=key[0], covariate="time", knots=(0.0, 1.0), shape="line")
            yield _Subset(key, rows + start, signs, values, line.prior_std_of("c0") ** -2)


def gain_of_one(
    level: np.ndarray,
    power: np.ndarray,
    first: np.ndarray,
    crossed: np.ndarray,
    square: np.ndarray,
    prior: float | np.ndarray,
) -> np.ndarray:
    """Return the gains of a level and one column, twice a log-likelihood.

    level, first : scalar products of the level, and of the column, with the residual
    power, crossed, square : of the level with itself, with the column, and of the column with itself
    """
    power = power + prior
    rest = square + prior - crossed**2 / power
    more = (first - crossed * level / power) ** 2 / np.maximum(rest, 1e-9 * (square + prior))
    return level**2 / power + more
