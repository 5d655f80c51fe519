"""The loop closed: the filter with and without the effects, on data that they were not fitted to."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import cycle
from typing import Any, TYPE_CHECKING, TypeVar

import numpy as np

from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_bias.correction.rehearsal import RehearsedCorrector
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.stamp_error import shifted
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.results import VERDICTS
from uwb_tdoa_ekf.offline import poses_of, run_offline

from ..scoring.by_phase import EVERYTHING
from ..scoring.metrics import Score, as_json, pooled
from .attribution import effects_of, recurs
from .findings import Refused, usable
from .regression.fit import refit
from .regression.select import Selection
from .regression.table import BLOCK
from .regression.terms import columns_of

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator, Sequence
    from uwb_tdoa_bias.foundation.flight import Flight
    from uwb_tdoa_ekf.core.config import FilterConfig
    from uwb_tdoa_ekf.offline import Run
    from ..parallel import MapFunction
    from .attribution import Attribution
    from .detectors import Detection
    from .regression.terms import Candidate

    Model = tuple[Sequence[Candidate], Sequence[Detection]]
    Poses = tuple[np.ndarray, ...]  # as `poses_of` gives them
    Spans = tuple[tuple[float, float], ...]  # (first, last) s

Made = TypeVar("Made")

BOOTSTRAPS = 400
Z95 = 1.96  # standard deviations from the middle of a 95 % interval to its ends
TRIAL_FLIGHTS = 3  # flights, or halves of one, on which trials are judged
# Standard deviations by which a gain must be above zero where the reference itself may be off. What is fitted follows what the
# references have in common, in whatever direction that is: chi with three degrees of freedom, 99.9 %.
SURE = 4.0
DRIFTS = ("line", "beyond", "below", "parabola")  # shapes of a function of the time that may come again, as a clock warms up
WORSE = 0.005  # share of the error by which leaving an effect out must make it smaller, for the effect to be left out
WORTH_OF_ONE = 0.05  # share of the error by which it must grow, for the effect to stay, if a single flight shows it: others differ
SELECTED_ON = ", chosen on all of them (--holdout judges the choice too)"
HELD_OUT = "flights that took no part in the fit"
SECOND = "give a second flight with this one"
USED = next(value for value, name in VERDICTS.items() if name == "used")


@dataclass(frozen=True, eq=False)
class ValidationCase:
    """A flight to judge on, and an EffectSet that it took no part in fitting. spans : ((first, last), ...) s, None for all; reach : the
    same for phases, which those at either end of the flight go on to its begin and its end for."""

    flight: Flight
    effects: EffectSet
    spans: Spans | None = None
    reach: Spans = EVERYTHING


@dataclass(frozen=True, eq=False)
class ValidatedSelection:
    """What makes the filter no worse: selection : Selection; detections; refused : (Refused, ...) of the others; worth :
    {candidate or detection: m by which the mean 3D RMSE is larger without it, of others when they were left out}."""

    selection: Selection
    detections: tuple[Detection, ...]
    refused: tuple[Refused, ...]
    worth: dict[Candidate | Detection, float]

    @property
    def candidates(self) -> tuple[Candidate, ...]:
        """Those that are kept."""
        return self.selection.chosen


def empty_selection(attribution: Attribution, refused: Iterable[Refused] = ()) -> ValidatedSelection:
    """ValidatedSelection of an Attribution of which nothing is."""
    return ValidatedSelection(attribution.selection.only(()), (), tuple(refused), {})


def cross_fitted(
    attribution: Attribution, flights: Sequence[Flight], base: EffectSet, candidates: Sequence[Candidate],
    detections: Sequence[Detection], most: int | None = None,
) -> list[ValidationCase]:  # fmt: skip
    """[ValidationCase]: each flight, or each half of a single one, every other block, with the effects of `candidates`
    fitted to the others alone; `most` of them, evenly taken, if there are more."""
    table, selection = attribution.selection.table, attribution.selection
    if len(flights) > 1:
        parts = [(ValidationCase(flights[k], base), k, table.flight != k) for k in range(len(flights))]
    else:
        # in turns, so that both parts are of all of the flight
        start, since = float(flights[0].tdoa.t[0]), table.t - table.t.min()
        length = min(BLOCK, 0.5 * since.max())
        number = np.minimum((since / length).astype(int), int(since.max() / length) - 1)
        edges = start + table.t.min() + length * np.arange(number.max() + 2)
        edges[-1] = start + table.t.max()
        spans = list(zip(edges[:-1].tolist(), edges[1:].tolist()))
        reach = [(-np.inf, spans[0][1]), *spans[1:-1], (spans[-1][0], np.inf)] if len(spans) > 1 else EVERYTHING
        halves = [ValidationCase(flights[0], base, tuple(spans[k::2]), tuple(reach[k::2])) for k in range(2)]
        parts = [(half, 0, number % 2 != k) for k, half in enumerate(halves)]
    out, columns = [], columns_of(candidates)
    for case, k, rows in parts[:: -(-len(parts) // (most or len(parts)))]:
        others = replace(selection, chosen=tuple(candidates), fit=refit(table, columns, selection.fit, rows))
        found = usable([*effects_of(others), *(detection.effect for detection in detections)])
        fitted = [other for other in range(len(flights)) if other != k] or [k]
        out.append(replace(case, effects=EffectSet((*base.effects, *attribution.seen.limited(found.effects, fitted)))))
    return out


def select_by_error(
    attribution: Attribution, flights: Sequence[Flight], baseline: Baseline,
    progress: Callable[[], object] = lambda: None, map_function: MapFunction = map,
) -> ValidatedSelection:  # fmt: skip
    """ValidatedSelection of what makes the filter no worse where it was not fitted.

    Candidates go, one by one, if the error is smaller without, or of a single flight hardly larger; detections stay only if it is
    smaller with them. At most TRIAL_FLIGHTS flights are judged. Trials run the filter with the corrections that it
    would get at the poses of a run with all.
    After one has gone, those that seemed to do harm too are tried again first; in the end all are tried beside what is kept.
    What happened at a time of a single flight is tried, so that its worth is known, and not kept.
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
        harmful = sorted((one for one in suspects if without[one] <= error * (1.0 + least)), key=without.__getitem__)
        if harmful:
            why = _why_without(error, without[harmful[0]])
            refused.append(Refused(harmful[0].label, why))
            candidates = [one for one in candidates if one is not harmful[0]]
            worth[harmful[0]] = without[harmful[0]] - error
            error, without = trials.start(candidates, detections), {}
        elif len(suspects) == len(_applicable(candidates)):
            break
        suspects = harmful[1:] or _applicable(candidates)
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
        refused.append(Refused(momentary.label, f"it happened at a time of this flight; of another one that tells nothing: {SECOND}"))
        candidates = [one for one in candidates if one is not momentary]
    selection = attribution.selection.kept(candidates)  # fitted as in the trials
    return ValidatedSelection(selection, tuple(detections), tuple(refused), worth)


def _applicable(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Those of some Candidates that a node can take out, at least in part."""
    return [one for one in candidates if any(term.effect.usable for term in one.terms)]


def _why_without(error: float, without: float) -> str:
    """Why an effect is not applied, by the errors with and without it, m."""
    figures = f"{error:.3f} m with, {without:.3f} m without"
    if without <= error * (1.0 - WORSE):
        return f"the filter does better without it: {figures}"
    return f"of one flight, worth less than {WORTH_OF_ONE:.0%} of the error ({figures}), it may as well do harm to another: {SECOND}"


def _momentary(candidate: Candidate) -> bool:
    """Whether it is what happened at a time of one flight: a delay for a while, or a function of the time that is no drift."""
    functions = [term.function for term in candidate.terms if term.function]
    return not recurs(candidate) or any(one.covariate == "time" and one.shape not in DRIFTS for one in functions)


class Baseline:
    """The model before: runs of the filter with it, one for each flight."""

    def __init__(self, base: EffectSet, config: FilterConfig | None = None) -> None:
        """base : EffectSet; config : FilterConfig."""
        self.base, self.config = base, config
        self._runs: dict[int, tuple[Flight, Run]] = {}

    def run(self, flight: Flight) -> Run:
        """Run of a Flight, the same one whenever it is asked for."""
        self.prepare([flight])
        return self._runs[id(flight)][1]

    def prepare(
        self, flights: Sequence[Flight], progress: Callable[[], object] = lambda: None, map_function: MapFunction = map
    ) -> None:
        """Make the runs of Flights that there are none of yet. map_function : as of `attribute`."""
        missing = [flight for flight in flights if id(flight) not in self._runs]
        missing = list({id(flight): flight for flight in missing}.values())
        cases = [ValidationCase(flight, self.base) for flight in missing]
        for run, flight in zip(map_function(partial(_run, self.config), cases), missing):
            self._runs[id(flight)] = flight, run  # the flight, so that its id stays
            progress()


class _Trials:
    """Mean 3D RMSE, m, of cross-fitted models. The first is run as the nodes would; then each at the poses of a run with nearly
    the same model, which takes a tenth of the time."""

    def __init__(
        self, attribution: Attribution, flights: Sequence[Flight], baseline: Baseline, progress: Callable[[], object],
        map_function: MapFunction,
    ) -> None:  # fmt: skip
        self._attribution, self._flights, self._baseline, self._progress = attribution, flights, baseline, progress
        self._map_function = map_function
        self._poses: Sequence[Poses | None] = [None]

    def start(self, candidates: Sequence[Candidate], detections: Sequence[Detection]) -> float:
        """The error of a model; later trials take the poses of its runs."""
        (told,) = self._tried(_error_and_poses, [(candidates, detections)])
        self._poses = [poses for _, poses in told]
        return float(np.mean([error for error, _ in told]))

    def errors(self, models: Sequence[Model]) -> list[float]:
        """The errors of other models, [(candidates, detections)]: [m]."""
        return [float(np.mean(errors)) for errors in self._tried(_error, models)]

    def _tried(
        self, function: Callable[[FilterConfig | None, tuple[ValidationCase, Poses | None]], Made],
        models: Sequence[Model],
    ) -> list[list[Made]]:  # fmt: skip
        """[[function of each trial] of each model], all at once."""
        attribution, flights, base = self._attribution, self._flights, self._baseline.base
        fitted = [
            cross_fitted(attribution, flights, base, candidates, detections, TRIAL_FLIGHTS)
            for candidates, detections in models
        ]
        told = []
        trials = zip(sum(fitted, []), cycle(self._poses))
        for of_case in self._map_function(partial(function, self._baseline.config), trials):
            told.append(of_case)
            self._progress()
        return [told[k : k + len(fitted[0])] for k in range(0, len(told), len(fitted[0]))]


def _error(config: FilterConfig | None, trial: tuple[ValidationCase, Poses | None]) -> float:
    return _error_and_poses(config, trial)[0]


def _error_and_poses(config: FilterConfig | None, trial: tuple[ValidationCase, Poses | None]) -> tuple[float, Poses]:
    """(3D RMSE, m, poses of the run) of a trial: a ValidationCase, and the poses that it is corrected at, None for
    those of the run itself."""
    case, poses = trial
    anchors, effects = case.flight.anchors, case.effects
    corrector = Corrector(anchors, effects) if poses is None else RehearsedCorrector(anchors, effects, poses)
    run = run_offline(case.flight, config, corrector)
    return score(case, run).row()["rmse_3d"], poses_of(run.odometry)


def validation_cases(
    attribution: Attribution, flights: Sequence[Flight], holdout: Sequence[Flight], base: EffectSet, effects: EffectSet
) -> tuple[list[ValidationCase], str]:
    """(cases, on what, in words) to validate an Attribution on: the hold-out Flights if there are any; or those it was fitted to,
    cross-fitted. base : EffectSet that was in the model; effects : EffectSet with what was found."""
    if holdout:
        return [ValidationCase(flight, effects) for flight in holdout], HELD_OUT
    on = "each half of the flight, every other 5 s, with effects fitted to the other"
    if len(flights) > 1:
        on = "each flight with effects fitted to the others"
    cases = cross_fitted(attribution, flights, base, attribution.selection.chosen, attribution.detections)
    return cases, on + SELECTED_ON


def why_not(before: dict[str, Any], after: dict[str, Any], shift_std: float) -> str | None:
    """Why what was found must not be applied, after `compare`; None if it may. shift_std : m, what a reference may be off by in all
    of a flight; the gain must be SURE standard deviations of what that can feign."""
    gain, interval = after["pooled"]["rmse_3d"] < before["pooled"]["rmse_3d"], after["pooled"]["rmse_3d_gain_ci"]
    if not gain:
        return "together they do not make the error smaller on held-out data"
    if shift_std > 0.0 and (interval is None or sum(interval) < SURE / Z95 * (interval[1] - interval[0])):
        return (
            f"all of a flight may be {100 * shift_std:.0f} cm from where the reference says, on each axis, and the gain is less than that "
            "can feign; measure more marks, or better ones"
        )
    if interval is not None and interval[0] <= 0.0:
        share = 1.0 - after["pooled"]["rmse_3d"] / before["pooled"]["rmse_3d"]
        return (
            f"together they make the error {share:.0%} smaller on held-out data, which may be chance: the 95 % interval is {interval[0]:.0%} to "
            f"{interval[1]:.0%}; fly more"
        )
    return None


def compare(
    cases: Sequence[ValidationCase], baseline: Baseline, progress: Callable[[], object] = lambda: None,
    shift_std: Callable[[str], np.ndarray] = lambda name: np.zeros(3), map_function: MapFunction = map,
) -> tuple[dict[str, Any], dict[str, Any]]:  # fmt: skip
    """(before, after) of Cases: {"runs": [...], "pooled": {...}, "scores": [Score]}, keys as in evaluate, phases too, besides
    residual_spread (m, 1.48 MAD of the innovations) and rmse_3d_ci (95 %, bootstrap over blocks of 5 s); rmse_3d_gain_ci counts
    what the references of whole flights may be off by too. shift_std : of a Reference; map_function : as of
    `attribute`."""
    sides: list[dict[str, Any]] = []
    draws = []
    for after in (False, True):
        scores, rows, blocks = [], [], []
        for run, case in zip(_runs(cases, baseline, after, progress, map_function), cases):
            case = case if after else replace(case, effects=baseline.base)
            scores.append(score(case, run))
            blocks.append(_blocks(scores[-1]))
            row = as_json(scores[-1].row())
            row |= {"phases": as_json(scores[-1].phases())}
            rows.append({**row, "residual_spread": _spread(run), "rmse_3d_ci": _interval(blocks[-1:])})
        spreads = [row["residual_spread"] for row in rows if row["residual_spread"] is not None]
        together = {**as_json(pooled(scores)), "residual_spread": float(np.mean(spreads)) if spreads else None}
        sides.append({"runs": rows, "pooled": {**together, "rmse_3d_ci": _interval(blocks)}, "scores": scores})
        draws.append(blocks)
    names = [case.flight.name for case in cases]
    sides[1]["pooled"]["rmse_3d_gain_ci"] = _gain_interval(draws[0], draws[1], names, shift_std)
    return sides[0], sides[1]


def score(case: ValidationCase, run: Run) -> Score:
    """Score of a Run on a ValidationCase. Raises InputError where there is no estimate."""
    truth = shifted(case.flight, "truth", -case.effects.stamp_offset("truth")).truth
    assert truth is not None  # of a Reference that tells errors
    out = Score(case.flight.name, run.odometry, truth, run.residuals, case.flight.tdoa.t, case.spans, case.reach)
    if not len(out.t):
        raise InputError(f"{case.flight.name}: the filter gives no estimate in the part to judge on; see what evaluate says.")
    return out


def _runs(
    cases: Sequence[ValidationCase], baseline: Baseline, after: bool, progress: Callable[[], object],
    map_function: MapFunction,
) -> Iterator[Run]:  # fmt: skip
    """Runs of Cases in turn, before or after."""
    if not after:
        baseline.prepare([case.flight for case in cases], progress, map_function)
        yield from (baseline.run(case.flight) for case in cases)
        return
    for run in map_function(partial(_run, baseline.config), cases):
        progress()
        yield run


def _run(config: FilterConfig | None, case: ValidationCase) -> Run:
    return run_offline(case.flight, config, Corrector(case.flight.anchors, case.effects))


def innovations(
    cases: Sequence[ValidationCase], baseline: Baseline, progress: Callable[[], object] = lambda: None,
    map_function: MapFunction = map,
) -> tuple[dict[str, Any], dict[str, Any]]:  # fmt: skip
    """What `compare` gives, where nobody knows the errors: figures of the filter's own innovations alone."""
    sides = []
    for after in (False, True):
        rows = []
        for run, case in zip(_runs(cases, baseline, after, progress, map_function), cases):
            used = run.residuals.verdict == USED
            nis = run.residuals.innovation[used] ** 2 / run.residuals.variance[used]
            figures: dict[str, Any] = {"nis_mean": float(np.mean(nis)), "residual_spread": _spread(run)}
            rows.append({"flight": case.flight.name, "rmse_3d": None, **figures})
        pooled_figures: dict[str, Any] = {"rmse_3d": None}
        pooled_figures |= {key: float(np.mean([row[key] for row in rows])) for key in ("nis_mean", "residual_spread")}
        sides.append({"runs": rows, "pooled": pooled_figures, "scores": []})
    return sides[0], sides[1]


def _spread(run: Run) -> float | None:
    used = run.residuals.verdict == USED
    return float(1.4826 * np.median(np.abs(run.residuals.innovation[used]))) if used.any() else None


def _blocks(judged: Score) -> np.ndarray:
    """(b, 5) per block of 5 s: sums of squared 3D errors, counts, sums of errors."""
    if not len(judged.t):
        return np.zeros((1, 5))
    block = ((judged.t - judged.t[0]) / BLOCK).astype(int)
    power = np.sum(judged.error**2, axis=1)
    return np.stack([np.bincount(block, power), np.bincount(block), *(np.bincount(block, e) for e in judged.error.T)], axis=1)


def _interval(blocks: Sequence[np.ndarray]) -> list[float] | None:
    """95 % interval of the 3D RMSE: [low, high], m."""
    together = np.concatenate(blocks)
    draws = _draws(together, np.zeros((BOOTSTRAPS, len(together), 3)))
    return [float(x) for x in np.quantile(draws, [0.025, 0.975])] if np.isfinite(draws).all() else None


def _draws(blocks: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """(BOOTSTRAPS,) m: the 3D RMSE of blocks (b, 5) drawn at random, whose errors are all off by shifts (BOOTSTRAPS, b, 3), m."""
    chosen = np.random.default_rng(0).integers(0, len(blocks), (BOOTSTRAPS, len(blocks)))
    power, count, error = blocks[chosen, 0], blocks[chosen, 1], blocks[chosen, 2:]
    off = np.take_along_axis(shifts, chosen[:, :, None], axis=1)
    power = power + 2.0 * np.sum(off * error, axis=2) + count * np.sum(off**2, axis=2)
    return np.sqrt(np.maximum(power.sum(axis=1), 0.0) / np.maximum(count.sum(axis=1), 1))


def _gain_interval(
    before: Sequence[np.ndarray], after: Sequence[np.ndarray], names: Sequence[str],
    shift_std: Callable[[str], np.ndarray],
) -> list[float] | None:  # fmt: skip
    """95 % interval of the share of the 3D RMSE that is gone, the same blocks drawn for both, with references that are off by what
    they may be, alike in all of a flight. before, after : [(b, 5)], blocks of each case; names : of their flights."""
    blocks, others = np.concatenate(before), np.concatenate(after)
    if len(blocks) != len(others):
        return None
    rng = np.random.default_rng(1)
    off = {name: rng.standard_normal((BOOTSTRAPS, 3)) * shift_std(name) for name in dict.fromkeys(names)}
    shifts = np.concatenate([np.repeat(off[name][:, None], len(some), axis=1) for name, some in zip(names, before)], axis=1)
    gain = 1.0 - _draws(others, shifts) / np.maximum(_draws(blocks, shifts), 1e-12)
    return [float(x) for x in np.quantile(gain, [0.025, 0.975])] if np.isfinite(gain).all() else None
