# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run the filter with the model before and after, and compare errors with their uncertainty.

Where errors are unknown, it compares innovations.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.special import stdtrit

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.correction.corrector import Corrector, FixedPoseCorrector, FixedPoses
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.effects.sensor import shifted
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import Run, run_offline
from uwb_tdoa_ekf.results import VERDICTS
from uwb_tdoa_ekf.smoother import RANGES

from ..cli import as_json
from ..clock import numbered
from ..parallel import MapFunction
from ..scoring.metrics import (
    EVERYTHING,
    LOSS,
    NO_DIFFERENCE,
    Score,
    clear_change,
    gain,
    nis,
    pooled,
    radio_residuals,
)
from .regression.table import BLOCK

Spans = tuple[tuple[float, float], ...]  # (first, last) s

BOOTSTRAPS = 400  # number of bootstrap samples
Z95 = 1.96  # standard deviations, half of a 95 % interval
# Prior of the spread of the logarithm of error after over before between flights: standard deviation,
# and how many flights it counts for.
SPREAD, SPREAD_FLIGHTS = 0.2, 4
# Standard deviations by which a gain must exceed 0 if the reference itself has errors. Fitted
# effects follow the common error of the references in any direction: chi distribution with three
# degrees of freedom, 99.9 %.
SURE = 4.0
USED = next(value for value, name in VERDICTS.items() if name == "used")


@dataclass(frozen=True, eq=False)
class ValidationCase:
    """A flight, and an EffectSet that was not fitted to its judged part.

    spans : ((first, last), ...) s that are judged, None for all
    reach : the same for phases; spans at the ends of the flight extend to its begin and end
    untold : m^2, power of the error that another flight may have on top
    """

    flight: Flight
    effects: EffectSet
    spans: Spans | None = None
    reach: Spans = EVERYTHING
    untold: float = 0.0


class Baseline:
    """The model before: runs of the filter with it, one per flight."""

    def __init__(self, base: EffectSet, config: FilterConfig | None = None) -> None:
        """Take the EffectSet before, and the FilterConfig."""
        self.base, self.config = base, config
        self._runs: dict[int, tuple[Flight, Run]] = {}

    def run(self, flight: Flight) -> Run:
        """Return the Run of a Flight, computed once."""
        self.prepare([flight])
        return self._runs[id(flight)][1]

    def prepare(
        self,
        flights: Sequence[Flight],
        progress: Callable[[], object] = lambda: None,
        map_function: MapFunction = map,
    ) -> None:
        """Compute the missing runs of Flights.

        map_function : as of `attribute`
        """
        missing = [flight for flight in flights if id(flight) not in self._runs]
        missing = list({id(flight): flight for flight in missing}.values())
        cases = [ValidationCase(flight, self.base) for flight in missing]
        for run, flight in zip(map_function(partial(run_of, self.config), cases), missing):
            self._runs[id(flight)] = flight, run  # the flight is kept, because its id is the key
            progress()


def compare(
    cases: Sequence[ValidationCase],
    baseline: Baseline,
    progress: Callable[[], object] = lambda: None,
    shift_std: Callable[[str], np.ndarray] = lambda name: np.zeros(3),
    map_function: MapFunction = map,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Run the filter on ValidationCases before and after, and return both sides.

    A side is {"runs": [...], "pooled": {...}, "scores": [Score]}. Keys are those of evaluate,
    phases included. Further keys are residual_spread (m, 1.48 MAD of the innovations) and
    rmse_3d_ci (95 %, bootstrap over blocks of 5 s). rmse_3d_gain_ci includes errors of the
    references that are common to a flight. rmse_3d_gain_elsewhere is of another flight.

    shift_std : as of a Reference; map_function : as of `attribute`
    """
    sides = _both_sides(cases, baseline, progress, map_function)
    before, after = (_side(runs) for runs in sides)
    after["pooled"].update(_intervals(before, after, shift_std))
    return before, after


def with_config(
    cases: Sequence[ValidationCase],
    before: dict[str, Any],
    config: FilterConfig,
    shift_std: Callable[[str], np.ndarray] = lambda name: np.zeros(3),
    map_function: MapFunction = map,
) -> dict[str, Any]:
    """Return the side of ValidationCases that are run with another FilterConfig.

    before : side of `compare` that the gain is counted from; shift_std, map_function : as there
    """
    after = _side(zip(cases, map_function(partial(run_of, config), cases)))
    after["pooled"].update(_intervals(before, after, shift_std))
    return after


def _side(runs: Iterable[tuple[ValidationCase, Run]]) -> dict[str, Any]:
    """Return one side of `compare`, without the interval of the gain."""
    scores, rows = [], []
    for case, run in runs:
        scores.append(score(case, run))
        row = {**as_json(scores[-1].row()), "phases": as_json(scores[-1].phases())}
        row["rmse_3d_elsewhere"] = float(np.hypot(row["rmse_3d"], np.sqrt(case.untold)))
        interval = _interval([_blocks(scores[-1])])
        rows.append({**row, "residual_spread": _spread(run), "rmse_3d_ci": interval})
    spreads = [row["residual_spread"] for row in rows if row["residual_spread"] is not None]
    together = {
        **as_json(pooled(scores)),
        "residual_spread": float(np.mean(spreads)) if spreads else None,
        "rmse_3d_ci": _interval([_blocks(one) for one in scores]),
    }
    return {"runs": rows, "pooled": together, "scores": scores}


def innovations(
    cases: Sequence[ValidationCase],
    baseline: Baseline,
    progress: Callable[[], object] = lambda: None,
    map_function: MapFunction = map,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return (before, after) as `compare` does, with figures of innovations only.

    It is used where errors are unknown.
    """
    sides = []
    for runs in _both_sides(cases, baseline, progress, map_function):
        rows = []
        for case, run in runs:
            figures: dict[str, Any] = {
                "nis_mean": float(nis(radio_residuals(case.flight, run)).mean()),
                "residual_spread": _spread(run),
            }
            rows.append({"flight": case.flight.name, "rmse_3d": None, **figures})
        means = {
            key: float(np.mean([row[key] for row in rows if row[key] is not None]))
            for key in ("nis_mean", "residual_spread")
        }
        sides.append({"runs": rows, "pooled": dict(means, rmse_3d=None), "scores": []})
    return sides[0], sides[1]


def score(case: ValidationCase, run: Run) -> Score:
    """Return the Score of a Run on a ValidationCase; raise InputError without an estimate."""
    truth = shifted(case.flight, "truth", -case.effects.stamp_offset("truth")).truth
    assert truth is not None  # the Reference knows the errors
    out = Score(
        case.flight.name,
        run.odometry,
        truth,
        radio_residuals(case.flight, run),
        case.flight.tdoa.t,
        case.spans,
        case.reach,
    )
    if not len(out.t):
        raise InputError(
            f"{case.flight.name}: the filter gives no estimate in the part to judge on; see "
            "what evaluate says."
        )
    return out


def why_not(before: dict[str, Any], after: dict[str, Any], shift_std: float) -> str | None:
    """Return why the result of `compare` must not be applied; None if it may.

    shift_std : m, standard deviation of a reference error common to a flight; the gain must exceed
        SURE standard deviations of its effect
    """
    sides = before["pooled"]["rmse_3d"], after["pooled"]["rmse_3d"]
    interval = after["pooled"]["rmse_3d_gain_ci"]
    change = clear_change(*sides, interval)
    much = f"{100 * sides[0]:.1f} -> {100 * sides[1]:.1f} cm"
    if interval:
        much += f", 95 % interval of the gain {100 * interval[0]:.0f} to {100 * interval[1]:.0f} %"
    if change < 0:  # the error rises
        return f"together they make the error larger on held-out data ({much})"
    if shift_std > 0.0 and (
        interval is None or sum(interval) < SURE / Z95 * (interval[1] - interval[0])
    ):
        return (
            f"all of a flight may be {100 * shift_std:.0f} cm from where the reference says, "
            "on each axis, and the gain is less than that "
            "can feign; measure more marks, or better ones"
        )
    if change == 0:
        return f"together they make {NO_DIFFERENCE} ({much})"
    for old, new in zip(before.get("runs", ()), after.get("runs", ())):
        if gain(old["rmse_3d"], new["rmse_3d"]) < -LOSS:
            worse = f"{100 * old['rmse_3d']:.1f} -> {100 * new['rmse_3d']:.1f} cm"
            return f"together they make the error larger on a part of {old['flight']} ({worse})"
    return None


def _both_sides(
    cases: Sequence[ValidationCase],
    baseline: Baseline,
    progress: Callable[[], object],
    map_function: MapFunction,
) -> Iterator[Iterator[tuple[ValidationCase, Run]]]:
    """Yield the cases with runs of the baseline, then with their own runs, computed on demand."""
    baseline.prepare([case.flight for case in cases], progress, map_function)
    yield ((replace(case, effects=baseline.base), baseline.run(case.flight)) for case in cases)

    def after() -> Iterator[tuple[ValidationCase, Run]]:
        for case, run in zip(cases, map_function(partial(run_of, baseline.config), cases)):
            yield case, run
            progress()

    yield after()


def run_of(
    config: FilterConfig | None, case: ValidationCase, poses: FixedPoses | None = None
) -> Run:
    """Return the Run of a ValidationCase.

    poses : poses for the corrections; None corrects at the poses of the run, as nodes do
    """
    anchors, effects = case.flight.anchors, case.effects
    corrector = (
        Corrector(anchors, effects)
        if poses is None
        else FixedPoseCorrector(anchors, effects, poses)
    )
    return run_offline(case.flight, config, corrector)


def _spread(run: Run) -> float | None:
    """Return 1.48 MAD of the innovations of the used TDOAs of a Run, or of its ranges without any, m."""
    innovation, verdict = run.residuals.innovation, run.residuals.verdict
    if not len(innovation) and RANGES in run.sensors:
        innovation, verdict = (run.sensors[RANGES][key] for key in ("innovation", "verdict"))
    used = innovation[verdict == USED]
    return float(1.4826 * np.median(np.abs(used))) if len(used) else None


def _blocks(judged: Score) -> np.ndarray:
    """Return sums per block of 5 s, (b, 5): squared 3D errors m^2, counts, errors x, y, z m."""
    if not len(judged.t):
        return np.zeros((1, 5))
    block = numbered(judged.t, BLOCK)
    power = np.sum(judged.error**2, axis=1)
    sums = [np.bincount(block, e) for e in judged.error.T]
    return np.stack([np.bincount(block, power), np.bincount(block), *sums], axis=1)


def _interval(blocks: Sequence[np.ndarray]) -> list[float] | None:
    """Return the 95 % interval of the 3D RMSE, [low, high] m."""
    together = np.concatenate(blocks)
    return _quantiles(_draws(together, np.zeros((BOOTSTRAPS, len(together), 3))))


def _draws(blocks: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """Return the 3D RMSE of bootstrap samples of blocks, (BOOTSTRAPS,) m.

    blocks : (b, 5), as of `_blocks`; shifts : (BOOTSTRAPS, b, 3) m, added to the errors
    """
    chosen = np.random.default_rng(0).integers(0, len(blocks), (BOOTSTRAPS, len(blocks)))
    power, count, error = blocks[chosen, 0], blocks[chosen, 1], blocks[chosen, 2:]
    off = np.take_along_axis(shifts, chosen[:, :, None], axis=1)
    power = power + 2.0 * np.sum(off * error, axis=2) + count * np.sum(off**2, axis=2)
    return np.sqrt(np.maximum(power.sum(axis=1), 0.0) / np.maximum(count.sum(axis=1), 1))


def _intervals(
    before: dict[str, Any], after: dict[str, Any], shift_std: Callable[[str], np.ndarray]
) -> dict[str, list[float] | None]:
    """Return 95 % intervals of the gain: of the mean of these flights, and of another flight.

    The latter includes what these flights do not tell.

    Logarithms of the error after over before are normal over flights, with unknown mean and spread
    (Gelman et al., Bayesian Data Analysis, section 3.3).
    """
    ratios: dict[str, list[list[float]]] = {}
    for old, new in zip(before["runs"], after["runs"]):
        several = [max(new[key], 1e-9) for key in ("rmse_3d", "rmse_3d_elsewhere")]
        ratios.setdefault(old["flight"], []).append(
            np.log(several) - np.log(max(old["rmse_3d"], 1e-9))
        )
    each, worst = np.array([np.mean(several, axis=0) for several in ratios.values()]).T
    freedom, n = SPREAD_FLIGHTS + len(each) - 1, len(each)
    spread = np.sqrt((SPREAD_FLIGHTS * SPREAD**2 + n * np.var(each)) / freedom)
    half = stdtrit(freedom, 0.975) * spread * np.sqrt(1.0 + 1.0 / n)
    return {
        "rmse_3d_gain_ci": _gain_interval(before, after, shift_std),
        "rmse_3d_gain_elsewhere": [
            float(1.0 - np.exp(worst.mean() + half)),
            float(1.0 - np.exp(each.mean() - half)),
        ],
    }


def _gain_interval(
    before: dict[str, Any], after: dict[str, Any], shift_std: Callable[[str], np.ndarray]
) -> list[float] | None:
    """Return the 95 % interval of the relative decrease of the 3D RMSE between two sides.

    Both sides use the same bootstrap samples. Each sample shifts the reference of each flight.
    """
    each = [_blocks(one) for one in before["scores"]]
    blocks = np.concatenate(each)
    others = np.concatenate([_blocks(one) for one in after["scores"]])
    if len(blocks) != len(others):
        return None
    rng = np.random.default_rng(1)
    names = [one.name for one in before["scores"]]
    off = {
        name: rng.standard_normal((BOOTSTRAPS, 3)) * shift_std(name)
        for name in dict.fromkeys(names)
    }
    of_case = [np.repeat(off[name][:, None], len(some), axis=1) for name, some in zip(names, each)]
    shifts = np.concatenate(of_case, axis=1)
    # The same random seed draws the same blocks for both sides.
    return _quantiles(1.0 - _draws(others, shifts) / np.maximum(_draws(blocks, shifts), 1e-12))


def _quantiles(draws: np.ndarray) -> list[float] | None:
    """Return the 95 % interval of draws, [low, high]; None if a draw is not finite."""
    if not np.isfinite(draws).all():
        return None
    return np.quantile(draws, [0.025, 0.975]).tolist()
