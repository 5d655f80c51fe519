# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Refine a selection: relinearize, add functions without a name, and cross-validate."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import replace

import numpy as np

from uwb_tdoa_bias.effects import Effect, SmoothTerm
from uwb_tdoa_bias.effects.base import OF_PAIR

from .channels import CHANNELS, ChannelResiduals
from .findings import Refused
from .over_flights import of_one_flight
from .regression.fit import fit
from .regression.held_out import held_out
from .regression.scan import Scan
from .regression.select import AMBIGUOUS, LARGE, Search, Selection, criterion_of, select, worth
from .regression.table import RegressionTable, table_of
from .regression.terms import Candidate, Term, columns_of

ROUNDS = 2  # number of linearizations
LINEARITY_LIMIT = 0.1  # largest RMS error of linearization, relative to the channel's scale
# smallest gain of maps on hold-out data (twice a log-likelihood), and its t value over blocks
MAPS_GAIN, MAPS_SURE = (20.0, 3.0)
DISGUISED = 4  # searches for effects that look like noise, before the noise is measured
SAME_STORY = 0.05  # largest share of a model's gain that a simpler model may lack
MIN_GAIN = 2.0  # smallest gain of a term on hold-out data, twice a log-likelihood
OF_ONE = "only one of both flights shows it"


def effects_of(selection: Selection) -> tuple[Effect, ...]:
    """Return the Effects of the chosen Candidates with fitted values, clipped to their bounds.

    Parameters of one effect are merged.
    """
    values: dict[Hashable, dict[str, float]] = {}
    std: dict[Hashable, dict[str, float]] = {}
    effects: dict[Hashable, Effect] = {}
    error = np.sqrt(np.diag(selection.fit.cov))
    fitted = dict(zip(selection.fit.columns, zip(selection.fit.beta.tolist(), error.tolist())))
    for term in selection.terms:
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
    """Return the Selection that effects.yaml can hold.

    Functions of covariates that nodes lack are dropped. Declared Candidates can replace them, and
    the fit is repeated. Errors of the ground truth, and properties that the filter estimates, stay:
    they do not affect nodes.
    """
    kept = selection.where(lambda effect: effect.usable or not isinstance(effect, SmoothTerm))
    if kept is selection:
        return selection
    return select(selection.table, list(declared), selection.fit.inflation, start=kept.chosen)


def entry_of(effect: Effect) -> Hashable:
    """Return a key that is equal for Effects of one entry in effects.yaml."""
    return effect.merge_key if isinstance(effect, SmoothTerm) else effect.name


def linearised(
    found: Sequence[ChannelResiduals], candidates: Sequence[Candidate], model: Sequence[Effect]
) -> RegressionTable:
    """Return a RegressionTable of all candidates, linearized at `model`.

    The contribution of `model` is added to y. A fit then gives whole values, not increments.
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
    """Return the variance inflation of each group, (groups,).

    It is measured on the residual of a fit with all declared effects and effects that `search`
    finds.
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


def with_measured_noise(
    selection: Selection, declared: Sequence[Candidate], scan: Scan, progress: Callable[[], object]
) -> Selection:
    """Return the Selection with the variance inflation that is left beside functions.

    A function that no declared effect describes counts as correlated noise, and hides itself.
    Functions are added to the fit that measures the inflation, as long as they pay their price
    with the inflation that they leave.

    declared : Candidates of the fit that measured the inflation; scan : Scan of the table
    """
    table, model, chosen = selection.table, selection.fit, list(selection.chosen)
    known = list(dict.fromkeys([*declared, *chosen]))
    for _ in range(DISGUISED):
        found = scan(table, model, chosen)[:1]
        progress()
        if not found:
            break
        wider = table.with_terms(found[0].terms)
        less = fit(wider, columns_of([*known, *found]), covariance=False).inflation
        less = np.minimum(less, model.inflation)
        trial = fit(table, columns_of(chosen), less, covariance=False, near=model)
        if criterion_of(wider, chosen, trial, found[0], len(declared), scan.even) <= 0.0:
            break
        table, chosen, known = wider, [*chosen, *found], [*known, *found]
        model = fit(table, columns_of(chosen), less, covariance=False, near=trial)
    if model is selection.fit:
        return selection
    anew = fit(selection.table, columns_of(selection.chosen), model.inflation)
    return replace(selection, fit=anew)


def relinearised(
    selection: Selection,
    at: Callable[[Sequence[Effect]], list[ChannelResiduals]],
    candidates: Sequence[Candidate],
) -> Selection:
    """Return the Selection refitted at its own values, if its linearization error is too large.

    Large shifts of anchors need that.

    at : at(effects) returns residuals under these effects; candidates : whose columns the table
        gets
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
    """Return the Selection after a search that includes functions without a name.

    The search runs twice: from the present selection, and from an empty one. A declared effect or a
    large group can otherwise stand in for a function.

    unmoved : RegressionTable linearized at no effects; smooth : Candidates of functions
    scan_of : scan_of(table) returns its Scan
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
    """Return the better of two Selections, or the simpler one if it explains nearly as much.

    Linearization errors of a function grow with its size, and many parameters fit anything.

    choices : number of candidates
    """
    fewer, more = sorted((after, anew), key=lambda each: len(each.fit.beta))
    nothing = fit(after.table, [], after.fit.inflation).likelihood(after.table)
    least, most = (worth(each, choices) - nothing for each in (fewer, more))
    same = {candidate.label for candidate in after.chosen} == {
        candidate.label for candidate in anew.chosen
    }
    return fewer if least >= most * (1.0 if same else 1.0 - SAME_STORY) else more


def with_fewer_pairs(selection: Selection, declared: Sequence[Candidate]) -> Selection:
    """Return the Selection with fewer parameters of pairs, if they explain the flights as well.

    Other flights may hear other pairs. Offsets of all pairs in a ring are delays of anchors and the
    offset of one pair, and the flights cannot distinguish them. So a large group of parameters of
    pairs competes with some of them alone, and with each effect that it can be confounded with and
    some of them. It stays if it is better by more than AMBIGUOUS.

    declared : Candidates, the full set of each effect before its parts
    """
    full = {one.name: one for one in reversed(declared)}
    for group in selection.chosen:
        effect = group.terms[0].effect
        if effect.key_form != OF_PAIR or len(group.columns) <= LARGE:
            continue
        others = [one for one in selection.chosen if one is not group]
        taken = {one.name for one in others}
        instead = [full[name] for name in effect.row.confounded_with if name in full.keys() - taken]
        single = [one for one in declared if one.name == group.name and len(one.columns) == 1]
        trials = [
            select(selection.table, single, selection.fit.inflation, start=start)
            for start in (others, *([*others, one] for one in instead))
        ]
        criteria = [worth(trial, len(declared)) for trial in trials]
        if max(criteria) > worth(selection, len(declared)) - AMBIGUOUS:
            selection = trials[int(np.argmax(criteria))]
    return selection


def with_maps(selection: Selection, smooth: Sequence[Candidate]) -> Selection:
    """Return the Selection with functions of the place of each anchor, if hold-out data agree.

    Each function alone is too weak to be selected; together they must gain clearly.
    """
    taken = {term.effect.merge_key for candidate in selection.chosen for term in candidate.terms}
    for every in maps_of(smooth):
        maps = Candidate(tuple(term for term in every.terms if term.effect.merge_key not in taken))
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
    return selection


def maps_of(smooth: Sequence[Candidate]) -> list[Candidate]:
    """Return one Candidate per channel: functions of the place of each anchor, all together.

    smooth : Candidates of functions
    """
    out = []
    for channel in CHANNELS.values():
        terms: dict[Hashable, Term] = {}
        for candidate in smooth:  # the first candidate of a function is common to all anchors
            term = candidate.terms[0]
            function = term.function if channel.name in candidate.channels else None
            if function and function.form == "anchor" and function.covariate in channel.maps:
                terms.setdefault(term.effect.merge_key, term)
        if terms:
            out.append(Candidate(tuple(terms.values())))
    return out


def cross_validated(selection: Selection, refused: list[Refused]) -> Selection:
    """Return the Selection without Candidates that do not improve hold-out rows.

    The worst is dropped and the rest fitted again, until all gain more than MIN_GAIN. From three
    flights on, whole flights are held out too, and the smaller gain counts. Of two flights, both
    must show a function without a name.

    refused : dropped Candidates are appended
    """
    while selection.chosen:
        single = [
            one for one in selection.chosen if not one.declared and of_one_flight(selection, one)
        ]
        if single:
            refused += [Refused(one.label, OF_ONE) for one in single]
            selection = selection.only([one for one in selection.chosen if one not in single])
            continue
        scores = held_out(selection)
        if selection.table.flights >= 3:
            across = held_out(selection, by_flight=True)
            scores = [
                min(score, other) if recurs(candidate) else score  # by gain, their first field
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
    """Return whether a Candidate applies to other flights too: it has no start or end time."""
    return not any(
        key.endswith((".start", ".end")) for term in candidate.terms for key in term.effect.values
    )
