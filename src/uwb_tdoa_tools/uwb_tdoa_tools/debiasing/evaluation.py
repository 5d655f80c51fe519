"""Flights before and after a bias map."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flight import Flight
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.results import Odometry

from ..readers.inputs import Reading
from ..scoring.alignment import NONE
from ..scoring.evaluation import corrected_truth, evaluate, with_aligned_truth
from ..scoring.gains import change_in_words, gain, gain_in_words
from ..scoring.metrics import Score

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from uwb_tdoa_bias.effects import EffectSet
    from uwb_tdoa_ekf.debias import BiasMap


Scored = tuple[Flight, Score, Odometry]  # a flight with its errors and the estimate that has them


def debiased(odometry: Odometry, bias_map: BiasMap) -> Odometry:
    """The Odometry, of run_offline, that debias_node would make of it: another position and its
    covariance.
    """
    covariance = odometry.covariance.copy()
    p, covariance[:, :3, :3], _ = bias_map.correct(odometry.p, covariance[:, :3, :3])
    return replace(odometry, p=p, covariance=covariance)


def estimate_flight(
    flight: Flight,
    config: FilterConfig | None = None,
    effects: EffectSet | None = None,
    align: str = NONE,
) -> Scored:
    """(Flight, Score, odometry) of a Flight with ground truth, run through the filter. Raises
    InputError: what diagnose finds with less, heights, odometry or marks, is corrected before the
    filter, and a map of that path would only repeat the filter's own error.
    """
    if flight.truth is None:
        raise InputError(
            f"{flight.name}: it holds no ground truth to map the bias with; diagnose "
            "--reference heights, odometry or marks finds what is "
            "wrong without it, and --effects takes that."
        )
    flight = with_aligned_truth(flight, effects, config, align)
    score, run = evaluate(flight, config, effects)
    return flight, score, run.odometry


@dataclass(frozen=True)
class PositionEstimator:
    """What positions are estimated with; estimator((path, survey)) is what `fly` gives. Can be
    pickled.

    reading : Reading; config : FilterConfig; effects : EffectSet or None, of the TDOAs before the
        filter; align : as of
    `align_truth`.
    """

    reading: Reading = Reading()
    config: FilterConfig | None = None
    effects: EffectSet | None = None
    align: str = NONE

    def __call__(self, recording: tuple[Path, str | Path | None]) -> Scored:
        return estimate_flight(self.reading.read(recording), self.config, self.effects, self.align)


def require_anchors(flown: Iterable[Scored], bias_map: BiasMap) -> Iterator[Scored]:
    """Yield what `fly` gave; raises InputError for a flight among other anchors than those of a
    BiasMap.
    """
    for one in flown:
        if not bias_map.belongs_to(one[0].anchors):
            raise InputError(
                f"{one[0].name}: its anchors are not those that the map was made for, and "
                "elsewhere it does harm; make one for them with debias fit."
            )
        yield one


def evaluate_map(flown: Scored, bias_map: BiasMap, effects: EffectSet | None = None) -> Score:
    """Score of a flight from `fly` with its positions corrected by a BiasMap. effects : those it
    was flown with.
    """
    flight, _, odometry = flown
    return Score(flight.name, debiased(odometry, bias_map), corrected_truth(flight, effects))


pass


SMALLEST_GAIN = 0.01  # of the 3D RMSE: less is neither gain nor harm
_RUN = ("rmse_x", "rmse_y", "rmse_z", "rmse_3d", "max_3d", "nees_mean")


def map_summary(bias_map: BiasMap) -> str:
    """One line on a BiasMap."""
    figures = map_figures(bias_map)
    added = ", ".join(f"{std:.3f}" for std in figures["added_std"])
    return (
        f"{figures['markers']} markers {figures['step']:g} m apart, "
        f"root mean square of the bias {figures['bias_rms']:.3f} m; "
        f"standard deviations added to a corrected position {added} m"
    )


def map_figures(bias_map: BiasMap) -> dict[str, Any]:
    """The same for JSON."""
    return {
        "markers": len(bias_map.at),
        "step": bias_map.step,
        "interpolator": bias_map.interpolator,
        "planar": bias_map.planar,
        "frame": bias_map.frame,
        "anchors": bias_map.ids.tolist(),
        "source": bias_map.source,
        "bias_rms": float(np.sqrt(np.mean(np.sum(bias_map.bias**2, axis=1)))),
        "added_std": np.sqrt(np.diag(bias_map.added)).tolist(),
    }


def comparison_rows(
    flown: Iterable[Scored], bias_map: BiasMap, effects: EffectSet | None = None
) -> list[dict[str, Any]]:
    """[{"flight", "before": figures, "after": figures, "known"}] of what `fly` gave. known : share
    of the positions that the map knows.
    """
    out = []
    for flight, score, odometry in flown:
        after = evaluate_map((flight, score, odometry), bias_map, effects)
        sides = {"before": score.row(), "after": after.row()}
        airborne = odometry.p[(odometry.t >= score.first) & (odometry.t <= score.last)]
        figures = {side: {name: row[name] for name in _RUN} for side, row in sides.items()}
        out.append(
            {
                "flight": flight.name,
                **figures,
                "known": float(np.mean(bias_map.validity(airborne) == 1.0)),
            }
        )
    return out


def print_rows(title: str, found: Sequence[Mapping[str, Any]]) -> None:
    """Print rows, and their mean."""
    if not found:
        return
    print(
        f"{title:24s}   before: x       y       z      3D    NEES   after: x       y       z  "
        "    3D    NEES   known"
    )
    for row in found:
        print(
            f"{row['flight']:24s}"
            + "".join(_side(row[side]) for side in ("before", "after"))
            + f"{row['known']:8.0%}"
        )
    before, after = (
        np.mean([row[side]["rmse_3d"] for row in found]) for side in ("before", "after")
    )
    print(
        f"mean 3D RMSE {before:.3f} m before, {after:.3f} m after: it {change_in_words(before, after)}"
    )


def mean_gain(found: Sequence[Mapping[str, Any]]) -> float:
    """The `gain` of rows, of their mean 3D RMSE."""
    return gain(
        *(float(np.mean([row[side]["rmse_3d"] for row in found])) for side in ("before", "after"))
    )


def verdict(gained: float, on: str) -> str:
    """One sentence on a `gain`. on : what it was judged on."""
    if does_harm(gained):
        return f"harm: the 3D RMSE {gain_in_words(gained)} on {on}; do not use this map there"
    return f"{'better' if gained >= SMALLEST_GAIN else 'no gain'}: the 3D RMSE {gain_in_words(gained)} on {on}"


def does_harm(gained: float) -> bool:
    """Whether a `gain` is a loss, or no number."""
    return not gained > -SMALLEST_GAIN


def _side(figures: Mapping[str, float]) -> str:
    return "  " + "".join(
        f"{figures[name]:8.3f}" for name in ("rmse_x", "rmse_y", "rmse_z", "rmse_3d", "nees_mean")
    )
