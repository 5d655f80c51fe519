"""From flights to a model: which effects are there, how large, how sure, and what else it could be."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects import EFFECTS, EffectSet, SmoothTerm
from uwb_tdoa_bias.effects.covariates import UPWARDS
from uwb_tdoa_bias.foundation.anchors import Anchors

from ..parallel import in_one_thread
from .channels import CHANNELS, residuals
from .channels.views import MOST_LINKS
from .detectors import DETECTORS
from .deviations import with_deviations
from .domains import Seen
from .findings import EffectFinding, Refused
from .over_flights import of_one, shares
from .regression.confounding import alternatives
from .regression.fit import fit
from .regression.held_out import held_out
from .regression.scan import Scan
from .regression.select import Selection, select, with_rivals, worth
from .regression.table import table_of
from .regression.terms import Candidate, Term, candidates_of, columns_of
from .self_calibration.prior import OF_ANCHORS, to_keep

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Hashable, Sequence
    from uwb_tdoa_bias.effects import Covariance, Effect
    from uwb_tdoa_bias.foundation.flight import Flight
    from ..parallel import MapFunction
    from .channels.views import CovariateView
    from .detectors import Detection, Detector
    from .validation import ValidatedSelection
    from .references import Reference
    from .regression.fit import Fit
    from .regression.select import Search
    from .regression.table import Table
    from .channels import ChannelResidual, ChannelResiduals

ROUNDS = 2  # of linearising about what was found
LINEARITY_LIMIT = 0.1  # of the channel's scale: root mean square by which a linear model may be off
MAPS_GAIN, MAPS_SURE = 20.0, 3.0  # held-out log-likelihood, twice, and its t value over blocks, that maps must bring
DISGUISED = 4  # times that what disguises itself as noise is searched for before noise is measured
SAME_STORY = 0.05  # share of what a model explains that a simpler one may explain less
FOR_MAPS = 3  # flights: a map of fewer is of their paths, and misleads others; two that fly alike bear each other out
ON_FLOOR = 0.5  # m by which a function of UPWARDS changes at least near the floor, to be told
MIN_GAIN = 2.0  # held-out log-likelihood, twice, that a term must bring


@dataclass(frozen=True, eq=False)
class Attribution:
    """residuals, remaining : [{channel: ChannelResidual}] under the base model and under the whole; selection : Selection;
    detections : (Detection, ...); candidates : all declared Candidates; refused : (Refused, ...); names : of the flights; alone :
    ((name of a flight, Selection), ...) of what one flight shows and the others do not; floor : Selection of what there is near the
    floor, beside what is found in the air; None if nobody knows; floor_names : of the flights of its Table."""

    residuals: list[ChannelResiduals]
    remaining: list[ChannelResiduals]
    selection: Selection
    detections: tuple[Detection, ...]
    candidates: list[Candidate]
    refused: tuple[Refused, ...]
    names: tuple[str, ...]
    alone: tuple[tuple[str, Selection], ...] = ()
    floor: Selection | None = None
    floor_names: tuple[str, ...] = ()

    @cached_property
    def seen(self) -> Seen:
        """Seen, of what the residuals hold."""
        return Seen(self.residuals)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """All Effects found that may be taken out: tuple."""
        in_the_air = self.seen.limited((*effects_of(self.selection), *(detection.effect for detection in self.detections)))
        return (*in_the_air, *self.of_floor)

    @property
    def of_floor(self) -> tuple[Effect, ...]:
        """Effects found near the floor that the filter may be told: tuple. Functions without a name would go on in the air."""
        return tuple(effect for effect in effects_of(self.floor) if effect.weighed) if self.floor else ()

    @property
    def covariance(self) -> Covariance | None:
        """Of the positions and delays of anchors in the selection: the prior of the next calibration; None without any."""
        columns = [column for candidate in self.selection.chosen if candidate.name in OF_ANCHORS for column in candidate.columns]
        if not columns:
            return None
        places = [self.selection.fit.columns.index(column) for column in columns]
        return to_keep(tuple((str(column.effect[0]), column.key) for column in columns), self.selection.fit.cov[np.ix_(places, places)])

    def of(self, validated: ValidatedSelection) -> Attribution:
        """The Attribution of a ValidatedSelection."""
        return replace(self, selection=with_deviations(validated.selection), detections=validated.detections, alone=())

    def findings(self) -> list[EffectFinding]:
        """[EffectFinding], those by regression first, those of one flight alone last."""
        out = _findings(self.selection, self.candidates, self.names)
        out += map(_of_detection, self.detections)
        if self.floor:
            out += [replace(finding, on_floor=True) for finding in _findings(self.floor, [], self.floor_names)]
        for name, selection in self.alone:
            out += [replace(finding, flight=name) for finding in _findings(selection, [], (name,))]
        return out


@in_one_thread
def attribute(
    flights: Sequence[Flight], reference: Reference, base: EffectSet = EffectSet(),
    kinds: Collection[str] | None = None, undeclared: bool = True, progress: Callable[[], object] = lambda: None,
    map_function: MapFunction = map,
) -> Attribution:  # fmt: skip
    """Attribution of the residuals of Flights, which the Reference has prepared, to effects beyond `base`.

    kinds : names of the declared effects to look for, None for all; undeclared : look for functions without a name too;
    progress() is called now and then; map_function(function, items) : as map, but for the time and the process in
    which each is done.
    """
    wanted = [detector for name, detector in DETECTORS.items() if kinds is None or name in kinds]
    detectors = [detector for detector in wanted if not detector.on_floor]

    def at(model: Sequence[Effect]) -> list[ChannelResiduals]:
        return residuals_of(flights, reference, EffectSet((*base.effects, *model)), progress, map_function)

    search = partial(_search, detectors)
    under_base = at(())
    installation = _installation(flights)
    declared = _declared(under_base, reference, kinds, installation)
    unmoved = _linearised(under_base, declared, ())
    disguises = partial(_search, [detector for detector in detectors if detector.disguises])
    inflation = _inflation(unmoved, declared, disguises)
    progress()
    selection = select(unmoved, declared, inflation, search, progress=progress)
    current, found = under_base, effects_of(selection)
    for _ in range(ROUNDS - 1):
        if not found:
            break
        current = at(found)
        progress()
        selection = select(_linearised(current, declared, found), declared, inflation, search, progress=progress)
        found = effects_of(selection)
    refused: list[Refused] = []
    selection = _that_hold_on_other_data(selection, refused)
    smooth: list[Candidate] = []
    scans: dict[int, Scan] = {}

    def scan_of(table: Table) -> Scan:  # one for each number of rows, which other stamps can change
        if len(table.y) not in scans:
            scans[len(table.y)] = Scan(table, _views(table))
        return scans[len(table.y)]

    if undeclared:
        smooth = _smooth(current, installation)
        selection = _with_smooth(selection, unmoved, declared, smooth, search, scan_of, progress)
        selection = _relinearised(selection, at, declared + smooth)
        selection = _that_hold_on_other_data(selection, refused)
    selection = with_rivals(selection, declared + smooth, scan_of(selection.table) if undeclared else None, progress)
    if undeclared and len(flights) >= FOR_MAPS:
        selection = _with_maps(selection, smooth, refused)
    remaining, selection = at(effects_of(selection)), with_deviations(selection)
    detected = (detector.detect(remaining) for detector in detectors)
    detections = tuple(detection for detection in detected if detection is not None)
    names = tuple(flight.name for flight in flights)
    alone: tuple[tuple[str, Selection], ...] = ()
    if undeclared and len(flights) > 1 and all(reference.positions_known):
        alone = tuple((names[k], own) for k, own in of_one(remaining, inflation, _views, search, map_function))
    near = [(name, part) for name, part in zip(names, map(near_floor, remaining)) if part]
    floor = None
    if near:
        floor = on_floor([part for _, part in near], [one for one in wanted if one.on_floor], undeclared, refused, progress)
    floor_names = tuple(name for name, _ in near)
    return Attribution(
        under_base, remaining, selection, detections, declared, tuple(refused), names, alone, floor, floor_names
    )  # fmt: skip


def near_floor(residuals: ChannelResiduals) -> ChannelResiduals:
    """{channel: ChannelResidual} of what is near the floor in the residuals of a flight; {} of nothing."""
    parts = {name: part.of_floor() for name, part in residuals.items()}
    return {name: part for name, part in parts.items() if part is not None}


def on_floor(
    residuals: Sequence[ChannelResiduals], detectors: Sequence[Detector], undeclared: bool, refused: list[Refused],
    progress: Callable[[], object] = lambda: None,
) -> Selection:  # fmt: skip
    """Selection of what [{channel: ChannelResidual}] near the floor show: effects with a name, or, where there is none, functions of what
    changes with the height: at one place all else is the same.

    A few seconds, of errors of metres, are looked at by themselves: among all that is in the air they would pass for outliers, or pull
    at what is fitted there."""
    table = table_of(residuals)
    found = select(table, [], _inflation(table, [], partial(_search, detectors)), partial(_search, detectors), progress=progress)
    if undeclared and not found.chosen:
        views = {name: [view for view in views if view.covariate in UPWARDS] for name, views in _views(table).items()}
        scan = Scan(table, views)
        inflation = _inflation(table, [], lambda *fitted: scan(*fitted)[:1])
        found = select(table, [], inflation, scan=scan, progress=progress)
        found = found.only([one for one in found.chosen if _is_large(one, found)])
    return _that_hold_on_other_data(found, refused)


def effects_of(selection: Selection) -> tuple[Effect, ...]:
    """The chosen Candidates with the values of the fit, parameters of one effect together, within the bounds of the effect:
    tuple of Effects."""
    values: dict[Hashable, dict[str, float]] = {}
    std: dict[Hashable, dict[str, float]] = {}
    effects: dict[Hashable, Effect] = {}
    error = np.sqrt(np.diag(selection.fit.cov))
    fitted = dict(zip(selection.fit.columns, zip(selection.fit.beta.tolist(), error.tolist())))
    for term in (term for candidate in selection.chosen for term in candidate.terms):
        effect = term.effect
        identity = _merged_as(effect)
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


def _merged_as(effect: Effect) -> Hashable:
    """Equal for Effects that are one entry of effects.yaml."""
    return effect.identity if isinstance(effect, SmoothTerm) else effect.name


def residuals_of(
    flights: Sequence[Flight], reference: Reference, effects: EffectSet,
    progress: Callable[[], object] = lambda: None, map_function: MapFunction = map,
) -> list[ChannelResiduals]:  # fmt: skip
    """[`channels.residuals`] of Flights. progress, map_function : as of `attribute`."""
    if not all(reference.positions_known):
        map_function = map  # with all that the filter knows of the path, they take as long to send as to find
    out = []
    for of_flight in map_function(partial(residuals, reference=reference, effects=effects), flights):
        out.append(of_flight)
        progress()
    return out


def _search(detectors: Sequence[Detector], table: Table, model: Fit, chosen: Sequence[Candidate]) -> list[Candidate]:
    return [candidate for detector in detectors for candidate in detector.search(table, model, chosen)]


def _installation(flights: Sequence[Flight]) -> tuple[Anchors, np.ndarray]:
    """(Anchors with every id that the flights have heard, each at the first of its places; (m, 2) ids of the MOST_LINKS pairs that were
    heard most, the most frequent first)."""
    several = [flight.anchors for flight in flights]
    ids, positions, orientations = (
        np.concatenate([getattr(anchors, name) for anchors in several]) for name in ("ids", "positions", "orientations")
    )
    heard = np.concatenate([np.column_stack([flight.tdoa.a, flight.tdoa.b]) for flight in flights])
    heard = heard[np.isin(heard, ids).all(axis=1) & (heard[:, 0] != heard[:, 1])]
    pairs, count = np.unique(heard, axis=0, return_counts=True)
    first = np.unique(ids, return_index=True)[1]
    first = first[np.isin(ids[first], heard)] if len(heard) else first
    anchors = Anchors(ids[first], positions[first], orientations[first], several[0].frame)
    return anchors, pairs[np.argsort(-count, kind="stable")[:MOST_LINKS]]


def _declared(
    found: Sequence[ChannelResiduals], reference: Reference, kinds: Collection[str] | None,
    installation: tuple[Anchors, np.ndarray],
) -> list[Candidate]:  # fmt: skip
    """[Candidate] of the catalogue, of effects that a channel shows, and that the reference can tell."""
    shown = {name for flight in found for name in flight}
    effects = [effect for effect in EFFECTS.values() if effect.fitted and shown & set(effect.channels)]
    chosen = [
        effect
        for effect in effects
        if (kinds is None or effect.name in kinds) and (all(reference.positions_known) or not effect.needs_reference)
        and (not effect.witnesses or shown & set(effect.witnesses))
    ]
    return [candidate for effect in chosen for candidate in candidates_of(effect(), *installation)]


def _smooth(found: Sequence[ChannelResiduals], installation: tuple[Anchors, np.ndarray]) -> list[Candidate]:
    """[Candidate] of functions of whatever each channel may depend on, of all anchors alike or each with its own."""
    out = []
    for name, channel in CHANNELS.items():
        parts = [flight[name] for flight in found if name in flight]
        for term in channel.smooth_terms(parts) if parts else ():
            out += candidates_of(term, *installation)[:1]
    return out


def _views(table: Table) -> dict[str, list[CovariateView]]:
    """{channel: [CovariateView]} of what a part of each channel of a Table may depend on."""
    parts: dict[str, list[ChannelResidual]] = {}
    for _, name, _, part in table.parts:
        parts.setdefault(name, []).append(part)
    return {name: CHANNELS[name].views(several) for name, several in parts.items()}


def _linearised(found: Sequence[ChannelResiduals], candidates: Sequence[Candidate], model: Sequence[Effect]) -> Table:
    """Table with the columns of all candidates about `model`, whose contribution is put back: a fit gives whole values, not
    increments."""
    here = {effect.identity: effect for effect in model}
    terms = [term for candidate in candidates for term in candidate.terms]
    own = [Term(effect, tuple(effect.std)) for effect in model]
    about = [Term(here.get(term.effect.identity, term.effect), term.keys) for term in terms]
    table = table_of(found).with_terms([*own, *about])
    return table.with_contribution([(term.effect, term.columns) for term in own])


def _is_large(candidate: Candidate, selection: Selection) -> bool:
    """Whether a chosen Candidate moves what it moves by ON_FLOOR: less is of the place, of which a few seconds tell nothing."""
    part = selection.table.matrix(candidate.columns) @ selection.fit.values(candidate.columns)
    return np.ptp(part) > ON_FLOOR


def _inflation(table: Table, declared: Sequence[Candidate], search: Search) -> np.ndarray:
    """(groups,) loss of independence, on the residual of a fit with all that is declared, and with what `search`, as of `select`, finds."""
    known, model = list(declared), fit(table, columns_of(declared), covariance=False)
    for _ in range(DISGUISED):
        alike = replace(model, inflation=np.ones_like(model.inflation))
        found = search(table, alike, known)
        if not found:
            break
        known += found
        table = table.with_terms([term for candidate in found for term in candidate.terms])
        model = fit(table, columns_of(known), covariance=False)
    return model.inflation


def _relinearised(
    selection: Selection, at: Callable[[Sequence[Effect]], list[ChannelResiduals]], candidates: Sequence[Candidate]
) -> Selection:
    """The selection fitted anew in a Table about its own values, with the columns of `candidates`, where it is not as linear
    as the Table that it was found in says: positions of anchors that are far off are not."""
    for _ in range(ROUNDS):
        model = effects_of(selection)
        current, table = at(model), selection.table
        y, limit = _linearised(current, (), model).y, LINEARITY_LIMIT * selection.fit.scale[table.group]
        if len(y) == len(table.y) and np.mean(((y - table.y) / limit) ** 2) <= 1.0:
            break
        table = _linearised(current, [*candidates, *selection.chosen], model)
        refitted = fit(table, columns_of(selection.chosen), selection.fit.inflation)
        selection = replace(selection, table=table, fit=refitted)
    return selection


def _with_smooth(
    selection: Selection, unmoved: Table, declared: Sequence[Candidate], smooth: Sequence[Candidate], search: Search,
    scan_of: Callable[[Table], Scan], progress: Callable[[], object],
) -> Selection:  # fmt: skip
    """The selection carried on with functions without a name; or begun anew with them in the Table `unmoved`, about nothing, if
    that explains more: the declared effect, or the large group of parameters, was a stopgap."""
    everything = [*smooth, *declared]
    terms = [term for candidate in smooth for term in candidate.terms]
    table = selection.table.with_terms(terms)
    progress()
    inflation = selection.fit.inflation
    after = select(table, everything, inflation, search, scan_of(table), selection.chosen, progress)
    if selection.chosen:
        anew = select(unmoved.with_terms(terms), everything, inflation, search, scan_of(unmoved), progress=progress)
        after = _simpler(after, anew, len(everything))
    return after


def _simpler(after: Selection, anew: Selection, choices: int) -> Selection:
    """Of two Selections the one that is worth more; or, if they tell of other things, the one with fewer parameters where it is hardly
    worth less: how far a function is off grows with its size, and many parameters can be anything."""
    fewer, more = sorted((after, anew), key=lambda each: len(each.fit.beta))
    nothing = fit(after.table, [], after.fit.inflation).likelihood(after.table)
    least, most = (worth(each, choices) - nothing for each in (fewer, more))
    same = {candidate.label for candidate in after.chosen} == {candidate.label for candidate in anew.chosen}
    return fewer if least >= most * (1.0 if same else 1.0 - SAME_STORY) else more


def _with_maps(selection: Selection, smooth: Sequence[Candidate], refused: list[Refused]) -> Selection:
    """Add functions of the place for every anchor, each too weak alone, if together they are plainly worth it on data that
    they were not fitted to."""
    taken = {term.effect.identity for candidate in selection.chosen for term in candidate.terms}
    for channel in CHANNELS.values():
        terms: dict[Hashable, Term] = {}
        for candidate in smooth:  # the first of a function is that of all anchors
            term = candidate.terms[0]
            function = term.function if channel.name in candidate.channels else None
            if function and function.form == "anchor" and function.covariate in channel.maps:
                terms.setdefault(term.effect.identity, term)
        maps = Candidate(tuple(term for identity, term in terms.items() if identity not in taken))
        if not maps.terms:
            continue
        trial = selection.plus(maps)
        scores = [held_out(trial)[-1]]
        if selection.table.flights >= 3:
            scores.append(held_out(trial, by_flight=True)[-1])
        if min(score.gain for score in scores) > MAPS_GAIN and min(score.t for score in scores) > MAPS_SURE:
            selection = trial
        elif min(scores).gain > 0.0:
            worth_it = 0.5 * min(scores).gain
            refused.append(Refused(maps.label, f"does not help held-out data enough (log-likelihood {worth_it:.1f})"))
    return selection


def _that_hold_on_other_data(selection: Selection, refused: list[Refused]) -> Selection:
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
    return not any(key.endswith((".start", ".end")) for term in candidate.terms for key in term.effect.values)


def _findings(selection: Selection, candidates: Sequence[Candidate], names: Sequence[str]) -> list[EffectFinding]:
    effects = {_merged_as(effect): effect for effect in effects_of(selection)}
    out: dict[Hashable, EffectFinding] = {}
    for candidate, score, loss in zip(selection.chosen, held_out(selection), selection.loss):
        evidence = {
            "criterion": round(float(loss), 1),
            "held_out_gain": round(score.gain, 1),
            "held_out_t": round(score.t, 1),
        }
        others = tuple(alternatives(selection, candidate, candidates))
        for term in candidate.terms:
            identity = _merged_as(term.effect)
            beside = [other.function for other in candidate.terms if other is not term] if term.function else []
            covariates = tuple(function.covariate for function in beside if function)
            finding = EffectFinding(
                effects[identity], candidate.channels[0], evidence, score.explained, others, (candidate,),
                together_with=covariates, shares=shares(selection, candidate, names),
            )  # fmt: skip
            out[identity] = _merged(out[identity], finding) if identity in out else finding
    return list(out.values())


def _merged(finding: EffectFinding, other: EffectFinding) -> EffectFinding:
    """One EffectFinding of two of one effect."""
    evidence = {key: round(finding.evidence[key] + other.evidence[key], 1) for key in other.evidence}
    named = {alternative.effect for alternative in finding.alternatives}
    more = tuple(alternative for alternative in other.alternatives if alternative.effect not in named)
    return replace(
        finding,
        evidence=evidence,
        explained=max(finding.explained, other.explained),
        alternatives=(*finding.alternatives, *more),
        candidates=(*finding.candidates, *other.candidates),
    )


def _of_detection(detection: Detection) -> EffectFinding:
    return EffectFinding(detection.effect, detection.channel, detection.evidence, 0.0)
