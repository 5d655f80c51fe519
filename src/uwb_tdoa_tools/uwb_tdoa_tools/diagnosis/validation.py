# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Validate effects: run the filter with and without them, on data that they were not fitted to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import chain, cycle
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector, FixedPoseCorrector
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.results import poses_of

from ..scoring.metrics import EVERYTHING
from .comparison import Baseline, ValidationCase, score
from .deviations import with_deviations
from .findings import Refused, usable
from .refinement import effects_of, recurs
from .regression.fit import refit
from .regression.select import Selection
from .regression.table import BLOCK
from .regression.terms import columns_of

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from uwb_tdoa_bias.common.flight import Flight
    from uwb_tdoa_ekf.core.config import FilterConfig
    from uwb_tdoa_ekf.offline import Run

    from ..parallel import MapFunction
    from .attribution import Attribution
    from .comparison import KnownRuns
    from .detectors import Detection
    from .regression.terms import Candidate

    Model = tuple[Sequence[Candidate], Sequence[Detection]]
    Poses = tuple[np.ndarray, ...]  # return value of `poses_of`

Made = TypeVar("Made")

TRIAL_FLIGHTS = 3  # largest number of flights, or halves of one, in trials
# shapes of a function of the time that can recur, like the warm-up of a clock
DRIFTS = ("line", "beyond", "below", "parabola")
# An effect is dropped if the error falls by at least this share without it.
WORSE = 0.005
# In a single flight an effect stays only if the error grows by this share without it, because
# flights differ.
WORTH_OF_ONE = 0.05
# m, and share of the error: with a smaller worth an effect is not written, as it rounds to nothing.
LEAST_WORTH, LEAST_SHARE = 0.0005, 0.005
SELECTED_ON = ", chosen on all of them (--holdout judges the choice too)"
HELD_OUT = "flights that took no part in the fit"
SECOND = "give a second flight with this one"


@dataclass(frozen=True, eq=False)
class ValidatedSelection:
    """The effects that do not make the filter worse.

    refused : (Refused, ...) of the others
    worth : {candidate or detection: increase of the mean 3D RMSE without it, m}; for dropped ones,
        at the time they were dropped
    runs : runs of the filter as in the nodes, made on the way, by their cases
    """

    selection: Selection
    detections: tuple[Detection, ...]
    refused: tuple[Refused, ...]
    worth: dict[Candidate | Detection, float]
    runs: KnownRuns = ()

    def applied(self, attribution: Attribution) -> Attribution:
        """Return the Attribution with the selected effects only."""
        return replace(
            attribution,
            selection=with_deviations(self.selection),
            detections=self.detections,
            alone=(),
        )


def cross_fitted(
    attribution: Attribution,
    flights: Sequence[Flight],
    base: EffectSet,
    candidates: Sequence[Candidate],
    detections: Sequence[Detection],
    most: int | None = None,
) -> list[ValidationCase]:
    """Return ValidationCases with effects of `candidates` fitted to the other flights.

    A single flight is divided into two halves of alternating blocks. Each half is judged with
    effects fitted to the other half.

    most : largest number of cases, evenly taken; None for all
    """
    table, selection = attribution.selection.table, attribution.selection
    if len(flights) > 1:
        parts = [
            (ValidationCase(flights[k], base), k, table.flight != k) for k in range(len(flights))
        ]
    else:
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
            ValidationCase(flights[0], base, tuple(spans[k::2]), tuple(reach[k::2]))
            for k in range(2)
        ]
        parts = [(half, 0, number % 2 != k) for k, half in enumerate(halves)]
    out, columns = [], columns_of(candidates)
    for case, k, rows in parts[:: -(-len(parts) // (most or len(parts)))]:
        others = replace(
            selection, chosen=tuple(candidates), fit=refit(table, columns, selection.fit, rows)
        )
        found = usable([*effects_of(others), *(detection.effect for detection in detections)])
        fitted = [other for other in range(len(flights)) if other != k] or [k]
        out.append(
            replace(
                case,
                effects=EffectSet(
                    (*base.effects, *attribution.seen.limited(found.effects, fitted))
                ),
            )
        )
    return out


def select_by_error(
    attribution: Attribution,
    flights: Sequence[Flight],
    baseline: Baseline,
    progress: Callable[[], object] = lambda: None,
    map_function: MapFunction = map,
) -> ValidatedSelection:
    """Return the ValidatedSelection of effects that do not make the filter worse on hold-out data.

    Candidates are dropped one by one if the error falls without them. In a single flight they are
    also dropped if the error hardly grows. Detections stay only if the error falls with them. At
    most TRIAL_FLIGHTS flights are judged. Trials correct measurements at the poses of a run with
    all effects.

    After a drop, the other candidates that seemed harmful are tried again first. At the end all
    candidates are tried with the final model, and those without worth are dropped, as many together
    as leave the error as it is. If trials are costly, several candidates are dropped at once.
    Events at a time of a single flight are tried for their worth, but not kept.

    map_function : as of `attribute`
    """
    candidates, refused = list(attribution.selection.chosen), []
    detections: list[Detection] = []
    least = WORTH_OF_ONE if len(flights) == 1 else -WORSE
    trials = _Trials(attribution, flights, baseline, progress, map_function)
    error = trials.start(candidates, detections)
    without: dict[Candidate, float] = {}
    worth: dict[Candidate | Detection, float] = {}
    suspects = _applicable(candidates)
    while suspects:
        less = [([c for c in candidates if c is not one], detections) for one in suspects]
        without = dict(zip(suspects, trials.errors(less)))
        harmful = sorted(
            (one for one in suspects if without[one] <= error * (1.0 + least)),
            key=without.__getitem__,
        )
        gone = (
            _gone(trials, (candidates, detections), harmful, error * (1.0 + least))
            if trials.costly
            else harmful[:1]
        )
        if gone:
            refused += [Refused(one.label, _why_without(error, without[one])) for one in gone]
            worth.update((one, without[one] - error) for one in gone)
            candidates = [one for one in candidates if one not in gone]
            error, without = trials.start(candidates, detections), {}
        elif len(suspects) == len(_applicable(candidates)):
            break
        suspects = (
            _applicable(candidates) if trials.costly else harmful[1:] or _applicable(candidates)
        )
    while without:
        limit = error + min(LEAST_WORTH, LEAST_SHARE * error)
        idle = sorted((one for one in without if without[one] < limit), key=without.__getitem__)
        gone = _gone(trials, (candidates, detections), idle, limit)
        if not gone:
            break
        refused += [Refused(one.label, _why_without(error, without[one])) for one in gone]
        worth.update((one, without[one] - error) for one in gone)
        candidates = [one for one in candidates if one not in gone]
        suspects = _applicable(candidates)
        models = [(candidates, detections)]
        models += [([c for c in candidates if c is not one], detections) for one in suspects]
        error, *tried = trials.errors(models)
        without = dict(zip(suspects, tried))
    worth.update((candidate, trial - error) for candidate, trial in without.items())
    for detection in attribution.detections:
        if not detection.effect.usable:
            continue
        (trial,) = trials.errors([(candidates, [*detections, detection])])
        if trial < error * (1.0 - max(least, WORSE)):
            detections.append(detection)
            worth[detection] = error - trial
            error = trial
        else:
            useless = f"does not make the filter better: {error:.3f} m without, {trial:.3f} m with"
            why = useless if trial >= error * (1.0 - WORSE) else _why_without(trial, error)
            refused.append(Refused(detection.effect.label, why))
    for momentary in (one for one in candidates if len(flights) == 1 and _momentary(one)):
        refused.append(
            Refused(
                momentary.label,
                (
                    "it happened at a time of this flight; of another one that tells nothing: "
                    f"{SECOND}"
                ),
            )
        )
        candidates = [one for one in candidates if one is not momentary]
    selection = attribution.selection.kept(candidates)  # with the weights of the trials
    return ValidatedSelection(selection, tuple(detections), tuple(refused), worth, trials.runs)


def _gone(
    trials: _Trials, model: Model, harmful: Sequence[Candidate], limit: float
) -> Sequence[Candidate]:
    """Return the Candidates that can be dropped together with an error of at most `limit`, m.

    They are tried together. If the error is too large, each half is tried separately, and so on.

    harmful : Candidates of the model, the least worth first
    """
    candidates, detections = model
    gone: list[Candidate] = []
    parts = [list(harmful)] if harmful else []
    while parts:
        part = parts.pop(0)
        rest = [one for one in candidates if one not in (*gone, *part)]
        if (len(part) == 1 and not gone) or trials.errors([(rest, detections)])[0] <= limit:
            gone += part
        elif len(part) > 1:
            parts[:0] = [part[: len(part) // 2], part[len(part) // 2 :]]
    return gone


def _applicable(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return the Candidates that a node can correct, at least in part."""
    return [one for one in candidates if any(term.effect.usable for term in one.terms)]


def _why_without(error: float, without: float) -> str:
    """Return why an effect is not applied, given the errors with and without it, m."""
    figures = f"{error:.3f} m with, {without:.3f} m without"
    if without <= error * (1.0 - WORSE):
        return f"the filter does better without it: {figures}"
    if without < error + min(LEAST_WORTH, LEAST_SHARE * error):
        return f"it is worth nothing for the position: {figures}"
    return (
        f"of one flight, worth less than {WORTH_OF_ONE:.0%} of the error, it may as well do harm to "
        f"another; {SECOND}: {figures}"
    )


def _momentary(candidate: Candidate) -> bool:
    """Return whether a Candidate is an event at a time of one flight.

    It is a temporary delay, or a function of the time that is not a drift.
    """
    functions = [term.function for term in candidate.terms if term.function]
    return not recurs(candidate) or any(
        one.covariate == "time" and one.shape not in DRIFTS for one in functions
    )


class _Trials:
    """Mean 3D RMSE, m, of cross-fitted models.

    The first model runs like the nodes. Later models use the poses of that run, which takes a tenth
    of the time.
    """

    def __init__(
        self,
        attribution: Attribution,
        flights: Sequence[Flight],
        baseline: Baseline,
        progress: Callable[[], object],
        map_function: MapFunction,
    ) -> None:
        self._attribution, self._flights, self._baseline, self._progress = (
            attribution,
            flights,
            baseline,
            progress,
        )
        self._map_function = map_function
        self._poses: Sequence[Poses | None] = [None]
        self.runs: KnownRuns = ()

    @property
    def costly(self) -> bool:
        """Return whether trials are costly: a single flight with MANY anchors is long."""
        return len(self._flights) == 1 and self._attribution.selection.table.sparse

    def start(self, candidates: Sequence[Candidate], detections: Sequence[Detection]) -> float:
        """Return the error of a model, m, and keep the poses of its runs for later trials."""
        cases = self._cases(candidates, detections)
        (results,) = self._tried(_judged, [cases])
        if self._poses == [None]:
            self.runs = tuple((case, run) for case, (run, _) in zip(cases, results))
        self._poses = [poses_of(run.odometry) for run, _ in results]
        return float(np.mean([error for _, error in results]))

    def errors(self, models: Sequence[Model]) -> list[float]:
        """Return the errors of models [(candidates, detections)], in m."""
        results = self._tried(error_of, [self._cases(*model) for model in models])
        return [float(np.mean(errors)) for errors in results]

    def _cases(
        self, candidates: Sequence[Candidate], detections: Sequence[Detection]
    ) -> list[ValidationCase]:
        attribution, base = self._attribution, self._baseline.base
        return cross_fitted(attribution, self._flights, base, candidates, detections, TRIAL_FLIGHTS)

    def _tried(
        self,
        function: Callable[[FilterConfig | None, tuple[ValidationCase, Poses | None]], Made],
        cases: Sequence[list[ValidationCase]],
    ) -> list[list[Made]]:
        """Return [[function of each trial] of each model], computed in one map."""
        results = []
        trials = zip(chain.from_iterable(cases), cycle(self._poses))
        for of_case in self._map_function(partial(function, self._baseline.config), trials):
            results.append(of_case)
            self._progress()
        return [results[k : k + len(cases[0])] for k in range(0, len(results), len(cases[0]))]


def error_of(config: FilterConfig | None, trial: tuple[ValidationCase, Poses | None]) -> float:
    """Return the 3D RMSE of a trial, m."""
    return _judged(config, trial)[1]


def _judged(
    config: FilterConfig | None, trial: tuple[ValidationCase, Poses | None]
) -> tuple[Run, float]:
    """Return the Run and the 3D RMSE, m, of a trial.

    trial : ValidationCase, and the poses for corrections, None to use the poses of the run
    """
    case, poses = trial
    anchors, effects = case.flight.anchors, case.effects
    corrector = (
        Corrector(anchors, effects)
        if poses is None
        else FixedPoseCorrector(anchors, effects, poses)
    )
    run = run_offline(case.flight, config, corrector)
    return run, score(case, run).rmse_3d


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
