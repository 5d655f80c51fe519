# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Validate effects: run the filter with and without them, on data that they were not fitted to."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from itertools import chain, cycle
from typing import TypeVar

import numpy as np

from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.correction.corrector import FixedPoses
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import Run
from uwb_tdoa_ekf.results import poses_of

from ..parallel import MapFunction
from ..scoring.metrics import EVERYTHING, LOSS, Score, gain, rms
from .attribution import Attribution
from .comparison import Baseline, ValidationCase, run_of, score
from .detectors import Detection
from .deviations import with_deviations
from .findings import Refused, usable
from .over_flights import harm, in_words, shares
from .refinement import effects_of, recurs
from .regression.fit import refit
from .regression.select import Selection
from .regression.table import BLOCK
from .regression.terms import Candidate

Made = TypeVar("Made")

TRIAL_FLIGHTS = 6  # largest number of flights, or halves of one, in trials
# shapes of a function of the time that can recur, like the warm-up of a clock
DRIFTS = ("line", "beyond", "below", "parabola")
# Smallest share of an error that counts as a difference.
WORSE = 0.005
# largest probability that an effect of several flights does harm to another flight
MOST_HARM = 0.2
# m, error of a TDOA or a range in the air. Walls and furniture cause less; people who move cause this.
OBSTRUCTED = 2.0
# share of the remaining power of the error by which the values of a single flight shrink
UNEXPLAINED = 0.5
# In a single flight, an effect may stand in place of another one if the error grows by a smaller
# share without it.
LITTLE = 0.05
LEAST_WORTH = 0.0005  # m, below which an effect is not written, because it rounds to nothing
# Largest relative change of a candidate's contribution with which its displacement is used again.
SAME_MOVE = 0.1
SELECTED_ON = ", chosen on all of them (--holdout judges the choice too)"
HELD_OUT = "flights that took no part in the fit"
SECOND = "give a second flight with this one"
OF_A_TIME = "it happened at times of these flights, and another one has it at other times"


@dataclass(frozen=True, eq=False)
class ValidatedSelection:
    """The effects that do not make the filter worse.

    refused : (Refused, ...) of the others
    worth : {candidate or detection: increase of the mean 3D RMSE without it, m}; for dropped ones,
        at the time they were dropped
    error : mean 3D RMSE of the trials, m; share : of the values that is applied
    misleading : names of declared effects that explain residuals, and do not help the filter or,
        of a single flight, help it little
    poses : of the last run of the filter, of each trial
    """

    selection: Selection
    detections: tuple[Detection, ...]
    refused: tuple[Refused, ...]
    worth: dict[Candidate | Detection, float]
    error: float
    share: float = 1.0
    misleading: frozenset[str] = frozenset()
    poses: Sequence[FixedPoses | None] = (None,)

    def untold(self, attribution: Attribution) -> float:
        """Return the power of the error, m^2, that another flight may keep.

        Of n functions that explain these flights alike, the cause is one, and 1 / n of it is applied.
        If the functions are independent in another flight, their mean leaves 1 - 1 / n of its power.
        """
        selection, total = self.selection.beside(attribution.selection), 0.0
        for one, alike in zip(selection.chosen, selection.alike):
            power = (self.error + self.worth.get(one, 0.0)) ** 2 - self.error**2
            total += (1.0 - 1.0 / (1 + len(alike))) * max(power, 0.0)
        return total

    def applied(self, attribution: Attribution) -> Attribution:
        """Return the Attribution with the selected effects only."""
        selection = self.selection.beside(attribution.selection)
        return replace(
            attribution,
            selection=with_deviations(selection.kept(selection.chosen, self.share)),
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
    share: float | None = None,
) -> list[ValidationCase]:
    """Return ValidationCases with effects of `candidates` fitted to the other flights.

    A single flight is divided into two halves of alternating blocks. Each half is judged with
    effects fitted to the other half.

    most : largest number of cases, evenly taken; None for all
    share : as of `refit`
    """
    selection = attribution.selection
    table = selection.table
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
    out = []
    for case, k, rows in parts[:: -(-len(parts) // (most or len(parts)))]:
        others = selection.kept(candidates, share, rows)
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
    poses: Sequence[FixedPoses | None] = (None,),
) -> ValidatedSelection:
    """Return the ValidatedSelection of effects that do not make the filter worse on hold-out data.

    The filter runs without each candidate. The displacements of the position by all candidates
    then predict the error without several of them, and candidates are dropped one by one by this
    prediction. The filter runs again with the rest, until no candidate is dropped. Detections stay
    only if the error falls with them. Beside them the candidates must still gain LOSS together. At
    most TRIAL_FLIGHTS flights are judged. Of two flights none may get worse by an effect. Events of
    these flights alone are tried for their worth, but not kept: another flight does not have them.
    They stay in the fit, because other effects would stand in for them.

    map_function : as of `attribute`
    poses : of an earlier ValidatedSelection of these flights, for the first corrections
    """
    candidates, refused = list(attribution.selection.chosen), []
    detections: list[Detection] = []
    alone = len(flights) == 1
    trials = _Trials(attribution, flights, baseline, progress, map_function, poses)
    worth: dict[Candidate | Detection, float] = {}
    misleading: set[str] = set()
    error = trials.start(candidates, detections)
    # Only what a node can correct, at least in part, is tried.
    while applicable := [
        one for one in candidates if any(term.effect.usable for term in one.terms)
    ]:
        displacements = trials.displacements(candidates, applicable)
        gone = _dropped(displacements, applicable)
        if not gone:
            whole = displacements.error([])
            for one in applicable:
                worth[one] = displacements.error([one]) - whole
            unsure = own = _own(trials.selection, applicable, alone)
            if not own and not alone:
                unsure = _harmful(trials.selection, attribution.names, candidates, applicable)
                if len(flights) == 2:
                    unsure = unsure or _worse_in_one(displacements, applicable)
            if not unsure:
                break
            # The others were judged beside these, and are judged again without them.
            refused += [Refused(one.label, why) for one, why in unsure.items()]
            candidates = [one for one in candidates if one not in unsure]
            trials.set_apart(own)
            error = trials.start(candidates, detections)
            continue
        kept = [one for one in candidates if one not in gone]
        error = trials.start(kept, detections)
        while len(gone) > 1 and error > displacements.error(list(gone)) * (1.0 + WORSE):
            # Displacements do not add up: drop half of the effects.
            gone = dict(list(gone.items())[: len(gone) // 2])
            kept = [one for one in candidates if one not in gone]
            error = trials.start(kept, detections)
        for one, (before, after) in gone.items():
            refused.append(Refused(one.label, why_without(before, after)))
            worth[one] = after - before
        misleading.update(one.name for one in gone if one.declared)
        candidates = kept
    for detection in attribution.detections:
        if not detection.effect.usable:
            continue
        trial = trials.error(candidates, [*detections, detection])
        if trial < error * (1.0 - WORSE):
            detections.append(detection)
            worth[detection] = error - trial
            error = trial
        else:
            refused.append(Refused(detection.effect.label, why_without(trial, error)))
    if alone:
        little = [one for one in candidates if worth.get(one, error) < LITTLE * error]
        misleading.update(one.name for one in little if one.declared)
    # The fit takes errors of its flights alone for effects of all flights. They are likely where much
    # of the error remains, and average out over flights.
    without = trials.error([], detections) if candidates else error
    if detections and candidates and gain(without, error) < LOSS:
        # The noise gains, and these have ridden along: they were judged without it.
        refused += [
            Refused(
                one.label, f"beside the noise that was found, {_with_and_without(error, without)}"
            )
            for one in candidates
        ]
        candidates, error = [], without
    remains = min(error / without, 1.0) if candidates else 0.0
    share = 1.0 - UNEXPLAINED * remains**2 / len(flights)
    # with the weights of the trials
    selection = trials.selection.kept(candidates, share)
    return ValidatedSelection(
        selection,
        tuple(detections),
        tuple(refused),
        worth,
        error,
        share,
        frozenset(misleading),
        trials.poses,
    )


def _harmful(
    selection: Selection,
    names: Sequence[str],
    candidates: Sequence[Candidate],
    applicable: Sequence[Candidate],
) -> dict[Candidate, str]:
    """Return the Candidate that most likely does harm to another flight, and why; {} without one.

    Flights show different shares of it, beside the other candidates.

    names : of the flights
    """
    selection = selection.kept(candidates)
    several = {one: shares(selection, one, names) for one in applicable}
    probability = {one: harm(of_flights) for one, of_flights in several.items()}
    worst = max(probability, key=probability.__getitem__)
    if probability[worst] <= MOST_HARM:
        return {}
    return {
        worst: f"another flight may not have it (probability {probability[worst]:.0%}). "
        f"{in_words(several[worst])}"
    }


def _worse_in_one(
    displacements: Displacements, applicable: Sequence[Candidate]
) -> dict[Candidate, str]:
    """Return the Candidate with the largest loss in one of two flights, and why; {} without one.

    A loss counts above LOSS. What helps one flight and does harm to the other may do either to a
    third one. Of more flights, the mean decides.
    """
    losses = {one: displacements.largest_loss(one) for one in applicable}
    worst = max(losses, key=lambda one: losses[one][0])
    loss, before, after = losses[worst]
    if loss <= LOSS:
        return {}
    figures = _with_and_without(after, before)
    return {worst: f"one of both flights gets worse by it, and a third flight decides: {figures}"}


def _dropped(
    displacements: Displacements, candidates: Sequence[Candidate]
) -> dict[Candidate, tuple[float, float]]:
    """Return the Candidates to drop, with the predicted errors before and after, m.

    The one without which the error is smallest goes first.
    """
    gone: dict[Candidate, tuple[float, float]] = {}
    error = lowest = displacements.error([])
    while len(gone) < len(candidates):
        tried = {one: displacements.error([*gone, one]) for one in candidates if one not in gone}
        one = min(tried, key=tried.__getitem__)
        if tried[one] > lowest + LEAST_WORTH:
            break
        gone[one] = error, tried[one]
        error = tried[one]
        lowest = min(lowest, error)
    return gone


@dataclass(frozen=True, eq=False)
class Displacements:
    """Position errors of trials, and how they change without each effect.

    errors : [(n, 3)] m, of each case; changes : {candidate: [(n, 3)] m}
    """

    errors: list[np.ndarray]
    changes: dict[Candidate, list[np.ndarray]]

    def error(self, gone: Sequence[Candidate]) -> float:
        """Return the mean 3D RMSE of the cases without some effects, m, to first order."""
        several = []
        for k, error in enumerate(self.errors):
            moved = error + sum(self.changes[one][k] for one in gone)
            several.append(rms(np.linalg.norm(moved, axis=1)))
        return float(np.mean(several))

    def largest_loss(self, one: Candidate) -> tuple[float, float, float]:
        """Return the largest loss by an effect in a case, and its errors without and with it, m."""
        losses = []
        for error, change in zip(self.errors, self.changes[one]):
            after, before = (rms(np.linalg.norm(part, axis=1)) for part in (error, error + change))
            losses.append((-gain(before, after), before, after))
        return max(losses)


def why_without(error: float, without: float) -> str:
    """Return why an effect is not applied, given the errors with and without it, m."""
    figures = _with_and_without(error, without)
    if without <= error * (1.0 - WORSE):
        return f"the filter does better without it: {figures}"
    return f"it is worth nothing for the position: {figures}"


def _with_and_without(error: float, without: float) -> str:
    """Return errors with and without an effect, m, as text."""
    return f"{100.0 * without:.1f} cm without, {100.0 * error:.1f} cm with"


def _momentary(candidate: Candidate) -> bool:
    """Return whether a Candidate is an event at a time of its flights.

    It is a temporary delay, or a function of the time that is not a drift.
    """
    functions = [term.function for term in candidate.terms if term.function]
    return not recurs(candidate) or any(
        one.covariate == "time" and one.shape not in DRIFTS for one in functions
    )


def _own(
    selection: Selection, candidates: Sequence[Candidate], alone: bool
) -> dict[Candidate, str]:
    """Return the Candidates that belong to these flights alone, and why.

    alone : whether there is a single flight
    """
    if not alone:
        return {one: OF_A_TIME for one in candidates if _momentary(one)}
    reasons = {one: _why_of_this_flight(selection, one) for one in candidates}
    return {
        one: f"{reason}, and another one may not have it: {SECOND}"
        for one, reason in reasons.items()
        if reason
    }


def _why_of_this_flight(selection: Selection, candidate: Candidate) -> str | None:
    """Return why a Candidate belongs to a single flight alone, or None."""
    if _momentary(candidate):
        return "it happened at a time of this flight"
    of_place = any(
        term.effect.is_condition(key) for term in candidate.terms for key in term.effect.values
    )
    if candidate.declared and not of_place:
        return None
    table = selection.table
    part = table.matrix(candidate.columns) @ selection.fit.values(candidate.columns)
    if np.abs(part[table.radio_rows]).max(initial=0.0) > OBSTRUCTED:
        return f"an error above {OBSTRUCTED:g} m is an obstruction of this flight"
    return None


class _Trials:
    """Mean 3D RMSE, m, of cross-fitted models.

    The first model runs like the nodes, if no poses are known. Later models use the poses of the
    run before, which takes a fifth of the time.
    """

    def __init__(
        self,
        attribution: Attribution,
        flights: Sequence[Flight],
        baseline: Baseline,
        progress: Callable[[], object],
        map_function: MapFunction,
        poses: Sequence[FixedPoses | None] = (None,),
    ) -> None:
        self._attribution, self._flights, self._baseline, self._progress = (
            attribution,
            flights,
            baseline,
            progress,
        )
        self._map_function = map_function
        self.poses = poses  # of the last `start`, of each case; None before the first one
        self._now: list[Score] = []
        # {candidate: (return value of `_moved`, [return value of `_change`] of each case)}
        self._known: dict[Candidate, tuple[np.ndarray, list[tuple[np.ndarray, np.ndarray]]]] = {}

    def start(self, candidates: Sequence[Candidate], detections: Sequence[Detection]) -> float:
        """Return the error of a model, m, and keep its scores and poses for later trials."""
        cases = self._cases(candidates, detections)
        judged = self._tried(_judged, cases)
        self._now = [of_case for _, of_case in judged]
        self.poses = [FixedPoses(poses_of(run.odometry)) for run, _ in judged]
        return float(np.mean([of_case.rmse_3d for of_case in self._now]))

    @property
    def selection(self) -> Selection:
        """Return the Selection that is tried."""
        return self._attribution.selection

    def set_apart(self, candidates: Collection[Candidate]) -> None:
        """Keep Candidates in the fits, and do not correct them: other flights do not have them."""
        apart = self.selection.apart(candidates)
        self._attribution = replace(self._attribution, selection=apart)

    def error(self, candidates: Sequence[Candidate], detections: Sequence[Detection]) -> float:
        """Return the error of a model, m."""
        tried = self._tried(_scored, self._cases(candidates, detections))
        return float(np.mean([judged.rmse_3d for judged in tried]))

    def displacements(
        self, candidates: Sequence[Candidate], each: Sequence[Candidate]
    ) -> Displacements:
        """Return the Displacements by each of some candidates of the model of the last `start`.

        A displacement of an earlier model is used again if the corrections without the candidate
        differ from those of the model as they did then.
        """
        moves = {one: self._moved(candidates, one) for one in each}
        anew = [one for one in each if not self._is_known(one, moves[one])]
        models = [self._cases([c for c in candidates if c is not one], ()) for one in anew]
        tried = iter(self._tried(_scored, list(chain.from_iterable(models))))
        for one in anew:
            self._known[one] = moves[one], [_change(now, next(tried)) for now in self._now]
        errors = []
        changes: dict[Candidate, list[np.ndarray]] = {one: [] for one in each}
        for k, now in enumerate(self._now):
            several = {one: self._known[one][1][k] for one in each}
            t = reduce(np.intersect1d, [of_one for of_one, _ in several.values()], now.t)
            errors.append(now.error[np.isin(now.t, t)])
            for one, (of_one, change) in several.items():
                changes[one].append(change[np.isin(of_one, t)])
        return Displacements(errors, changes)

    def _moved(self, candidates: Sequence[Candidate], one: Candidate) -> np.ndarray:
        """Return by how much residuals change without a candidate, (n,), in their deviations."""
        selection = self._attribution.selection
        others = [other for other in candidates if other is not one]
        whole, rest = (
            refit(selection.table, selection.columns(several), selection.fit)
            for several in (candidates, others)
        )
        information = selection.fit.information(selection.table)
        return (rest.residual - whole.residual) * np.sqrt(information)

    def _is_known(self, one: Candidate, moved: np.ndarray) -> bool:
        """Return whether the displacement without a candidate is known; moved : as of `_moved`."""
        if one not in self._known:
            return False
        before, _ = self._known[one]
        return bool(np.linalg.norm(moved - before) < SAME_MOVE * np.linalg.norm(before))

    def _cases(
        self, candidates: Sequence[Candidate], detections: Sequence[Detection]
    ) -> list[ValidationCase]:
        attribution, base = self._attribution, self._baseline.base
        return cross_fitted(attribution, self._flights, base, candidates, detections, TRIAL_FLIGHTS)

    def _tried(
        self,
        function: Callable[[FilterConfig | None, tuple[ValidationCase, FixedPoses | None]], Made],
        cases: Sequence[ValidationCase],
    ) -> list[Made]:
        """Return function of each trial; several models follow each other."""
        results = []
        trials = zip(cases, cycle(self.poses))
        for of_case in self._map_function(partial(function, self._baseline.config), trials):
            results.append(of_case)
            self._progress()
        return results


def _change(now: Score, other: Score) -> tuple[np.ndarray, np.ndarray]:
    """Return common stamps (n,) s, and by how much the position error differs at them, (n, 3) m."""
    t = np.intersect1d(now.t, other.t)
    return t, other.error[np.isin(other.t, t)] - now.error[np.isin(now.t, t)]


def _scored(config: FilterConfig | None, trial: tuple[ValidationCase, FixedPoses | None]) -> Score:
    return _judged(config, trial)[1]


def _judged(
    config: FilterConfig | None, trial: tuple[ValidationCase, FixedPoses | None]
) -> tuple[Run, Score]:
    """Return the Run and the Score of a trial: a ValidationCase, and poses as of `run_of`."""
    case, poses = trial
    run = run_of(config, case, poses)
    return run, score(case, run)


def validation_cases(
    attribution: Attribution,
    flights: Sequence[Flight],
    holdout: Sequence[Flight],
    base: EffectSet,
    effects: EffectSet,
    share: float = 1.0,
) -> tuple[list[ValidationCase], str]:
    """Return the cases that validate an Attribution, and a description of the data.

    They are the hold-out Flights, or without any, cross-fitted cases of the fitted flights.

    base : EffectSet before; effects : EffectSet with the found effects
    share : of the values that is applied
    """
    if holdout:
        return [ValidationCase(flight, effects) for flight in holdout], HELD_OUT
    on = "each half of the flight, every other 5 s, with effects fitted to the other"
    if len(flights) > 1:
        on = "each flight with effects fitted to the others"
    cases = cross_fitted(
        attribution,
        flights,
        base,
        attribution.selection.chosen,
        attribution.detections,
        share=share,
    )
    return cases, on + SELECTED_ON
