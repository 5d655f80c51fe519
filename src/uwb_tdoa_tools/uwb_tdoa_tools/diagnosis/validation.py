"""The loop closed: the filter with and without the effects, on data that they were not fitted to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector, FixedPoseCorrector
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.frames import poses_of
from uwb_tdoa_ekf.offline import run_offline

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
    from .detectors import Detection
    from .regression.terms import Candidate

    Model = tuple[Sequence[Candidate], Sequence[Detection]]
    Poses = tuple[np.ndarray, ...]  # as `poses_of` gives them

Made = TypeVar("Made")

TRIAL_FLIGHTS = 3  # flights, or halves of one, on which trials are judged
# shapes of a function of the time that may come again, as a clock warms up
DRIFTS = ("line", "beyond", "below", "parabola")
# share of the error by which leaving an effect out must make it smaller, for the effect to be left
# out
WORSE = 0.005
# share of the error by which it must grow, for the effect to stay, if a single flight shows it:
# others differ
WORTH_OF_ONE = 0.05
SELECTED_ON = ", chosen on all of them (--holdout judges the choice too)"
HELD_OUT = "flights that took no part in the fit"
SECOND = "give a second flight with this one"


@dataclass(frozen=True, eq=False)
class ValidatedSelection:
    """What makes the filter no worse: selection : Selection; detections; refused : (Refused, ...)
    of the others; worth : {candidate or detection: m by which the mean 3D RMSE is larger without
    it, of others when they were left out}.
    """

    selection: Selection
    detections: tuple[Detection, ...]
    refused: tuple[Refused, ...]
    worth: dict[Candidate | Detection, float]

    def applied(self, attribution: Attribution) -> Attribution:
        """The Attribution with what was selected alone."""
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
    """[ValidationCase]: each flight, or each half of a single one, every other block, with the
    effects of `candidates` fitted to the others alone; `most` of them, evenly taken, if there are
    more.
    """
    table, selection = attribution.selection.table, attribution.selection
    if len(flights) > 1:
        parts = [
            (ValidationCase(flights[k], base), k, table.flight != k) for k in range(len(flights))
        ]
    else:
        # in turns, so that both parts are of all of the flight
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
    """ValidatedSelection of what makes the filter no worse where it was not fitted.

    Candidates go, one by one, if the error is smaller without, or of a single flight hardly larger;
    detections stay only if it is smaller with them. At most TRIAL_FLIGHTS flights are judged.
    Trials run the filter with the corrections that it would get at the poses of a run with all.
    After one has gone, those that seemed to do harm too are tried again first; in the end all are
    tried beside what is kept. Where a trial is costly, as many go at once as may together. What
    happened at a time of a single flight is tried, so that its worth is known, and not kept.
    map_function : as of `attribute`.
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
    selection = attribution.selection.kept(candidates)  # fitted as in the trials
    return ValidatedSelection(selection, tuple(detections), tuple(refused), worth)


def _gone(
    trials: _Trials, model: Model, harmful: Sequence[Candidate], limit: float
) -> Sequence[Candidate]:
    """Of Candidates of a model, the least worth first, those that may go together: without all of
    them the error, m, is at most a limit, as it is without each. They are tried together; if that
    is too many, one half after the other, and so on.
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
    """Those of some Candidates that a node can take out, at least in part."""
    return [one for one in candidates if any(term.effect.usable for term in one.terms)]


def _why_without(error: float, without: float) -> str:
    """Why an effect is not applied, by the errors with and without it, m."""
    figures = f"{error:.3f} m with, {without:.3f} m without"
    if without <= error * (1.0 - WORSE):
        return f"the filter does better without it: {figures}"
    return (
        f"of one flight, worth less than {WORTH_OF_ONE:.0%} of the error ({figures}), it may as "
        f"well do harm to another: {SECOND}"
    )


def _momentary(candidate: Candidate) -> bool:
    """Whether it is what happened at a time of one flight: a delay for a while, or a function of
    the time that is no drift.
    """
    functions = [term.function for term in candidate.terms if term.function]
    return not recurs(candidate) or any(
        one.covariate == "time" and one.shape not in DRIFTS for one in functions
    )


class _Trials:
    """Mean 3D RMSE, m, of cross-fitted models. The first is run as the nodes would; then each at
    the poses of a run with nearly the same model, which takes a tenth of the time.
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

    @property
    def costly(self) -> bool:
        """Whether to make as few trials as will do: of a single flight, among MANY anchors, which
        is long if it has heard them all.
        """
        return len(self._flights) == 1 and self._attribution.selection.table.sparse

    def start(self, candidates: Sequence[Candidate], detections: Sequence[Detection]) -> float:
        """The error of a model; later trials take the poses of its runs."""
        (results,) = self._tried(_error_and_poses, [(candidates, detections)])
        self._poses = [poses for _, poses in results]
        return float(np.mean([error for error, _ in results]))

    def errors(self, models: Sequence[Model]) -> list[float]:
        """The errors of other models, [(candidates, detections)]: [m]."""
        return [float(np.mean(errors)) for errors in self._tried(error_of, models)]

    def _tried(
        self,
        function: Callable[[FilterConfig | None, tuple[ValidationCase, Poses | None]], Made],
        models: Sequence[Model],
    ) -> list[list[Made]]:
        """[[function of each trial] of each model], all at once."""
        attribution, flights, base = self._attribution, self._flights, self._baseline.base
        fitted = [
            cross_fitted(attribution, flights, base, candidates, detections, TRIAL_FLIGHTS)
            for candidates, detections in models
        ]
        results = []
        trials = zip(sum(fitted, []), cycle(self._poses))
        for of_case in self._map_function(partial(function, self._baseline.config), trials):
            results.append(of_case)
            self._progress()
        return [results[k : k + len(fitted[0])] for k in range(0, len(results), len(fitted[0]))]


def error_of(config: FilterConfig | None, trial: tuple[ValidationCase, Poses | None]) -> float:
    """3D RMSE, m, of a trial."""
    return _judged(config, trial)[0]


def _error_and_poses(
    config: FilterConfig | None, trial: tuple[ValidationCase, Poses | None]
) -> tuple[float, Poses]:
    """(3D RMSE, m, poses of the run) of a trial: a ValidationCase, and the poses that it is
    corrected at, None for those of the run itself.
    """
    error, run = _judged(config, trial)
    return error, poses_of(run.odometry)


def _judged(
    config: FilterConfig | None, trial: tuple[ValidationCase, Poses | None]
) -> tuple[float, Run]:
    """(3D RMSE, m, Run) of a trial."""
    case, poses = trial
    anchors, effects = case.flight.anchors, case.effects
    corrector = (
        Corrector(anchors, effects)
        if poses is None
        else FixedPoseCorrector(anchors, effects, poses)
    )
    run = run_offline(case.flight, config, corrector)
    return score(case, run).rmse_3d, run


def validation_cases(
    attribution: Attribution,
    flights: Sequence[Flight],
    holdout: Sequence[Flight],
    base: EffectSet,
    effects: EffectSet,
) -> tuple[list[ValidationCase], str]:
    """(cases, on what, in words) to validate an Attribution on: the hold-out Flights if there are
    any; or those it was fitted to, cross-fitted. base : EffectSet that was in the model; effects :
    EffectSet with what was found.
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
