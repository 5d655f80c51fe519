"""Validate effects: run the filter with and without them, on data that they were not fitted to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial, reduce
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector, FixedPoseCorrector
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.frames import poses_of
from uwb_tdoa_ekf.offline import run_offline

from ..scoring.metrics import EVERYTHING
from .comparison import Baseline, ValidationCase, score
from .decision import LEAST_WORTH, decide, products
from .deviations import with_deviations
from .findings import Refused, usable
from .refinement import effects_of, recurs
from .regression.fit import refit
from .regression.select import Selection
from .regression.table import BLOCK
from .regression.terms import Candidate, columns_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from uwb_tdoa_bias.common.flight import Flight
    from uwb_tdoa_ekf.core.config import FilterConfig

    from ..parallel import MapFunction
    from .attribution import Attribution
    from .decision import Decision
    from .detectors import Detection

    Part = Candidate | Detection

TRIED = 5  # largest number of flights in trials
CANCELS = 0.7  # smallest negative correlation of two contributions that cancel
# shapes of a function of the time that can recur, like the warm-up of a clock
DRIFTS = ("line", "beyond", "below", "parabola")
SELECTED_ON = ", chosen on all of them (--holdout judges the choice too)"
HELD_OUT = "flights that took no part in the fit"
MOMENTARY = "it happened at a time of this flight, and another flight does not have it"


@dataclass(frozen=True, eq=False)
class ValidatedSelection:
    """The effects that the rule of `decision` applies, with their shares.

    refused : (Refused, ...) of the others
    worth : {candidate or detection: increase of the mean 3D RMSE without it, m}
    decision : Decision on all; None if nothing is applied
    """

    selection: Selection
    detections: tuple[Detection, ...]
    refused: tuple[Refused, ...]
    worth: dict[Part, float]
    decision: Decision | None = None

    def applied(self, attribution: Attribution) -> Attribution:
        """Return the Attribution with the selected effects only."""
        return replace(
            attribution,
            selection=with_deviations(self.selection),
            detections=self.detections,
            alone=(),
        )


class Fold(NamedTuple):
    """A part of the data that is judged with effects fitted to the rest.

    case : ValidationCase of the part, with the effects of the base
    rows : (n,) bool, rows of the RegressionTable in the rest; fitted : numbers of its flights
    """

    case: ValidationCase
    rows: np.ndarray
    fitted: Sequence[int]

    def effects(
        self, attribution: Attribution, candidates: Sequence[Candidate], parts: Sequence[Part]
    ) -> EffectSet:
        """Return the EffectSet of some parts of a model, with values fitted to the rest.

        candidates : all Candidates of the model; parts : those that count, and Detections
        """
        selection = attribution.selection
        chosen = tuple(part for part in parts if isinstance(part, Candidate))
        model = refit(selection.table, columns_of(candidates), selection.fit, self.rows)
        found = effects_of(replace(selection, chosen=chosen, fit=model))
        detected = [part.effect for part in parts if not isinstance(part, Candidate)]
        of_nodes = usable([*found, *detected]).effects
        return EffectSet((*self.case.effects, *attribution.seen.limited(of_nodes, self.fitted)))


def folds(attribution: Attribution, flights: Sequence[Flight], base: EffectSet) -> list[Fold]:
    """Return one Fold per flight; of a single flight, two of alternating blocks."""
    table = attribution.selection.table
    if len(flights) > 1:
        return [
            Fold(
                ValidationCase(flight, base),
                table.flight != k,
                [other for other in range(len(flights)) if other != k],
            )
            for k, flight in enumerate(flights)
        ]
    # alternating, so both parts cover the whole flight
    start, since = flights[0].start, table.t - table.t.min()
    length = min(BLOCK, 0.5 * since.max())
    number = np.minimum((since / length).astype(int), int(since.max() / length) - 1)
    edges = start + table.t.min() + length * np.arange(number.max() + 2)
    edges[-1] = start + table.t.max()
    spans = list(zip(edges[:-1].tolist(), edges[1:].tolist()))
    reach = (
        [(-np.inf, spans[0][1]), *spans[1:-1], (spans[-1][0], np.inf)]
        if len(spans) > 1
        else EVERYTHING
    )
    halves = [
        ValidationCase(flights[0], base, tuple(spans[k::2]), tuple(reach[k::2])) for k in range(2)
    ]
    return [Fold(half, number % 2 != k, [0]) for k, half in enumerate(halves)]


def cross_fitted(
    attribution: Attribution,
    flights: Sequence[Flight],
    base: EffectSet,
    candidates: Sequence[Candidate],
    detections: Sequence[Detection],
) -> list[ValidationCase]:
    """Return the ValidationCases of all folds, with effects fitted to the rest."""
    parts: tuple[Part, ...] = (*candidates, *detections)
    return [
        replace(fold.case, effects=fold.effects(attribution, candidates, parts))
        for fold in folds(attribution, flights, base)
    ]


def select_by_error(
    attribution: Attribution,
    flights: Sequence[Flight],
    baseline: Baseline,
    progress: Callable[[], object] = lambda: None,
    map_function: MapFunction = map,
) -> ValidatedSelection:
    """Return the ValidatedSelection: the rule of `decision` on flights that took no part in the fit.

    The filter runs with all effects and without each, on at most TRIED flights. The differences are
    the displacements that `decide` judges. The other effects are fitted again without the dropped
    ones. Events at a time of a single flight are dropped.

    map_function : as of `attribute`
    """
    selection = attribution.selection
    parts = _parts(attribution)
    if not parts:
        return ValidatedSelection(selection, (), (), {})
    at_a_time = np.array([len(flights) == 1 and _is_momentary(part) for part in parts])
    tried = _products(attribution, flights, baseline, parts, progress, map_function)
    decision = decide(tried, ~at_a_time)
    shares = dict(zip(parts, decision.shares.tolist()))
    worth = dict(zip(parts, decision.worth.tolist()))
    refused = [
        Refused(_label(part), MOMENTARY if momentary else _why_not(worth[part]))
        for part, momentary in zip(parts, at_a_time)
        if not shares[part]
    ]
    # with the weights of the trials: otherwise the dropped effects make outliers of their data
    kept = selection.kept([part for part in selection.chosen if shares.get(part, 1.0)])
    kept = replace(kept, shares={part: shares[part] for part in kept.chosen if part in shares})
    detections = tuple(one for one in attribution.detections if shares.get(one))
    applied = decision if decision.shares.any() else None
    return ValidatedSelection(kept, detections, tuple(refused), worth, applied)


def _parts(attribution: Attribution) -> list[Part]:
    """Return the parts of a model that a node can correct, at least in part."""
    return [
        *(
            candidate
            for candidate in attribution.selection.chosen
            if any(term.effect.usable for term in candidate.terms)
        ),
        *(one for one in attribution.detections if one.effect.usable),
    ]


def _cancelled(selection: Selection) -> list[Candidate]:
    """Return the chosen Candidates whose contribution another one cancels in the fitted rows."""
    table, model = selection.table, selection.fit
    root = np.sqrt(model.information(table))
    x = [
        root * (table.matrix(candidate.columns) @ model.values(candidate.columns))
        for candidate in selection.chosen
    ]
    unit = [one / max(float(np.linalg.norm(one)), 1e-12) for one in x]
    return [
        candidate
        for candidate, one in zip(selection.chosen, unit)
        if any(one @ other < -CANCELS for other in unit)
    ]


def _products(
    attribution: Attribution,
    flights: Sequence[Flight],
    baseline: Baseline,
    parts: Sequence[Part],
    progress: Callable[[], object],
    map_function: MapFunction,
) -> list[np.ndarray]:
    """Return the `products` of each tried flight, (k + 2, k + 2), that `decide` needs.

    Without one of two effects that cancel, the filter would reject the measurements of the other.
    So the others are fitted again without it.

    parts : k parts of the model that are tried
    """
    candidates = attribution.selection.chosen
    cancelled = _cancelled(attribution.selection)
    models: list[tuple[Sequence[Candidate], Sequence[Part]]] = [
        (candidates, parts),
        (candidates, []),
    ]
    for part in parts:
        fitted = [one for one in candidates if one is not part or part not in cancelled]
        models.append((fitted, [one for one in parts if one is not part]))
    several = folds(attribution, flights, baseline.base)
    trials = [
        (fold.case, [fold.effects(attribution, *model) for model in models])
        for fold in several[:: -(-len(several) // TRIED)]
    ]
    out = []
    for found in map_function(partial(_of_trial, baseline.config), trials):
        out.append(found)
        progress()
    return [np.mean(out, axis=0)] if len(flights) == 1 else out


def _of_trial(
    config: FilterConfig | None, trial: tuple[ValidationCase, Sequence[EffectSet]]
) -> np.ndarray:
    """Return the `products` of one case.

    trial : ValidationCase; EffectSets: all effects, none, and all without each. The first two
        run like the nodes. The others use the poses of the first run, which takes a tenth of the
        time.
    """
    case, models = trial
    anchors, scores = case.flight.anchors, []
    poses: Sequence[np.ndarray] = ()
    for place, effects in enumerate(models):
        corrector = Corrector(anchors, effects)
        if place > 1:
            corrector = FixedPoseCorrector(anchors, effects, poses)
        run = run_offline(case.flight, config, corrector)
        if place == 0:
            poses = poses_of(run.odometry)
        scores.append(score(replace(case, effects=effects), run))
    t = reduce(np.intersect1d, [one.t for one in scores])
    first, *others = (one.error[np.searchsorted(one.t, t)] for one in scores)
    change, *displacements = (other - first for other in others)
    return products(first, displacements, change)


def _label(part: Part) -> str:
    return part.label if isinstance(part, Candidate) else part.effect.label


def _why_not(worth: float) -> str:
    """Return why an effect is not applied, given its worth in the flights that took no part, m."""
    if worth < -LEAST_WORTH:
        return f"with it the error of hold-out flights rises by {-100.0 * worth:.1f} cm"
    if worth < LEAST_WORTH:
        return "it is worth nothing for the position of hold-out flights"
    return "too little of it is seen again in hold-out flights"


def _is_momentary(part: Part) -> bool:
    """Return whether a part is an event at a time of one flight.

    It is a temporary delay, or a function of the time that is not a drift.
    """
    if not isinstance(part, Candidate):
        return False
    functions = [term.function for term in part.terms if term.function]
    return not recurs(part) or any(
        one.covariate == "time" and one.shape not in DRIFTS for one in functions
    )


def validation_cases(
    attribution: Attribution,
    flights: Sequence[Flight],
    holdout: Sequence[Flight],
    base: EffectSet,
    effects: EffectSet,
) -> tuple[list[ValidationCase], str]:
    """Return the cases that validate an Attribution, and a description of the data.

    They are the hold-out Flights, or without any, cross-fitted cases of the fitted flights.

    base : EffectSet before; effects : EffectSet with the found effects
    """
    if holdout:
        return [ValidationCase(flight, effects) for flight in holdout], HELD_OUT
    on = "each half of the flight, every other 5 s, with effects fitted to the other"
    if len(flights) > 1:
        on = "each flight with effects fitted to the others"
    cases = cross_fitted(
        attribution, flights, base, attribution.selection.chosen, attribution.detections
    )
    return cases, on + SELECTED_ON
