"""A selection refined: about its own values, with functions without a name, and without what does
not hold on other data.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import SmoothTerm

from .channels import CHANNELS
from .findings import Refused
from .regression.fit import fit
from .regression.held_out import held_out
from .regression.select import select, worth
from .regression.table import table_of
from .regression.terms import Candidate, Term, columns_of

if TYPE_CHECKING:
    from collections.abc import Callable, Hashable, Sequence

    from uwb_tdoa_bias.effects import Effect

    from .channels import ChannelResiduals
    from .regression.scan import Scan
    from .regression.select import Search, Selection
    from .regression.table import RegressionTable

ROUNDS = 2  # of linearising about what was found
LINEARITY_LIMIT = 0.1  # of the channel's scale: root mean square by which a linear model may be off
# held-out log-likelihood, twice, and its t value over blocks, that maps must bring
MAPS_GAIN, MAPS_SURE = (20.0, 3.0)
DISGUISED = 4  # times that what disguises itself as noise is searched for before noise is measured
SAME_STORY = 0.05  # share of what a model explains that a simpler one may explain less
MIN_GAIN = 2.0  # held-out log-likelihood, twice, that a term must bring


def effects_of(selection: Selection) -> tuple[Effect, ...]:
    """The chosen Candidates with the values of the fit, parameters of one effect together, within
    the bounds of the effect: tuple of Effects.
    """
    values: dict[Hashable, dict[str, float]] = {}
    std: dict[Hashable, dict[str, float]] = {}
    effects: dict[Hashable, Effect] = {}
    error = np.sqrt(np.diag(selection.fit.cov))
    fitted = dict(zip(selection.fit.columns, zip(selection.fit.beta.tolist(), error.tolist())))
    for term in (term for candidate in selection.chosen for term in candidate.terms):
        effect = term.effect
        identity = entry_of(effect)
        effects.setdefault(identity, effect)
        values.setdefault(identity, {}).update(effect.values)
        for column in term.columns:
            bound = effect.bound_of(column.key)
            value, deviation = fitted[column]
            values[identity][column.key] = min(max(value, -bound), bound)
            std.setdefault(identity, {})[column.key] = min(deviation, bound)
    return tuple(
        replace(effect, values=values[identity], std=std[identity], source="diagnose")
        for identity, effect in effects.items()
    )


def written(selection: Selection, declared: Sequence[Candidate]) -> Selection:
    """The Selection that effects.yaml can hold: without functions of what no node has, with the
    Candidates of the catalogue that are worth it in their place, and fitted anew, so that each
    value is that of this model. Errors of the ground truth, and what the filter judges itself,
    stay: no node meets them.
    """
    kept = selection.where(lambda effect: effect.usable or not isinstance(effect, SmoothTerm))
    if kept is selection:
        return selection
    return select(selection.table, list(declared), selection.fit.inflation, start=kept.chosen)


def entry_of(effect: Effect) -> Hashable:
    """Equal for Effects that are one entry of effects.yaml."""
    return effect.merge_key if isinstance(effect, SmoothTerm) else effect.name


def linearised(
    found: Sequence[ChannelResiduals], candidates: Sequence[Candidate], model: Sequence[Effect]
) -> RegressionTable:
    """RegressionTable with the columns of all candidates about `model`, whose contribution is put
    back: a fit gives whole values, not increments.
    """
    here = {effect.merge_key: effect for effect in model}
    terms = [term for candidate in candidates for term in candidate.terms]
    own = [Term(effect, tuple(effect.std)) for effect in model]
    about = [Term(here.get(term.effect.merge_key, term.effect), term.keys) for term in terms]
    table = table_of(found).with_terms([*own, *about])
    return table.with_contribution([(term.effect, term.columns) for term in own])


def inflation_of(
    table: RegressionTable, declared: Sequence[Candidate], search: Search
) -> np.ndarray:
    """(groups,) loss of independence, on the residual of a fit with all that is declared, and with
    what `search`, as of `select`, finds.
    """
    known, model = list(declared), fit(table, columns_of(declared), covariance=False)
    for _ in range(DISGUISED):
        uninflated = replace(model, inflation=np.ones_like(model.inflation))
        found = search(table, uninflated, known)
        if not found:
            break
        known += found
        table = table.with_terms([term for candidate in found for term in candidate.terms])
        model = fit(table, columns_of(known), covariance=False)
    return model.inflation


def relinearised(
    selection: Selection,
    at: Callable[[Sequence[Effect]], list[ChannelResiduals]],
    candidates: Sequence[Candidate],
) -> Selection:
    """The selection fitted anew in a RegressionTable about its own values, with the columns of
    `candidates`, where it is not as linear as the RegressionTable that it was found in says:
    positions of anchors that are far off are not.
    """
    for _ in range(ROUNDS):
        model = effects_of(selection)
        current, table = at(model), selection.table
        y, limit = (
            linearised(current, (), model).y,
            LINEARITY_LIMIT * selection.fit.scale[table.group],
        )
        if len(y) == len(table.y) and np.mean(((y - table.y) / limit) ** 2) <= 1.0:
            break
        table = linearised(current, [*candidates, *selection.chosen], model)
        refitted = fit(table, columns_of(selection.chosen), selection.fit.inflation)
        selection = replace(selection, table=table, fit=refitted)
    return selection


def with_smooth(
    selection: Selection,
    unmoved: RegressionTable,
    declared: Sequence[Candidate],
    smooth: Sequence[Candidate],
    search: Search,
    scan_of: Callable[[RegressionTable], Scan],
    progress: Callable[[], object],
) -> Selection:
    """The selection carried on with functions without a name; or begun anew with them in the
    RegressionTable `unmoved`, about nothing, if that explains more: the declared effect, or the
    large group of parameters, was a stopgap.
    """
    everything = [*smooth, *declared]
    terms = [term for candidate in smooth for term in candidate.terms]
    table = selection.table.with_terms(terms)
    progress()
    inflation = selection.fit.inflation
    after = select(table, everything, inflation, search, scan_of(table), selection.chosen, progress)
    if selection.chosen:
        anew = select(
            unmoved.with_terms(terms),
            everything,
            inflation,
            search,
            scan_of(unmoved),
            progress=progress,
        )
        after = _simpler(after, anew, len(everything))
    return after


def _simpler(after: Selection, anew: Selection, choices: int) -> Selection:
    """Of two Selections the one that is worth more; or, if they tell of other things, the one with
    fewer parameters where it is hardly worth less: how far a function is off grows with its size,
    and many parameters can be anything.
    """
    fewer, more = sorted((after, anew), key=lambda each: len(each.fit.beta))
    nothing = fit(after.table, [], after.fit.inflation).likelihood(after.table)
    least, most = (worth(each, choices) - nothing for each in (fewer, more))
    same = {candidate.label for candidate in after.chosen} == {
        candidate.label for candidate in anew.chosen
    }
    return fewer if least >= most * (1.0 if same else 1.0 - SAME_STORY) else more


def with_maps(
    selection: Selection, smooth: Sequence[Candidate], refused: list[Refused]
) -> Selection:
    """Add functions of the place for every anchor, each too weak alone, if together they are
    plainly worth it on data that they were not fitted to.
    """
    taken = {term.effect.merge_key for candidate in selection.chosen for term in candidate.terms}
    for channel in CHANNELS.values():
        terms: dict[Hashable, Term] = {}
        for candidate in smooth:  # the first of a function is that of all anchors
            term = candidate.terms[0]
            function = term.function if channel.name in candidate.channels else None
            if function and function.form == "anchor" and function.covariate in channel.maps:
                terms.setdefault(term.effect.merge_key, term)
        maps = Candidate(tuple(term for identity, term in terms.items() if identity not in taken))
        if not maps.terms:
            continue
        trial = selection.plus(maps)
        scores = [held_out(trial)[-1]]
        if selection.table.flights >= 3:
            scores.append(held_out(trial, by_flight=True)[-1])
        if (
            min(score.gain for score in scores) > MAPS_GAIN
            and min(score.t for score in scores) > MAPS_SURE
        ):
            selection = trial
        elif min(scores).gain > 0.0:
            worth_it = 0.5 * min(scores).gain
            refused.append(
                Refused(
                    maps.label,
                    f"does not help held-out data enough (log-likelihood {worth_it:.1f})",
                )
            )
    return selection


def cross_validated(selection: Selection, refused: list[Refused]) -> Selection:
    """Drop, one by one, what does not help rows that it was not fitted to."""
    while selection.chosen:
        scores = held_out(selection)
        if selection.table.flights >= 3:
            across = held_out(selection, by_flight=True)
            scores = [
                min(score, other) if recurs(candidate) else score
                for score, other, candidate in zip(scores, across, selection.chosen)
            ]
        worst = min(range(len(scores)), key=lambda k: scores[k].gain)
        if scores[worst].gain > MIN_GAIN:
            break
        candidate = selection.chosen[worst]
        reason = f"does not help held-out data (log-likelihood {0.5 * scores[worst].gain:.1f})"
        refused.append(Refused(candidate.label, reason))
        selection = selection.only([other for other in selection.chosen if other is not candidate])
    return selection


def recurs(candidate: Candidate) -> bool:
    """Whether it should hold on other flights too: not what happened at a time."""
    return not any(
        key.endswith((".start", ".end")) for term in candidate.terms for key in term.effect.values
    )
