# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Estimate flights, apply a bias map, and report the change."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.results import Odometry

from ..choices import NONE
from ..readers.inputs import Reading
from ..scoring.evaluation import corrected_truth, evaluate, with_aligned_truth
from ..scoring.gains import change_in_words, gain, gain_in_words
from ..scoring.metrics import Score

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence
    from pathlib import Path

    from uwb_tdoa_ekf.debias import BiasMap


Scored = tuple[Flight, Score, Odometry]  # flight, errors, and estimate


def debiased(odometry: Odometry, bias_map: BiasMap) -> Odometry:
    """Return odometry with the positions and covariances that debias_node publishes."""
    covariance = odometry.covariance.copy()
    p, covariance[:, :3, :3], _ = bias_map.correct(odometry.p, covariance[:, :3, :3])
    return replace(odometry, p=p, covariance=covariance)


def estimate_flight(
    flight: Flight,
    config: FilterConfig | None = None,
    effects: EffectSet | None = None,
    align: str = NONE,
) -> Scored:
    """Run a flight with ground truth through the filter.

    Parameters
    ----------
    flight : Flight
    config : FilterConfig, optional
    effects : EffectSet, optional
    align : str
        See `align_truth`.

    Returns
    -------
    tuple of Flight, Score and Odometry

    Raises
    ------
    InputError
        If the flight has no ground truth. Other references serve `diagnose`, which corrects before the
        filter. A map of the path of the filter would repeat its error.
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
    """Estimate recordings with fixed settings. It can be pickled.

    Parameters
    ----------
    reading : Reading
    config : FilterConfig, optional
    effects : EffectSet, optional
        Corrections of the TDOAs.
    align : str
        See `align_truth`.
    """

    reading: Reading = Reading()
    config: FilterConfig | None = None
    effects: EffectSet | None = None
    align: str = NONE

    def __call__(self, recording: tuple[Path, str | Path | None]) -> Scored:
        """Return the result of `estimate_flight` for (path, survey)."""
        return estimate_flight(self.reading.read(recording), self.config, self.effects, self.align)


def require_anchors(flown: Iterable[Scored], bias_map: BiasMap) -> Iterator[Scored]:
    """Yield the flights.

    Raises
    ------
    InputError
        If the anchors of a flight are not those of the map.
    """
    for one in flown:
        if not bias_map.belongs_to(one[0].anchors):
            raise InputError(
                f"{one[0].name}: its anchors are not those that the map was made for, and "
                "elsewhere it does harm; make one for them with debias fit."
            )
        yield one


def evaluate_map(flown: Scored, bias_map: BiasMap, effects: EffectSet | None = None) -> Score:
    """Return the Score of an estimated flight after the map. `effects` are those of the estimate."""
    flight, _, odometry = flown
    return Score(flight.name, debiased(odometry, bias_map), corrected_truth(flight, effects))


SMALLEST_GAIN = 0.01  # share of the 3D RMSE, least gain or harm
_RUN = ("rmse_x", "rmse_y", "rmse_z", "rmse_3d", "max_3d", "nees_mean")


def map_summary(bias_map: BiasMap) -> str:
    """Describe a map in one line."""
    figures = map_figures(bias_map)
    added = ", ".join(f"{std:.3f}" for std in figures["added_std"])
    return (
        f"{figures['markers']} markers {figures['step']:g} m apart, "
        f"root mean square of the bias {figures['bias_rms']:.3f} m; "
        f"standard deviations added to a corrected position {added} m"
    )


def map_figures(bias_map: BiasMap) -> dict[str, Any]:
    """Return the figures of a map for JSON."""
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
    """Return figures before and after the map for each flight.

    `known` is the share of positions inside the map.
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
    """Print rows and their mean."""
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
    before, after = mean_errors(found)
    print(
        f"mean 3D RMSE {before:.3f} m before, {after:.3f} m after: it {change_in_words(before, after)}"
    )


def mean_errors(found: Sequence[Mapping[str, Any]]) -> tuple[float, float]:
    """Return the mean 3D RMSE of rows before and after the map, in m."""
    before = float(np.mean([row["before"]["rmse_3d"] for row in found]))
    after = float(np.mean([row["after"]["rmse_3d"] for row in found]))
    return before, after


def mean_gain(found: Sequence[Mapping[str, Any]]) -> float:
    """Return the gain of the mean 3D RMSE of rows."""
    return gain(*mean_errors(found))


def verdict(gained: float, on: str) -> str:
    """Return a sentence on a gain. `on` names the flights."""
    if does_harm(gained):
        return f"harm: the 3D RMSE {gain_in_words(gained)} on {on}; do not use this map there"
    return f"{'better' if gained >= SMALLEST_GAIN else 'no gain'}: the 3D RMSE {gain_in_words(gained)} on {on}"


def does_harm(gained: float) -> bool:
    """Return whether a gain is a loss or NaN."""
    return not gained > -SMALLEST_GAIN


def _side(figures: Mapping[str, float]) -> str:
    return "  " + "".join(
        f"{figures[name]:8.3f}" for name in ("rmse_x", "rmse_y", "rmse_z", "rmse_3d", "nees_mean")
    )
