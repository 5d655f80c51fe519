# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Attribute residuals of flights to effects, with values, uncertainty and alternatives."""

from __future__ import annotations

from collections.abc import Callable, Collection, Hashable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import SENSOR_NAMES, Flight
from uwb_tdoa_bias.effects import EFFECTS, Covariance, Effect, EffectSet
from uwb_tdoa_bias.effects.samples import RADIO, UPWARDS
from uwb_tdoa_ekf.evidence import OF_ANCHORS

from ..parallel import MapFunction
from .channels import CHANNELS, ChannelResiduals, residuals
from .channels.base import Seen
from .channels.views import MOST_LINKS
from .detectors import DETECTORS, Detection, Detector
from .deviations import with_deviations
from .findings import EffectFinding, Refused
from .over_flights import of_one, shares
from .references import Reference
from .refinement import (
    ROUNDS,
    cross_validated,
    effects_of,
    entry_of,
    inflation_of,
    linearised,
    maps_of,
    relinearised,
    with_fewer_pairs,
    with_maps,
    with_measured_noise,
    with_smooth,
)
from .regression.confounding import alternatives, levels
from .regression.fit import Fit, fit, in_common, prior_sizes
from .regression.held_out import held_out
from .regression.products import FOR_MAPS
from .regression.scan import Scan
from .regression.select import Rival, Search, Selection, select, with_rivals
from .regression.table import RegressionTable, table_of
from .regression.terms import Candidate, candidates_of, columns_of
from .self_calibration.prior import to_keep

ON_FLOOR = 0.5  # m, smallest change of a reported function of UPWARDS near the floor
RANGED = tuple(
    name for name, kind in RADIO.items() if kind.ends == 1
)  # names of streams of distances to anchors


@dataclass(frozen=True, eq=False)
class Attribution:
    """The effects that explain the residuals of some flights.

    residuals : [{channel: ChannelResidual}] under the base model, one per flight
    selection : Selection; detections : (Detection, ...); candidates : all declared Candidates
    refused : (Refused, ...); names : of the flights
    alone : ((name of a flight, Selection), ...), effects in one flight only
    floor : Selection near the floor, beyond effects in the air; None without data there
    floor_names : names of the flights with data near the floor
    """

    residuals: list[ChannelResiduals]
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
        """Return the ranges of covariates in the residuals."""
        return Seen(self.residuals)

    @property
    def effects(self) -> tuple[Effect, ...]:
        """Return all found Effects that can be corrected."""
        in_the_air = self.seen.limited(
            (*effects_of(self.selection), *(detection.effect for detection in self.detections))
        )
        return (*in_the_air, *self.of_floor)

    @property
    def of_floor(self) -> tuple[Effect, ...]:
        """Return the Effects near the floor that the filter may use.

        Functions without a name are left out, because they would also act in the air.
        """
        return (
            effects_of(self.floor.where(lambda effect: effect.is_hypothesis)) if self.floor else ()
        )

    @property
    def covariance(self) -> Covariance | None:
        """Return the Covariance of selected positions and delays of anchors; None without any.

        It is the prior of the next calibration.
        """
        columns = [
            column
            for candidate in self.selection.chosen
            if candidate.name in OF_ANCHORS
            for column in candidate.columns
        ]
        if not columns:
            return None
        places = [self.selection.fit.columns.index(column) for column in columns]
        covariance = self.selection.fit.cov[np.ix_(places, places)]
        covariance = (
            covariance + in_common(self.selection.table, columns) * prior_sizes(columns) ** 2.0
        )  # the data do not determine common means
        return to_keep(tuple((str(column.effect[0]), column.key) for column in columns), covariance)

    def findings(self) -> list[EffectFinding]:
        """Return the EffectFindings.

        The order is: from regression, from detectors, near the floor, in single flights.
        """
        out = _findings(self.selection, self.candidates, self.names)
        out += [
            EffectFinding(one.effect, one.channel, one.evidence, 0.0) for one in self.detections
        ]
        if self.floor:
            written = {entry_of(effect): effect for effect in self.of_floor}
            near = _findings(self.floor, [], self.floor_names)
            out += [
                replace(one, effect=written.get(entry_of(one.effect), one.effect), on_floor=True)
                for one in near
            ]
        for name, selection in self.alone:
            out += [replace(finding, flight=name) for finding in _findings(selection, [], (name,))]
        return out


def attribute(
    flights: Sequence[Flight],
    reference: Reference,
    base: EffectSet = EffectSet(),
    kinds: Collection[str] | None = None,
    undeclared: bool = True,
    progress: Callable[[], object] = lambda: None,
    map_function: MapFunction = map,
) -> Attribution:
    """Attribute the residuals of prepared Flights to effects beyond `base`.

    Parameters
    ----------
    flights : sequence of Flight
        Flights after `Reference.prepare`.
    reference : Reference
    base : EffectSet
        Effects in the model.
    kinds : names, optional
        Declared effects to search for; all by default.
    undeclared : bool
        Whether to search for functions without a name too.
    progress : function
        It is called every few seconds.
    map_function : function
        Like map(function, items), possibly in parallel processes.
    """
    search = EffectSearch(flights, reference, base, kinds, undeclared, progress, map_function)
    return search.reported(search.found())


class _ModelResiduals:
    """The residuals of Flights under models.

    Those of the last and of the empty model are kept. If the path is unknown, computing them runs
    the filter.
    """

    def __init__(
        self,
        flights: Sequence[Flight],
        reference: Reference,
        base: EffectSet,
        progress: Callable[[], object],
        map_function: MapFunction,
    ) -> None:
        """Take the arguments of `attribute`."""
        self.flights = flights
        self.reference = reference
        self.progress = progress
        self._base = base
        self._map_function = map_function
        self._known: list[tuple[tuple[Effect, ...], list[ChannelResiduals]]] = []

    def __call__(self, model: Sequence[Effect]) -> list[ChannelResiduals]:
        """Return the residuals under a model, one dict per flight. The first model is empty."""
        for other, made in self._known:
            if other == tuple(model):
                return made
        effects = EffectSet((*self._base.effects, *model))
        made = residuals_of(
            self.flights, self.reference, effects, self.progress, self._map_function
        )
        self._known[1:] = [(tuple(model), made)]
        return made


class EffectSearch:
    """The search for effects in the residuals of some flights, in steps.

    under_base : residuals under the base model; declared : Candidates of declared effects
    inflation : (groups,) variance inflation of the noise
    """

    def __init__(
        self,
        flights: Sequence[Flight],
        reference: Reference,
        base: EffectSet = EffectSet(),
        kinds: Collection[str] | None = None,
        undeclared: bool = True,
        progress: Callable[[], object] = lambda: None,
        map_function: MapFunction = map,
    ) -> None:
        """Measure the noise, with the arguments of `attribute`."""
        self.residuals = _ModelResiduals(flights, reference, base, progress, map_function)
        self.progress = progress
        self._map_function = map_function
        self._undeclared = undeclared
        self._left_out: frozenset[str] = frozenset()
        self.names = tuple(flight.name for flight in flights)
        self.under_base = self.residuals(())
        self._current = self.under_base
        shown = {name for flight in self.under_base for name in flight}
        self._detectors = [
            detector
            for name, detector in DETECTORS.items()
            if (kinds is None or name in kinds) and shown & set(detector.effect.channels)
        ]
        self._installation = _installation(flights)
        self.declared = _declared(self.under_base, reference, kinds, self._installation)
        self._unmoved = linearised(self.under_base, self.declared, ())
        first = [detector for detector in self._in_the_air if detector.searched_first]
        self.inflation = inflation_of(self._unmoved, self.declared, partial(_search, first))
        self._scans: dict[int, Scan] = {}
        self.progress()

    def without(self, names: Collection[str]) -> EffectSearch:
        """Return the search without some declared effects, with the same measured noise."""
        fewer = copy(self)
        fewer._left_out = self._left_out.union(names)
        fewer.declared = [one for one in self.declared if one.name not in names]
        fewer._detectors = [one for one in self._detectors if one.effect.name not in names]
        return fewer

    def found(
        self, start: Attribution | None = None, own: Collection[Candidate] = ()
    ) -> Attribution:
        """Return the Attribution with what it needs to validate effects.

        start : Attribution of an earlier search. The search goes on from those of its effects that
            this search may find. By default it begins with none.
        own : its Candidates of these flights alone, from which the search goes on in any case
        """
        refused: list[Refused] = []
        if start is None:
            selection = self._validated(self._named(), refused)
            if self._undeclared:
                selection = self._validated(self._with_functions(selection), refused)
        else:
            refused += start.refused
            selection = self._validated(self._resumed(start.selection, own), refused)
        if self._undeclared and len(self.names) >= FOR_MAPS:
            selection = with_maps(selection, self._smooth)
        labels = {one.label for one in selection.chosen}
        refused = [one for one in refused if one.what not in labels]
        return Attribution(
            self.under_base,
            with_deviations(selection),
            self._detections(selection),
            self.declared,
            tuple(refused),
            self.names,
        )

    def reported(self, found: Attribution) -> Attribution:
        """Return an Attribution of this search with all that a report shows.

        Added are rivals of effects, effects in one flight only, and effects near the floor.
        """
        scan = self._scan_of(found.selection.table) if self._undeclared else None
        everything = self.declared + self._smooth
        selection = with_rivals(found.selection, everything, scan, self.progress)
        remaining = self.residuals(effects_of(selection))
        alone: tuple[tuple[str, Selection], ...] = ()
        positions_known = all(self.residuals.reference.positions_known)
        if self._undeclared and len(self.names) > 1 and positions_known:
            own = of_one(remaining, self.inflation, self.search, self._map_function)
            alone = tuple((self.names[k], of_flight) for k, of_flight in own)
        near = [(name, part) for name, part in zip(self.names, map(near_floor, remaining)) if part]
        floor, refused = None, list(found.refused)
        if near:
            detectors = [one for one in self._detectors if one.on_floor]
            parts = [part for _, part in near]
            floor = on_floor(parts, detectors, self._undeclared, refused, self.progress)
        return replace(
            found,
            selection=selection,
            refused=tuple(refused),
            alone=alone,
            floor=floor,
            floor_names=tuple(name for name, _ in near),
        )

    @property
    def search(self) -> Search:
        """Return the search of the detectors."""
        return partial(_search, self._in_the_air)

    @property
    def _in_the_air(self) -> list[Detector]:
        """Return the detectors of effects that do not need the floor."""
        return [one for one in self._detectors if not one.on_floor]

    @cached_property
    def _smooth(self) -> list[Candidate]:
        """Return the Candidates of functions without a name, if such are searched."""
        return _smooth(self._current, self._installation) if self._undeclared else []

    def _validated(self, selection: Selection, refused: list[Refused]) -> Selection:
        """Return the Selection with fewer pairs, and without Candidates that hold-out rows refuse."""
        return cross_validated(with_fewer_pairs(selection, self.declared), refused)

    def _named(self) -> Selection:
        """Select declared effects, ROUNDS times, each time linearized at the values found before."""
        table = self._unmoved
        for step in range(ROUNDS):
            selection = select(
                table, self.declared, self.inflation, self.search, progress=self.progress
            )
            found = effects_of(selection)
            if not found or step == ROUNDS - 1:
                break
            self._current = self.residuals(found)
            self.progress()
            table = linearised(self._current, self.declared, found)
        return selection

    def _with_functions(self, selection: Selection) -> Selection:
        """Return the Selection after a search that includes functions without a name."""
        scan = self._scan_of(selection.table)
        selection = with_measured_noise(selection, self.declared, scan, self.progress)
        selection = with_smooth(
            selection,
            self._unmoved,
            self.declared,
            self._smooth,
            self.search,
            self._scan_of,
            self.progress,
        )
        return relinearised(selection, self.residuals, self.declared + self._smooth)

    def _resumed(self, start: Selection, own: Collection[Candidate]) -> Selection:
        """Return the Selection after one more search, from those effects that it may find.

        start : Selection of an earlier search for more effects; own : as of `found`
        """
        kept = [one for one in start.chosen if one in own or one.name not in self._left_out]
        scan = self._scan_of(start.table) if self._undeclared else None
        everything, inflation = [*self._smooth, *self.declared], start.fit.inflation
        selection = select(
            start.table, everything, inflation, self.search, scan, kept, self.progress
        )
        return relinearised(selection, self.residuals, self.declared + self._smooth)

    def _detections(self, selection: Selection) -> tuple[Detection, ...]:
        """Return what the detectors find in the residuals under a Selection."""
        remaining = self.residuals(effects_of(selection))
        detected = (detector.detect(remaining) for detector in self._in_the_air)
        return tuple(detection for detection in detected if detection is not None)

    def _scan_of(self, table: RegressionTable) -> Scan:
        """Return the Scan of a table, one per number of rows: stamp offsets change the number."""
        if len(table.y) not in self._scans:
            self._scans[len(table.y)] = Scan(table, table.views())
        return self._scans[len(table.y)]


def first_fit(
    flights: Sequence[Flight], reference: Reference, base: EffectSet = EffectSet()
) -> Attribution:
    """Fit positions and delays of all anchors without a search; of several flights maps too.

    That takes seconds where `attribute` takes a minute. What it gains on data that it is not fitted
    to forecasts the gain of a diagnosis.

    flights : prepared Flights; base : EffectSet in the model
    """
    others = [name for name in ("imu", *SENSOR_NAMES) if name not in RADIO]
    found = residuals_of([flight.without(*others) for flight in flights], reference, base)
    installation = _installation(flights)
    declared = _declared(found, reference, OF_ANCHORS, installation)
    whole = {candidate.name: candidate for candidate in reversed(declared)}
    # A map of a single flight depends on its path.
    maps = maps_of(_smooth(found, installation)) if len(flights) > 1 else []
    chosen = (*whole.values(), *maps)
    table = linearised(found, chosen, ())
    empty: tuple[tuple[Rival, ...], ...] = ((),) * len(chosen)
    selection = Selection(
        table, chosen, fit(table, columns_of(chosen)), (np.nan,) * len(chosen), empty
    )
    return Attribution(found, selection, (), declared, (), tuple(flight.name for flight in flights))


def near_floor(residuals: ChannelResiduals) -> ChannelResiduals:
    """Return the residuals of a flight near the floor, by channel; {} without any."""
    parts = {name: part.of_floor() for name, part in residuals.items()}
    return {name: part for name, part in parts.items() if part is not None}


def on_floor(
    residuals: Sequence[ChannelResiduals],
    detectors: Sequence[Detector],
    undeclared: bool,
    refused: list[Refused],
    progress: Callable[[], object] = lambda: None,
) -> Selection:
    """Select effects near the floor: declared effects, else functions of the height.

    Only functions of the height are tried, because take-off and landing at one place do not
    distinguish other covariates. These few seconds are fitted separately, because their errors are
    metres. In a common fit they would count as outliers, or bias effects in the air.

    residuals : [{channel: ChannelResidual}] near the floor
    """
    table = table_of(residuals)
    found = select(
        table,
        [],
        inflation_of(table, [], partial(_search, detectors)),
        partial(_search, detectors),
        progress=progress,
    )
    if undeclared and not found.chosen:
        views = {
            name: [view for view in views if view.covariate in UPWARDS]
            for name, views in table.views().items()
        }
        scan = Scan(table, views)
        inflation = inflation_of(table, [], lambda *fitted: scan(*fitted)[:1])
        found = select(table, [], inflation, scan=scan, progress=progress)
        # A smaller contribution can depend on the place, and a few seconds do not determine that.
        found = found.only(
            [
                one
                for one in found.chosen
                if np.ptp(found.table.matrix(one.columns) @ found.fit.values(one.columns))
                > ON_FLOOR
            ]
        )
    return cross_validated(found, refused)


def residuals_of(
    flights: Sequence[Flight],
    reference: Reference,
    effects: EffectSet,
    progress: Callable[[], object] = lambda: None,
    map_function: MapFunction = map,
) -> list[ChannelResiduals]:
    """Return the residuals of each Flight, as of `channels.residuals`.

    progress, map_function : as of `attribute`
    """
    if not all(reference.positions_known):
        # sending these residuals between processes takes longer than computing them
        map_function = map
    out = []
    for of_flight in map_function(
        partial(residuals, reference=reference, effects=effects), flights
    ):
        out.append(of_flight)
        progress()
    return out


def _search(
    detectors: Sequence[Detector], table: RegressionTable, model: Fit, chosen: Sequence[Candidate]
) -> list[Candidate]:
    return [
        candidate for detector in detectors for candidate in detector.search(table, model, chosen)
    ]


def _installation(flights: Sequence[Flight]) -> tuple[Anchors, np.ndarray]:
    """Return the Anchors of all flights, and the MOST_LINKS most frequent pairs of ids, (m, 2).

    An anchor that moved between flights has its first position.
    """
    several = [flight.anchors for flight in flights]
    ids, positions, orientations = (
        np.concatenate([getattr(anchors, name) for anchors in several])
        for name in ("ids", "positions", "orientations")
    )
    heard = np.concatenate([np.column_stack([flight.tdoa.a, flight.tdoa.b]) for flight in flights])
    heard = heard[np.isin(heard, ids).all(axis=1) & (heard[:, 0] != heard[:, 1])]
    pairs, count = np.unique(heard, axis=0, return_counts=True)
    first = np.unique(ids, return_index=True)[1]
    ranged = [
        stream.anchor
        for flight in flights
        for name in RANGED
        if (stream := getattr(flight, name)) is not None
    ]
    alone = np.concatenate([heard.ravel(), *ranged])
    first = first[np.isin(ids[first], alone)] if len(alone) else first
    anchors = Anchors(ids[first], positions[first], orientations[first], several[0].frame)
    return anchors, pairs[np.argsort(-count, kind="stable")[:MOST_LINKS]]


def _declared(
    found: Sequence[ChannelResiduals],
    reference: Reference,
    kinds: Collection[str] | None,
    installation: tuple[Anchors, np.ndarray],
) -> list[Candidate]:
    """Return Candidates of declared effects that the channels and the reference can show.

    installation : Anchors, and pairs (m, 2)
    """
    shown = {name for flight in found for name in flight}
    effects = [
        effect for effect in EFFECTS.values() if effect.fitted and shown & set(effect.channels)
    ]
    chosen = [
        effect
        for effect in effects
        if (kinds is None or effect.name in kinds)
        and (all(reference.positions_known) or not effect.needs_reference)
        and (not effect.corroborating_channels or shown & set(effect.corroborating_channels))
    ]
    return [candidate for effect in chosen for candidate in candidates_of(effect(), *installation)]


def _smooth(
    found: Sequence[ChannelResiduals], installation: tuple[Anchors, np.ndarray]
) -> list[Candidate]:
    """Return Candidates of functions of the covariates of each channel.

    A function is common to all anchors, or each anchor has its function.
    """
    out = []
    for name, channel in CHANNELS.items():
        parts = [flight[name] for flight in found if name in flight]
        for term in channel.smooth_terms(parts) if parts else ():
            out += candidates_of(term, *installation)[:1]
    return out


def _findings(
    selection: Selection, candidates: Sequence[Candidate], names: Sequence[str]
) -> list[EffectFinding]:
    effects = {entry_of(effect): effect for effect in effects_of(selection)}
    out: dict[Hashable, EffectFinding] = {}
    of_anchors = levels(selection, candidates)
    rows = zip(selection.chosen, held_out(selection), selection.loss, selection.shared)
    for candidate, score, loss, shared in rows:
        evidence = {
            "criterion": round(float(loss), 1),
            "held_out_gain": round(score.gain, 1),
            "held_out_t": round(score.t, 1),
        }
        others = tuple(alternatives(selection, candidate, candidates))
        for term in candidate.terms:
            identity = entry_of(term.effect)
            effect, n = effects[identity], 1 + len(shared)
            values, std = (
                {k: n * x for k, x in each.items()} for each in (effect.values, effect.std)
            )
            beside = (
                [other.function for other in candidate.terms if other is not term]
                if term.function
                else []
            )
            covariates = tuple(function.covariate for function in beside if function)
            finding = EffectFinding(
                replace(effect, values=values, std=std),
                next(name for name in candidate.channels if name in selection.table.present),
                evidence,
                score.explained,
                others,
                (candidate,),
                together_with=covariates,
                shares=shares(selection, candidate, names),
                levels={
                    anchor: of_anchors.pop(anchor)
                    for anchor in [*of_anchors] * bool(term.function)
                    if any(key.startswith(f"{anchor}.") for key in term.keys)
                },
            )
            out[identity] = _merged(out[identity], finding) if identity in out else finding
    return list(out.values())


def _merged(finding: EffectFinding, other: EffectFinding) -> EffectFinding:
    """Return one EffectFinding of two of the same effect; their gains are taken as independent."""
    evidence = {
        key: round(finding.evidence[key] + other.evidence[key], 1)
        for key in ("criterion", "held_out_gain")
    }
    pair = finding.evidence, other.evidence
    stds = [one["held_out_gain"] / one["held_out_t"] for one in pair if one["held_out_t"]]
    std = float(np.hypot.reduce(stds)) if stds else 0.0
    evidence["held_out_t"] = round(evidence["held_out_gain"] / std, 1) if std else 0.0
    named = {alternative.effect for alternative in finding.alternatives}
    more = tuple(
        alternative for alternative in other.alternatives if alternative.effect not in named
    )
    return replace(
        finding,
        evidence=evidence,
        explained=max(finding.explained, other.explained),
        alternatives=(*finding.alternatives, *more),
        candidates=(*finding.candidates, *other.candidates),
        levels=finding.levels | other.levels,
    )
