# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Scan thousands of undeclared functions of one anchor, pair, direction or axis over one covariate.

Each function is a level and one simple shape: a line, a rise beyond or below a point, a step, an
interval, a parabola or a wave. The gain of each is a score test on the residual of a fit. A few
columns are multiplied with the residual and with each other. These products give the gains of all
shapes in closed form. The columns of the model are projected out of these products (Schur
complement). The best functions become candidates. Their price includes the number of functions that
were tried.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.sparse import csr_array

from uwb_tdoa_bias.effects import SmoothTerm
from uwb_tdoa_bias.effects.samples import CATEGORIES
from uwb_tdoa_bias.effects.smooth_term import SHAPES

from ..channels.views import CovariateView
from .algebra import dense
from .fit import Fit, prior_sizes, refit
from .products import Products, Proposal, gain_of_one
from .table import RegressionTable
from .terms import Candidate, Term, columns_of

_Held = tuple[np.ndarray, np.ndarray, np.ndarray]  # return value of `_held`
_Item = tuple[float, "_Shapes", str, tuple[float, ...], int]

BINS = 16  # number of bins; steps, intervals and rises begin and end at their edges
# numbers of waves over the range of the covariate
PERIODS = (0.8, 1.0, 1.25, 1.5, 1.75, 2.0, 2.25, 2.5, 3.0)
WIDEST = 10  # bins, longest interval; a longer interval equals two steps
# Smallest bin, share of the range. Narrower bins would follow noise of the covariate, and the
# residual may share that noise.
CROWDED = 0.02
NOISY = 1.5  # noise of a series that keeps full weight, relative to its group's median
DIFFERENCES = 3  # order of the differences that measure the noise of a series
FINER = 9  # places around a knot that are tried in the refinement
FEWEST = 12  # smallest number of values of a subset
# With more values than the first, the covariate is divided into levels, above MANY anchors.
MANY_VALUES, LEVELS = (4096, 256)
PROPOSED = 16  # functions that a call returns at most
SHAPES_FIRST = 3  # shapes of one CovariateView that come first
# Functions of two covariates, or that recur, that a call returns at most, and the number of simpler
# ones before them. Their gain is at least MORE times that of a simpler function of the same rows.
PRODUCTS, FIRST_SINGLE, MORE = 3, 4, 1.05
# Scales, limit of Huber's loss: outliers count more than in Student's t.
HUBER = 3.0
LEAST_GAIN = 20.0  # smallest gain, twice a log-likelihood
_ENDS = np.array(
    [(first, last) for first in range(3) for last in (-1, -2, -3)]
)  # edges between which a line rises
ANGLES = ("bearing", "bearing_in_tag", "bearing_in_anchor")


class _Shapes:
    """A CovariateView as columns x of a RegressionTable.

    x : (k, columns) at `rows` of the table; edges : (bins + 1,) in the unit of the covariate
    levels : (k, levels) sparse, or None. If there are many values, x is (levels, columns): one row
        per level of the covariate. The columns are levels @ x.
    """

    def __init__(self, view: CovariateView, offset: int, edges: np.ndarray, many: bool) -> None:
        """Compute the columns.

        offset : first row of the channel; many : whether nearly equal values share a level, for
            tables with many rows
        """
        self.view, self.offset, self.edges, self.many, rows = view, offset, edges, many, view.rows
        self.levels: csr_array | None = None
        if many and len(rows) > MANY_VALUES:
            values, self.levels, rows = _levels(view, edges)
            self.x, self.rows = _columns(values, edges, view.covariate), rows + offset
            return
        x: np.ndarray = np.zeros(())
        for signs, values in view.sides:
            known = np.where(np.isfinite(values), signs, 0.0)
            x = x + known[:, None] * _columns(np.nan_to_num(values), edges, view.covariate)
        if view.means:
            rows, cell = np.unique(rows, return_inverse=True)
            x = (
                np.stack([np.bincount(cell, column) for column in x.T], axis=1)
                / np.bincount(cell)[:, None]
            )
        # float32, because these arrays take most of the memory of a diagnosis
        self.x = x.astype(np.float32)
        self.rows = rows + offset


class Scan:
    """Search all shapes of all views of a RegressionTable's channels; the `search` of `select`."""

    def __init__(
        self, table: RegressionTable, views: Mapping[str, Sequence[CovariateView]]
    ) -> None:
        """Compute the columns of all views.

        views : {channel: [CovariateView]}, of the rows of each channel
        """
        groups: dict[tuple[int, bool, bool], list[_Shapes]] = {}
        for channel, some in views.items():
            for view, edges in ((view, _edges(view)) for view in some):
                if edges is not None:
                    kind = len(edges), view.covariate in ANGLES, view.covariate in CATEGORIES
                    groups.setdefault(kind, []).append(
                        _Shapes(view, table.rows_of(channel).start, edges, table.sparse)
                    )
        self._groups = [_Group(several, WIDEST) for several in groups.values()]
        self._products = Products(table, views)
        # Weights (n,) by the noise of each series, without robust weights.
        self.even = _noise_of_series(table) ** -2.0
        self._price = SmoothTerm.penalty + 2.0 * np.log(
            max(sum(len(several) for several in groups.values()), 1)
        )

    def __call__(
        self, table: RegressionTable, model: Fit, chosen: Sequence[Candidate]
    ) -> list[Candidate]:
        """Return the best Candidates for the residual of a Fit of the chosen Candidates.

        Rows that the fit treats as outliers get a larger weight (Huber): an effect can act on few
        rows only. Noisy series get a smaller weight.
        """
        scale = HUBER * model.scale[table.group] / np.sqrt(self.even)
        weight = np.minimum(1.0, scale / np.maximum(np.abs(model.residual), 1e-12)) * self.even
        everywhere = np.ones(len(table.y), dtype=bool)
        model = refit(table, columns_of(chosen), replace(model, weight=weight), everywhere)
        held = _held(table, model, chosen)
        found = self.gains(table, held)[:PROPOSED]
        found = _best_first(table, [self._refined(held, item) for item in found])
        single = [self._candidate(*item[1:]) for item in _various(found)]
        more = self._worth_more(table, found, self._products(held[1], model.residual))
        return single[:FIRST_SINGLE] + more + single[FIRST_SINGLE:]

    def _worth_more(
        self, table: RegressionTable, found: Sequence[_Item], proposals: Sequence[Proposal]
    ) -> list[Candidate]:
        """Return the first Proposals that gain clearly more than simple functions of their rows.

        found : items of `gains`
        """
        simple: dict[tuple[str, str, str], float] = {}
        for gain, shapes, *_ in found:
            view = shapes.view
            key = view.channel, view.form, view.key
            simple[key] = max(simple.get(key, 0.0), gain)
        out, count = [], np.log(len(table.y))
        for one in proposals:
            cost = one.price + SHAPES[one.term.shape][1] * count
            if one.gain > max(cost, MORE * simple.get(one.key, 0.0)):
                out.append(one.candidate)
        return out[:PRODUCTS]

    def _refined(self, held: _Held, item: _Item) -> _Item:
        """Return an item of `gains` with inner knots moved within their bins.

        It stays unchanged if no move gains.
        """
        gain, shapes, shape, knots, tried = item
        if len(knots) < 3 or shapes.view.covariate in CATEGORIES:
            return item
        coarse = shapes.edges
        near = [coarse[max(k - 1, 0) : k + 2] for k in np.searchsorted(coarse, knots[1:-1])]
        edges = np.unique(
            np.concatenate(
                [coarse[[0, -1]], *(np.linspace(some[0], some[-1], FINER) for some in near)]
            )
        )
        group = _Group([_Shapes(shapes.view, shapes.offset, edges, shapes.many)], len(edges))
        moved = [each for each in group.best(*held) if each[2] == shape]
        best = max(moved, key=lambda each: each[0], default=item)
        return (*best[:4], tried * FINER) if best[0] > gain else item

    def gains(self, table: RegressionTable, held: _Held) -> list[_Item]:
        """Return [(gain, _Shapes, shape, knots, number tried)], the best first.

        The gain is twice a log-likelihood, at the weights of the Fit. The order counts the price of
        the coefficients and of the search.

        held : as of `_held`
        """
        return _best_first(table, [item for group in self._groups for item in group.best(*held)])

    def _candidate(
        self, shapes: _Shapes, shape: str, knots: tuple[float, ...], tried: int
    ) -> Candidate:
        view = shapes.view
        effect = SmoothTerm(
            channel=view.channel, covariate=view.covariate, form=view.form, knots=knots, shape=shape
        )
        keys = effect.keys_of((view.key,))
        return Candidate((Term(effect, keys),), self._price + 2.0 * np.log(tried))


def _noise_of_series(table: RegressionTable) -> np.ndarray:
    """Return the noise of the series of each row, (n,), at least 1.

    It is relative to NOISY times the median of its group. Third differences of successive rows
    measure it, because steps, trends and waves contribute little to them.
    """
    order = np.lexsort((table.t, table.series, table.flight, table.channel))
    label = np.unique(
        np.stack([table.channel, table.flight, table.series]), axis=1, return_inverse=True
    )[1].reshape(-1)
    y, begins = table.y[order], np.searchsorted(label[order], np.arange(label.max() + 1))
    several = np.split(y, begins[1:])
    scatter = np.array(
        [
            np.median(np.abs(np.diff(part, n=DIFFERENCES))) if len(part) > DIFFERENCES else 0.0
            for part in several
        ]
    )
    out = scatter[label]
    for _, rows in table.groups:
        out[rows] /= max(float(NOISY * np.median(out[rows])), 1e-12)
    return np.maximum(out, 1.0)


def _various(found: Iterable[_Item]) -> list[_Item]:
    """Return items of `gains` in their order, but at most SHAPES_FIRST of one CovariateView first.

    Many shapes of one function carry little extra information.
    """
    early: list[_Item] = []
    late: list[_Item] = []
    count: dict[int, int] = {}
    for item in found:
        count[id(item[1].view)] = count.get(id(item[1].view), 0) + 1
        (early if count[id(item[1].view)] <= SHAPES_FIRST else late).append(item)
    return early + late


def _best_first(table: RegressionTable, found: Iterable[_Item]) -> list[_Item]:
    costs = {shape: count * np.log(len(table.y)) for shape, (_, count) in SHAPES.items()}
    return sorted(found, key=lambda item: costs[item[2]] + 2.0 * np.log(item[4]) - item[0])


class _Group:
    """Shapes with equally many columns, scored together."""

    def __init__(self, several: list[_Shapes], widest: int) -> None:
        """Take [_Shapes].

        widest : largest number of bins of an interval
        """
        view, edges = several[0].view, several[0].edges
        self._several, n = several, len(edges) - 1
        self._bins, self._waves, self._bends = n, len(_periods(edges, view.covariate)), n - 3
        self._prior = np.array([_prior(shapes.view) for shapes in several])
        i, j = np.triu_indices(n + 1, 1)
        good = (i > 0) & ((j == n) | (j - i <= widest))
        self._from, self._to = i[good], j[good]

    def best(self, held: np.ndarray, information: np.ndarray, residual: np.ndarray) -> list[_Item]:
        """Return the best item of each shape of each view.

        An item is (gain, _Shapes, shape, knots, number tried).

        held : (n, k) orthonormal base of the model's columns, weighted by `information`
        information : (n,) of each row; residual : (n,)
        """
        products = [_products(shapes, held, information, residual) for shapes in self._several]
        vector, own = (np.stack([product[k] for product in products]) for k in range(2))
        n, bends, waves, prior = self._bins, self._bends, self._waves, self._prior[:, None]
        level, cross = vector[:, :n].sum(axis=1)[:, None], own[:, :, :n].sum(axis=2)
        power = cross[:, :n].sum(axis=1)[:, None]
        of_one = partial(gain_of_one, level, power, prior=prior)

        # Gain of a level and two columns, as of a wave or a parabola: a 3 x 3 system.
        def of_two(first: np.ndarray, second: np.ndarray) -> np.ndarray:
            small = np.empty((len(vector), len(first), 3, 3))
            some = np.empty((len(vector), len(first), 3))
            places = first, second
            small[..., 0, 0], some[..., 0] = power + prior, level
            for k, place in enumerate(places, start=1):
                small[..., 0, k] = small[..., k, 0] = cross[:, place]
                some[..., k] = vector[:, place]
                for other, there in enumerate(places, start=1):
                    small[..., k, other] = own[:, place, there] + (prior if k == other else 0.0)
            return np.einsum("svk,svk->sv", some, np.linalg.solve(small, some[..., None])[..., 0])

        single = of_one(vector[:, n:], cross[:, n:], np.diagonal(own, axis1=1, axis2=2)[:, n:])
        at = n + len(_ENDS) + 2 * bends + np.arange(waves)
        lines = n + np.arange(len(_ENDS))
        # Cumulative sums over bins give the products of every step and interval.
        square = np.zeros((len(vector), n + 1, n + 1))
        square[:, 1:, 1:] = own[:, :n, :n].cumsum(axis=1).cumsum(axis=2)
        i, j = self._from, self._to
        inside = square[:, j, j] - 2.0 * square[:, i, j] + square[:, i, i]
        total, crossed = (
            np.pad(np.cumsum(part[:, :n], axis=1), ((0, 0), (1, 0))) for part in (vector, cross)
        )
        spans = of_one(total[:, j] - total[:, i], crossed[:, j] - crossed[:, i], inside)
        last, beyond, below = (
            j == n,
            *np.split(single[:, len(_ENDS) : len(_ENDS) + 2 * bends], 2, axis=1),
        )
        if self._several[0].view.covariate in CATEGORIES:
            spans = np.where(j == i + 1, spans, 0.0)
            return [
                *self._pick(
                    "interval",
                    spans[:, ~last],
                    lambda edges, k: (edges[0], edges[i[~last][k]], edges[j[~last][k]], edges[-1]),
                )
            ]
        return [
            *self._pick("line", single[:, : len(_ENDS)], lambda edges, k: edges[_ENDS[k]]),
            *self._pick("beyond", beyond, lambda edges, k: (edges[0], edges[2 + k], edges[-1])),
            *self._pick("below", below, lambda edges, k: (edges[0], edges[2 + k], edges[-1])),
            *self._pick(
                "step", spans[:, last], lambda edges, k: (edges[0], edges[i[last][k]], edges[-1])
            ),
            *self._pick(
                "interval",
                spans[:, ~last],
                lambda edges, k: (edges[0], edges[i[~last][k]], edges[j[~last][k]], edges[-1]),
            ),
            *self._pick(
                "parabola",
                of_two(lines, at[-1] + waves + 1 + np.arange(len(_ENDS))),
                lambda edges, k: edges[_ENDS[k]],
            ),
            *self._pick("wave", of_two(at, at + waves), None),
        ]

    def _pick(
        self,
        shape: str,
        gains: np.ndarray,
        knots: Callable[[np.ndarray, int], Iterable[float]] | None,
    ) -> Iterator[_Item]:
        """Return the best item of each view.

        gains : (views, tried)
        """
        if not gains.shape[1]:
            return
        best = np.argmax(gains, axis=1)
        for row in np.flatnonzero(gains[np.arange(len(gains)), best] > LEAST_GAIN):
            shapes, edges, k = self._several[row], self._several[row].edges, best[row]
            at = (
                knots(edges, k)
                if knots
                else (edges[0], edges[0] + _periods(edges, shapes.view.covariate)[k])
            )
            yield float(gains[row, k]), shapes, shape, tuple(map(float, at)), gains.shape[1]


def line_over(view: CovariateView) -> SmoothTerm:
    """Return the line over 0 to 1 in the covariate of a view."""
    return SmoothTerm(
        channel=view.channel,
        covariate=view.covariate,
        form=view.form,
        knots=(0.0, 1.0),
        shape="line",
    )


def _prior(view: CovariateView) -> float:
    """Return the information of the prior of the functions of a view."""
    return line_over(view).prior_std_of("c0") ** -2


def _products(
    shapes: _Shapes, held: np.ndarray, information: np.ndarray, residual: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return products of the columns with the residual, and with each other.

    The first are (columns,). The second are (columns, columns), with the base of the model
    projected out.

    held : (n, k); information, residual : (n,)
    """
    if shapes.levels is not None:
        of_levels = shapes.levels.multiply(information[shapes.rows, None]).T.tocsr()
        half = (of_levels @ held[shapes.rows]).T @ shapes.x
        return shapes.x.T @ (of_levels @ residual[shapes.rows]), shapes.x.T @ (
            of_levels @ shapes.levels @ shapes.x
        ) - half.T @ half
    weighted = shapes.x * information[shapes.rows, None]
    half = held[shapes.rows].T @ weighted
    return weighted.T @ residual[shapes.rows], weighted.T @ shapes.x - half.T @ half


def _held(table: RegressionTable, model: Fit, chosen: Sequence[Candidate]) -> _Held:
    """Return (base, information (n,), residual (n,)) of a Fit of the chosen Candidates.

    The base (n, k) spans the columns of the model. It is orthonormal under the information and the
    prior.
    """
    information, base = model.information(table), columns_of(chosen)
    b = dense(table.matrix(base))
    gram = (b * information[:, None]).T @ b + np.diag(1.0 / prior_sizes(base) ** 2)
    return b @ np.linalg.cholesky(np.linalg.inv(gram)) if base else b, information, model.residual


def _edges(view: CovariateView) -> np.ndarray | None:
    """Return the edges of the bins, quantiles of the covariate; None if it hardly varies."""
    counted = np.concatenate([values[signs != 0.0] for signs, values in view.sides])
    counted = counted[np.isfinite(counted)]
    if len(counted) < FEWEST:
        return None
    if view.covariate in CATEGORIES:
        names = np.unique(counted)
        return np.concatenate([[names[0] - 1.5, names[0] - 0.5], names + 0.5, [names[-1] + 1.5]])
    edges = np.quantile(counted, np.linspace(0.005, 0.995, BINS + 1))
    if edges[-1] - edges[0] < 1e-3 * max(abs(edges[0]), abs(edges[-1]), 1e-3):
        return None
    width = (edges - edges[0]) // (CROWDED * (edges[-1] - edges[0]))
    edges = edges[np.unique(width, return_index=True)[1]]
    return edges if len(edges) > 2 * len(set(_ENDS[:, 0])) else None


def _levels(view: CovariateView, edges: np.ndarray) -> tuple[np.ndarray, csr_array, np.ndarray]:
    """Return the levels of a covariate with many values.

    Each level lies between two edges.

    returns : values (l,), one per level; sums of signs of each row and level (k, l), sparse; rows
        (k,) of the view
    """
    signs, values = (np.concatenate(each) for each in zip(*view.sides))
    known = np.isfinite(values) & (signs != 0.0)
    rows, place = np.unique(view.rows, return_inverse=True)
    signs, values, cell = signs[known], values[known], np.tile(place, len(view.sides))[known]
    finer = np.union1d(edges, np.quantile(values, np.linspace(0.0, 1.0, LEVELS + 1)))
    _, first, level = np.unique(
        np.searchsorted(finer, values, side="right"), return_index=True, return_inverse=True
    )
    return (
        values[first],
        csr_array((signs / np.bincount(place)[cell], (cell, level)), shape=(len(rows), len(first))),
        rows,
    )


def _columns(v: np.ndarray, edges: np.ndarray, covariate: str) -> np.ndarray:
    """Return columns of all shapes at values v (n,), (n, columns).

    They are bins, lines, rises beyond and below the inner edges, sines, cosines, and squared lines.
    """
    low, high = edges[0], edges[-1]
    held = np.clip(v, low, high)
    bins = np.eye(len(edges) - 1)[
        np.clip(np.searchsorted(edges, v, side="right") - 1, 0, len(edges) - 2)
    ]
    bends = edges[2:-2]
    first, last = edges[_ENDS[:, 0]], edges[_ENDS[:, 1]]
    rise = np.where(last > first, last - first, np.inf)
    lines = (np.clip(v[:, None], first, np.maximum(first, last)) - first) / rise - 0.5
    beyond = np.maximum(held[:, None] - bends, 0.0) / (high - bends)
    below = np.maximum(bends - held[:, None], 0.0) / (bends - low)
    phase = 2.0 * np.pi * (v[:, None] - low) / _periods(edges, covariate)
    return np.hstack([bins, lines, beyond, below, np.sin(phase), np.cos(phase), lines**2])


def _periods(edges: np.ndarray, covariate: str) -> np.ndarray:
    if covariate in ANGLES:
        return 2.0 * np.pi / np.arange(1, 4)
    return (edges[-1] - edges[0]) / np.array(PERIODS)
