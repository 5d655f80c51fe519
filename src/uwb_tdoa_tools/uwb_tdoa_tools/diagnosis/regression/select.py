# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Select effects that explain the residuals, by forward and backward steps.

The statistic of a candidate is its gain in twice the log-likelihood over all channels, counted in
independent rows. Each parameter costs log(rows), as in the Bayesian information criterion. A choice
among C candidates costs 2 log C (extended BIC: Chen and Chen, Biometrika 2008). This price bounds
the false-alarm rate of the whole catalogue.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Protocol

import numpy as np

from uwb_tdoa_bias.effects import Effect

from ..channels import CHANNELS
from .fit import Fit, fit, mean_of, refit
from .scan import Scan
from .scorer import Scorer
from .table import RegressionTable
from .terms import Candidate, Column, Term, columns_of

MAX_STEPS = 14  # largest number of forward steps
FITTED = 9  # proposals of a scan that separate fits score
# Columns of a small and of a large candidate; share of the criterion that the small one must reach.
FEW, LARGE, GOOD_PART = (3, 6, 0.5)
LEAST_DETERMINED = 0.3  # smallest effective number of parameters of a candidate
AMBIGUOUS = 10.0  # smallest gap of the criterion that decides between two candidates
# largest relative gap of the criterion of a rival function
ALIKE = 0.1
# the same of rivals that explain as much, and of those that are equal (docs/notebook/diagnosis.md)
SAME, IDENTICAL = 0.02, 1e-9


class Search(Protocol):
    """A function that finds more Candidates in the residual of a Fit to a RegressionTable."""

    def __call__(
        self, table: RegressionTable, model: Fit, chosen: Sequence[Candidate], /
    ) -> list[Candidate]:
        """Return Candidates for the residual of a Fit of the chosen ones."""
        ...


@dataclass(frozen=True)
class Rival:
    """A Candidate that can replace a chosen one.

    gap : by how much its criterion is worse, twice a log-likelihood
    lacks : the same, as a share of the criterion of the chosen one
    """

    gap: float
    candidate: Candidate
    lacks: float

    def is_alike(self, other: Candidate) -> bool:
        """Return whether it explains as much as another function of the same anchor or pair.

        It must be a function that nodes can correct. Without any gap it is the same function by
        another name.
        """
        near = IDENTICAL < abs(self.lacks) <= SAME
        usable = all(term.effect.usable for term in self.candidate.terms)
        return near and usable and not other.declared and self.candidate.subject == other.subject


@dataclass(frozen=True, eq=False)
class Selection:
    """The chosen Candidates and their Fit.

    table : RegressionTable with the columns of all candidates; fit : Fit of the chosen ones
    loss : decrease of the criterion without each chosen Candidate
    rivals : (Rival, ...) of each chosen Candidate, filled by `with_rivals`
    own : Candidates of these flights alone, in the Fit too; others would stand in for them
    """

    table: RegressionTable
    chosen: tuple[Candidate, ...]
    fit: Fit
    loss: tuple[float, ...]
    rivals: tuple[tuple[Rival, ...], ...]
    own: tuple[Candidate, ...] = ()

    def columns(self, candidates: Iterable[Candidate]) -> list[Column]:
        """Return the Columns of a fit of Candidates: theirs, and those of `own`."""
        return columns_of([*candidates, *self.own])

    def apart(self, candidates: Collection[Candidate]) -> Selection:
        """Return the Selection with some of the chosen Candidates among `own`."""
        rest = [one for one in self.chosen if one not in candidates]
        return replace(self, **self._chosen_of(rest), own=(*self.own, *candidates))

    def only(self, candidates: Collection[Candidate]) -> Selection:
        """Return the Selection of some of the chosen Candidates, with a new robust fit."""
        chosen = self._chosen_of(candidates)
        columns = self.columns(chosen["chosen"])
        return replace(self, **chosen, fit=fit(self.table, columns, self.fit.inflation))

    def kept(
        self,
        candidates: Collection[Candidate],
        share: float | None = None,
        rows: np.ndarray | None = None,
    ) -> Selection:
        """Return the Selection of some of the chosen Candidates, with the present weights.

        With these weights, contributions of the dropped candidates do not count as outliers. The
        flights do not tell a function from its rivals in `alike`, but other flights may. So the Fit
        is the mean of fits with each of them.

        share, rows : as of `refit`
        """
        part = replace(self, **self._chosen_of(candidates))
        columns = self.columns(part.chosen)
        fits, weights = [refit(self.table, columns, self.fit, rows, share)], [1.0]
        for one, alike in zip(part.chosen, part.alike):
            rest = [column for column in columns if column not in one.columns]
            for other in alike:
                fits.append(refit(self.table, [*rest, *other.columns], self.fit, rows, share))
                weights.append(1.0 / (1 + len(alike)))
                weights[0] -= weights[-1]
        return replace(part, fit=mean_of(fits, weights))

    def beside(self, other: Selection) -> Selection:
        """Return the Selection with the rivals that another one has for the same Candidates.

        The table gets the columns of those in `alike`.
        """
        known = dict(zip(other.chosen, other.rivals))
        told = replace(self, rivals=tuple(known.get(one, ()) for one in self.chosen))
        terms = [term for one in chain.from_iterable(told.alike) for term in one.terms]
        return replace(told, table=self.table.with_terms(terms))

    @property
    def alike(self) -> list[list[Candidate]]:
        """Return, for each chosen Candidate, the rivals that explain as much."""
        return [
            [rival.candidate for rival in rivals if rival.is_alike(one)]
            for one, rivals in zip(self.chosen, self.rivals)
        ]

    @property
    def shared(self) -> list[list[Candidate]]:
        """Return, for each chosen Candidate, the rivals of `alike` that the Fit holds too."""
        fitted = set(self.fit.columns)
        return [[one for one in some if fitted.issuperset(one.columns)] for some in self.alike]

    @property
    def terms(self) -> list[Term]:
        """Return the Terms whose values the Fit has."""
        several = [*self.chosen, *chain.from_iterable(self.shared)]
        return [term for candidate in several for term in candidate.terms]

    def where(self, keeps: Callable[[Effect], bool]) -> Selection:
        """Return the Selection of terms whose Effects `keeps` accepts, with the present weights.

        The values are estimated without the dropped terms.
        """
        parts = [candidate.where(keeps) for candidate in self.chosen]
        if parts == list(self.chosen):
            return self
        of = self._chosen_of(
            [candidate for candidate, part in zip(self.chosen, parts) if part is not None]
        )
        chosen = tuple(part for part in parts if part is not None)
        return replace(
            self, **{**of, "chosen": chosen}, fit=refit(self.table, self.columns(chosen), self.fit)
        )

    def _chosen_of(self, candidates: Collection[Candidate]) -> dict[str, Any]:
        places = [k for k, candidate in enumerate(self.chosen) if candidate in candidates]
        return {
            name: tuple(getattr(self, name)[k] for k in places)
            for name in ("chosen", "loss", "rivals")
        }

    def plus(self, candidate: Candidate) -> Selection:
        """Return the Selection with one more Candidate; the table has its columns."""
        chosen = (*self.chosen, candidate)
        model = fit(self.table, self.columns(chosen), self.fit.inflation)
        return replace(
            self, chosen=chosen, fit=model, loss=(*self.loss, 0.0), rivals=(*self.rivals, ())
        )


def select(
    table: RegressionTable,
    candidates: list[Candidate],
    inflation: np.ndarray,
    search: Search | None = None,
    scan: Scan | None = None,
    start: Iterable[Candidate] = (),
    progress: Callable[[], object] = lambda: None,
) -> Selection:
    """Select from `candidates` by forward steps with backward elimination.

    Parameters
    ----------
    table : RegressionTable
        It holds the columns of `candidates`.
    candidates : list of Candidate
        Candidates that every step scores.
    inflation : (groups,)
        Variance inflation, at least 1.
    search : Search, optional
        search(table, fit, chosen) returns more Candidates for the present residual.
    scan : Scan, optional
        It proposes functions. Separate fits score the first FITTED, because the present weights
        treat their contribution as outliers.
    start : Candidates
        The initial model; backward elimination after a forward step can drop them.
    progress : function
        It is called every few seconds.
    """
    chosen = list(start)
    table = table.with_terms([term for one in chosen for term in one.terms])
    model = fit(table, columns_of(chosen), inflation)
    for _ in range(MAX_STEPS):
        scanned, even = (scan(table, model, chosen), scan.even) if scan else ([], np.empty(0))
        found = (search(table, model, chosen) if search else []) + scanned[FITTED:]
        # Forward step: score all candidates, and add the best one if it gains more than its price.
        wider = table.with_terms([term for candidate in found for term in candidate.terms])
        ranked = rank(wider, candidates + found, chosen, model)
        ranked += [
            (criterion_of(table, chosen, model, one, len(candidates), even), one)
            for one in scanned[:FITTED]
        ]
        ranked.sort(key=lambda item: -item[0])
        progress()
        if not ranked or ranked[0][0] <= 0.0:
            break
        best = _sparse_first(ranked) if scan else ranked[0][1]
        table = table.with_terms(best.terms)
        chosen.append(best)
        model = fit(table, columns_of(chosen), inflation, near=model)
        chosen, model = _backward(table, chosen, model, len(candidates))
    loss = _criteria(table, chosen, model, len(candidates))
    progress()
    return Selection(table, tuple(chosen), model, tuple(loss), ((),) * len(chosen))


def _sparse_first(ranked: list[tuple[float, Candidate]]) -> Candidate:
    """Return the best Candidate, or a small Candidate that gains nearly as much as a large one.

    Small means at most FEW columns, large more than LARGE, nearly at least GOOD_PART. Later steps
    show whether the rest of the large group is needed.
    """
    criterion, best = ranked[0]
    few = (
        one for score, one in ranked if score >= GOOD_PART * criterion and len(one.columns) <= FEW
    )
    return best if len(best.columns) <= LARGE else next(few, best)


def criterion_of(
    table: RegressionTable,
    chosen: Sequence[Candidate],
    model: Fit,
    candidate: Candidate,
    choices: int,
    even: np.ndarray,
) -> float:
    """Return the criterion of one more Candidate, the smaller of two scores.

    The first score is the likelihood ratio of both fits; chance in noisy series can inflate it. The
    second is least squares with the weights `even`; outliers can inflate it. An unacceptable
    candidate scores minus infinity.

    choices : number of candidates; even : (n,) weights
    """
    table = table.with_terms(candidate.terms)
    wider = fit(
        table, columns_of([*chosen, candidate]), model.inflation, covariance=False, near=model
    )
    if not acceptable(table, candidate, wider.values(candidate.columns)):
        return -np.inf
    scorer = Scorer(table, columns_of(chosen), wider, candidate.columns)
    gained = scorer.gain(candidate.columns)
    if gained is None:  # the model contains it
        return -np.inf
    even_scorer = Scorer(table, columns_of(chosen), replace(wider, weight=even), candidate.columns)
    least_squares = even_scorer.gain(candidate.columns)
    assert least_squares is not None  # the same columns are new
    gain = min(wider.likelihood(table) - model.likelihood(table), least_squares.gain)
    return gain - scorer.price(candidate, gained.determined, choices)


def worth(selection: Selection, choices: int) -> float:
    """Return the criterion of a Selection: twice the log-posterior of its fit, minus its prices.

    A candidate pays only for parameters that those before it do not contain. The value has an
    unknown constant, so compare Selections of the same rows and inflation only.

    choices : number of candidates that were offered; each choice costs 2 log(choices)
    """
    chosen, total = selection.chosen, selection.fit.likelihood(selection.table)
    for k, candidate in enumerate(chosen):
        scorer = Scorer(selection.table, columns_of(chosen[:k]), selection.fit, candidate.columns)
        gained = scorer.gain(candidate.columns)
        total -= scorer.price(candidate, gained.determined if gained else 0.0, choices)
    return total


def rank(
    table: RegressionTable, candidates: Sequence[Candidate], chosen: Sequence[Candidate], model: Fit
) -> list[tuple[float, Candidate]]:
    """Return [(criterion, Candidate)], best first.

    Candidates far below their price, and negligible or impossible values, are left out.
    """
    scorer, out = Scorer(table, columns_of(chosen), model, columns_of(candidates)), []
    for candidate in candidates:
        gained = scorer.gain(candidate.columns) if scorer.may_gain(candidate.columns) else None
        if gained is None or gained.determined < LEAST_DETERMINED:
            continue
        criterion = gained.gain - scorer.price(candidate, gained.determined, len(candidates))
        if criterion > -AMBIGUOUS and acceptable(table, candidate, gained.beta):
            out.append((criterion, candidate))
    return sorted(out, key=lambda item: -item[0])


def acceptable(table: RegressionTable, candidate: Candidate, beta: np.ndarray) -> bool:
    """Return whether values beta (k,) of a Candidate are possible, and large enough on a channel.

    A contribution is large enough if its RMS exceeds `Channel.negligible`.
    """
    if not (candidate.sizable(beta) and candidate.plausible(beta)):
        return False
    part = table.matrix(candidate.columns) @ beta
    for name in table.present:
        moved = part[table.rows_of(name)]
        moved = moved[moved != 0.0]
        if len(moved) and np.sqrt(np.mean(moved**2)) > CHANNELS[name].negligible:
            return True
    return False


def _backward(
    table: RegressionTable, chosen: list[Candidate], model: Fit, choices: int
) -> tuple[list[Candidate], Fit]:
    """Drop candidates that fall below their price, or become negligible or impossible.

    The one with the smallest criterion goes first; then the others are fitted anew. A single
    candidate stays: the forward step has just accepted it. Returns (the others, their Fit).

    choices : number of candidates that were offered, for the price of a choice
    """
    while len(chosen) > 1:
        criteria = _criteria(table, chosen, model, choices)
        for k, candidate in enumerate(chosen):
            if not acceptable(table, candidate, model.values(candidate.columns)):
                criteria[k] = -np.inf
        weakest = int(np.argmin(criteria))
        if criteria[weakest] > 0.0:
            break
        chosen = chosen[:weakest] + chosen[weakest + 1 :]
        model = fit(table, columns_of(chosen), model.inflation)
    return chosen, model


def _criteria(
    table: RegressionTable, chosen: list[Candidate], model: Fit, choices: int
) -> list[float]:
    """Return the criterion of each chosen Candidate given the others, twice a log-likelihood."""
    out = []
    for k, candidate in enumerate(chosen):
        scorer = Scorer(table, columns_of(chosen[:k] + chosen[k + 1 :]), model, candidate.columns)
        gained = scorer.gain(candidate.columns)
        if gained is None:  # the others contain all of its columns
            out.append(-scorer.price(candidate, 0.0, choices))
        else:
            out.append(gained.gain - scorer.price(candidate, gained.determined, choices))
    return out


def _beside(table: RegressionTable, candidate: Candidate, other: Candidate) -> bool:
    """Return whether two Candidates act on a common row.

    In a table that is not sparse, most do; the answer is then True.
    """
    if not table.sparse:
        return True
    touched = np.zeros(len(table.y), bool)
    for column in candidate.columns:
        touched[table.columns[column][0]] = True
    return any(touched[table.columns[column][0]].any() for column in other.columns)


def with_rivals(
    selection: Selection,
    candidates: list[Candidate],
    scan: Scan | None,
    progress: Callable[[], object],
) -> Selection:
    """Return the Selection with the rivals of each chosen Candidate.

    Rivals are other effects with a similar criterion, and functions that explain nearly as much.

    scan : Scan of functions, or None
    """
    table, chosen, model, out = selection.table, list(selection.chosen), selection.fit, []
    for k, candidate in enumerate(chosen):
        others = chosen[:k] + chosen[k + 1 :]
        rest, found = fit(table, columns_of(others), model.inflation, near=model), []
        if scan and not candidate.declared:
            # With these weights its contribution does not count as outliers.
            rest = replace(rest, weight=model.weight, scale=model.scale)
            found = scan(table, rest, others)
        wider = table.with_terms([term for one in found for term in one.terms])
        several = [
            c
            for c in candidates + found
            if c.title != candidate.title and _beside(wider, candidate, c)
        ]
        ranked = rank(wider, [*several, candidate], others, rest)
        own = next((score for score, ranked_one in ranked if ranked_one is candidate), None)
        near: dict[str, Rival] = {}
        for score, other in ranked:
            if own is None:
                break
            least = own - (AMBIGUOUS if other.declared else max(AMBIGUOUS, ALIKE * own))
            if (
                other is not candidate
                and score > least
                and set(other.channels) & set(candidate.channels)
            ):
                gap = float(own - score)
                near.setdefault(other.title, Rival(gap, other, gap / max(own, AMBIGUOUS)))
        out.append(tuple(near.values()))
        progress()
    return replace(selection, rivals=tuple(out))
