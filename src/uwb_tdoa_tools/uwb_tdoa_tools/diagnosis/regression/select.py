"""Which effects explain the residuals: forward and backward steps with a price on every parameter.

The statistic of a candidate is what it gains in log-likelihood, twice, over all channels together
and counted in independent rows. A parameter costs log(rows) as in the Bayesian information
criterion, and choosing among C candidates costs 2 log C (Chen and Chen, Biometrika 2008, extended
BIC): that holds the false-alarm rate of the whole catalogue.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ..channels import CHANNELS
from .fit import Fit, fit, refit
from .scorer import Scorer
from .table import RegressionTable
from .terms import columns_of

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Sequence

    from uwb_tdoa_bias.effects import Effect

    from .scan import Scan
    from .terms import Candidate

MAX_STEPS = 14
FITTED = 6  # of what a scan proposes
# columns of one and of a group, and the share of its criterion that the one must reach
FEW, LARGE, GOOD_PART = (3, 6, 0.5)
LEAST_DETERMINED = 0.3  # parameters that the data must determine of a candidate
AMBIGUOUS = 10.0  # less difference in the criterion is no decision
# share of the criterion by which a function may be worse than another one that it is much like
ALIKE = 0.1


class Search(Protocol):
    """What finds more Candidates for the residual of a Fit of the chosen ones to a RegressionTable."""

    def __call__(
        self, table: RegressionTable, model: Fit, chosen: Sequence[Candidate], /
    ) -> list[Candidate]:
        """They, none or several."""
        ...


@dataclass(frozen=True)
class Rival:
    """A Candidate that could stand in the place of a chosen one, and by how much its criterion is
    worse.
    """

    gap: float
    candidate: Candidate


@dataclass(frozen=True, eq=False)
class Selection:
    """table : RegressionTable with the columns of all candidates; chosen : (Candidate, ...); fit :
    Fit of all of them; loss : criterion that each is worth beside the others; rivals : for each,
    (Rival, ...), once somebody has looked for them.
    """

    table: RegressionTable
    chosen: tuple[Candidate, ...]
    fit: Fit
    loss: tuple[float, ...]
    rivals: tuple[tuple[Rival, ...], ...]

    def only(self, candidates: Collection[Candidate]) -> Selection:
        """Selection of some of the chosen Candidates, fitted anew."""
        chosen = self._chosen_of(candidates)
        return replace(
            self, **chosen, fit=fit(self.table, columns_of(chosen["chosen"]), self.fit.inflation)
        )

    def kept(self, candidates: Collection[Candidate]) -> Selection:
        """Selection of some of the chosen Candidates, fitted with the present weights: what the
        others explain is not taken for outliers.
        """
        chosen = self._chosen_of(candidates)
        return replace(
            self, **chosen, fit=refit(self.table, columns_of(chosen["chosen"]), self.fit)
        )

    def where(self, keeps: Callable[[Effect], bool]) -> Selection:
        """Selection of the terms alone whose Effects a function keeps, fitted with the present
        weights: what is written without the others has the values of a model without them.
        """
        parts = [candidate.where(keeps) for candidate in self.chosen]
        if parts == list(self.chosen):
            return self
        of = self._chosen_of(
            [candidate for candidate, part in zip(self.chosen, parts) if part is not None]
        )
        chosen = tuple(part for part in parts if part is not None)
        return replace(
            self, **{**of, "chosen": chosen}, fit=refit(self.table, columns_of(chosen), self.fit)
        )

    def _chosen_of(self, candidates: Collection[Candidate]) -> dict[str, Any]:
        places = [k for k, candidate in enumerate(self.chosen) if candidate in candidates]
        return {
            name: tuple(getattr(self, name)[k] for k in places)
            for name in ("chosen", "loss", "rivals")
        }

    def plus(self, candidate: Candidate) -> Selection:
        """Selection with one more Candidate, whose columns the table has."""
        chosen = (*self.chosen, candidate)
        model = fit(self.table, columns_of(chosen), self.fit.inflation)
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
    """Selection among `candidates`, whose columns the RegressionTable holds.

    search(table, fit, chosen) -> more Candidates, found for this residual; scan : a Scan, of whose
    Candidates the first few are fitted, because the weights of the present fit, which takes what
    they explain for outliers, would not do them justice. start : Candidates that are in the model
    to begin with, and may fall out again. progress() is called now and then.
    """
    chosen = list(start)
    model = fit(table, columns_of(chosen), inflation)
    for _ in range(MAX_STEPS):
        scanned, even = (scan(table, model, chosen), scan.even) if scan else ([], np.empty(0))
        found = (search(table, model, chosen) if search else []) + scanned[FITTED:]
        wider = table.with_terms([term for candidate in found for term in candidate.terms])
        ranked = rank(wider, candidates + found, chosen, model)
        ranked += [
            (_fitted(table, chosen, model, one, len(candidates), even), one)
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
    loss = _losses(table, chosen, model, len(candidates))
    progress()
    return Selection(table, tuple(chosen), model, tuple(loss), ((),) * len(chosen))


def _sparse_first(ranked: list[tuple[float, Candidate]]) -> Candidate:
    """The best Candidate; if that is a large group, the best of few parameters that does a good
    part of what it does: what the group is needed for besides will show.
    """
    criterion, best = ranked[0]
    few = (
        one for score, one in ranked if score >= GOOD_PART * criterion and len(one.columns) <= FEW
    )
    return best if len(best.columns) <= LARGE else next(few, best)


def _fitted(
    table: RegressionTable,
    chosen: Sequence[Candidate],
    model: Fit,
    candidate: Candidate,
    choices: int,
    even: np.ndarray,
) -> float:
    """Criterion of one Candidate more, by the likelihoods of both fits, or by least squares with
    the weights `even`, (n,), if that says less: the one believes what noisy series show by chance,
    the other what outliers do. Minus infinity for what nobody would model.
    """
    table = table.with_terms(candidate.terms)
    wider = fit(
        table, columns_of([*chosen, candidate]), model.inflation, covariance=False, near=model
    )
    if not acceptable(table, candidate, wider.values(candidate.columns)):
        return -np.inf
    scorer = Scorer(table, columns_of(chosen), wider, candidate.columns)
    gained = scorer.gain(candidate.columns)
    if gained is None:  # the model holds it
        return -np.inf
    even_scorer = Scorer(table, columns_of(chosen), replace(wider, weight=even), candidate.columns)
    least_squares = even_scorer.gain(candidate.columns)
    assert least_squares is not None  # nor is it then
    gain = min(wider.likelihood(table) - model.likelihood(table), least_squares.gain)
    return gain - scorer.price(candidate, gained.determined, choices)


def worth(selection: Selection, choices: int) -> float:
    """Criterion of a whole Selection: what its fit explains, less the price of all that is chosen."""
    chosen, total = selection.chosen, selection.fit.likelihood(selection.table)
    for k, candidate in enumerate(chosen):
        scorer = Scorer(selection.table, columns_of(chosen[:k]), selection.fit, candidate.columns)
        gained = scorer.gain(candidate.columns)
        total -= scorer.price(candidate, gained.determined if gained else 0.0, choices)
    return total


def rank(
    table: RegressionTable, candidates: Sequence[Candidate], chosen: Sequence[Candidate], model: Fit
) -> list[tuple[float, Candidate]]:
    """[(criterion, Candidate)], best first; without those that are far from worth it, of negligible
    or of impossible size.
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
    """Whether values beta (k,) of a Candidate could be, and move a channel by more than what nobody
    would model.
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
    """Drop what is no longer worth its price, once others are in, or has become negligible or
    impossible.
    """
    while len(chosen) > 1:
        losses = _losses(table, chosen, model, choices)
        for k, candidate in enumerate(chosen):
            if not acceptable(table, candidate, model.values(candidate.columns)):
                losses[k] = -np.inf
        worst = int(np.argmin(losses))
        if losses[worst] > 0.0:
            break
        chosen = chosen[:worst] + chosen[worst + 1 :]
        model = fit(table, columns_of(chosen), model.inflation)
    return chosen, model


def _losses(
    table: RegressionTable, chosen: list[Candidate], model: Fit, choices: int
) -> list[float]:
    """Criterion that each chosen Candidate is worth beside the others."""
    out = []
    for k, candidate in enumerate(chosen):
        scorer = Scorer(table, columns_of(chosen[:k] + chosen[k + 1 :]), model, candidate.columns)
        gained = scorer.gain(candidate.columns)
        if gained is None:  # others hold all of its columns
            out.append(-scorer.price(candidate, 0.0, choices))
        else:
            out.append(gained.gain - scorer.price(candidate, gained.determined, choices))
    return out


def _beside(table: RegressionTable, candidate: Candidate, other: Candidate) -> bool:
    """Whether another Candidate acts on any row that a Candidate acts on; where a RegressionTable
    is not sparse most do.
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
    """Selection with, for each chosen Candidate, the other effects that could replace it, and
    functions that would do nearly as much. scan : Scan of functions, or None.
    """
    table, chosen, model, out = selection.table, list(selection.chosen), selection.fit, []
    for k, candidate in enumerate(chosen):
        others = chosen[:k] + chosen[k + 1 :]
        rest, found = fit(table, columns_of(others), model.inflation, near=model), []
        if scan and not candidate.declared:
            # what it explains is measured, not outliers
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
                near.setdefault(other.title, Rival(float(own - score), other))
        out.append(tuple(near.values()))
        progress()
    return replace(selection, rivals=tuple(out))
