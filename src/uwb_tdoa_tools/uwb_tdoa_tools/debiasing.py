# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fit bias maps of positions, apply them to flights, and report the change.

Flights, and places where a tag stood still, give a map. Cross-validation over flights scales it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import read_head
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.survey import read_named_anchors
from uwb_tdoa_bias.correction.corrector import Corrector, orientation_remarks
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.debias import BiasMap, Part, fit
from uwb_tdoa_ekf.offline import run_offline
from uwb_tdoa_ekf.results import Odometry

from .choices import NONE
from .readers.inputs import Reading, report_remarks
from .readers.tables import read_numbers
from .scoring.evaluation import corrected_truth, evaluate, with_aligned_truth
from .scoring.metrics import (
    SHARES,
    Score,
    Shrinkage,
    best_share,
    change_in_words,
    gain,
    gain_in_words,
    position_at,
)

Scored = tuple[Flight, Score, Odometry]  # flight, errors, and estimate


def debiased(odometry: Odometry, bias_map: BiasMap) -> Odometry:
    """Return odometry with the positions and covariances that debias_node publishes."""
    covariance = odometry.covariance.copy()
    p, covariance[:, :3, :3], _ = bias_map.correct(odometry.p, covariance[:, :3, :3])
    return replace(odometry, p=p, covariance=covariance)


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
        See `scoring.evaluation.align_truth`.
    """

    reading: Reading = Reading()
    config: FilterConfig | None = None
    effects: EffectSet | None = None
    align: str = NONE

    def __call__(self, recording: tuple[Path, str | Path | None]) -> Scored:
        """Return the flight of (path, survey) with ground truth, its Score and its Odometry.

        Raises InputError without ground truth. Other references serve `diagnose`, which corrects
        before the filter. A map of the path of the filter would repeat its error.
        """
        flight = self.reading.read(recording)
        report_remarks(flight.name, orientation_remarks(flight.anchors, self.effects))
        if flight.truth is None:
            raise InputError(
                f"{flight.name}: it holds no ground truth to map the bias with; diagnose "
                "--reference heights, odometry or marks finds what is "
                "wrong without it, and --effects takes that."
            )
        flight = with_aligned_truth(flight, self.effects, self.config, self.align)
        score, run = evaluate(flight, self.config, self.effects)
        return flight, score, run.odometry


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

    Raises
    ------
    InputError
        If the anchors of a flight are not those of the map.
    """
    out = []
    for flight, score, odometry in flown:
        if not bias_map.belongs_to(flight.anchors):
            raise InputError(
                f"{flight.name}: its anchors are not those that the map was made for, and "
                "elsewhere it does harm; make one for them with debias fit."
            )
        after = evaluate_map((flight, score, odometry), bias_map, effects)
        sides = {"before": score.row(), "after": after.row()}
        airborne = odometry.p[(odometry.t >= score.first) & (odometry.t <= score.last)]
        figures = {side: {name: row[name] for name in _RUN} for side, row in sides.items()}
        out.append(
            {
                "flight": flight.name,
                **figures,
                "known": float(np.mean(bias_map.validity(airborne[:, :2]) == 1.0)),
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


LEAST = 10  # positions of flights, 5 ms apart, least number for a marker
COLUMNS = ("true_x", "true_y", "x", "y")
SETTLE = 1.0  # s, excluded at the start of each place
REST = 0.02  # m, largest motion at rest within SETTLE
SHORTEST = 100  # positions, least number at one place


def part_of(score: Score, odometry: Odometry) -> Part:
    """Return airborne estimates of a flight with their true positions, at the stamps of the Score."""
    measured = odometry.p[(odometry.t >= score.first) & (odometry.t <= score.last)]
    return Part(measured, measured - score.error, score.covariance)


def static_parts(
    path: str | Path, estimator: PositionEstimator = PositionEstimator()
) -> list[Part]:
    """Return one Part for each place where a tag stood still.

    Parameters
    ----------
    path : str or Path
        A CSV file with the columns true_x, true_y, x, y in m, one row per measured position. Or a recording
        with ground truth: the time at rest counts from SETTLE s on.
    estimator : PositionEstimator

    Raises
    ------
    InputError
        If the file holds no position at rest.
    """
    if is_table(path):
        return _from_table(path)
    flight = estimator.reading.one(path)
    if flight.truth is None:
        raise InputError(
            f"{path}: holds no ground truth; record where the tag stood as ground_truth/pose."
        )
    odometry = run_offline(
        flight, estimator.config, Corrector(flight.anchors, estimator.effects)
    ).odometry
    truth = corrected_truth(flight, estimator.effects)
    true, t = position_at(odometry.t, truth), odometry.t
    moved = np.linalg.norm(true - position_at(t - SETTLE, truth), axis=1)
    resting = (moved < REST) & (t > np.min(t, initial=np.inf) + SETTLE)
    stays = np.split(np.arange(len(t)), np.flatnonzero(np.diff(resting)) + 1)
    stays = [rows for rows in stays if len(rows) >= SHORTEST and resting[rows[0]]]
    if not stays:
        raise InputError(
            f"{path}: the tag never stands still for long enough; give it as a flight, not "
            "with --static."
        )
    return [Part(odometry.p[rows], true[rows], odometry.covariance[rows, :3, :3]) for rows in stays]


def is_table(path: str | Path) -> bool:
    """Return whether a file is a CSV of positions."""
    return not Path(path).is_dir() and b"true_x" in read_head(
        path, 1000, "recording or CSV file of positions"
    )


def _from_table(path: str | Path) -> list[Part]:
    table = read_numbers(path, COLUMNS)
    if not len(table):
        raise InputError(f"{path}: holds no positions; give one row for each.")
    _, place = np.unique(table[:, :2], axis=0, return_inverse=True)
    stays = (table[place.ravel() == k] for k in range(place.max() + 1))
    return [Part(stay[:, 2:], stay[:, :2]) for stay in stays]


FEWEST = 2  # flights; a single one cannot be validated


def fit_map(
    flown: Iterable[Scored],
    static: Sequence[str | Path],
    estimator: PositionEstimator,
    step: float = 0.35,
) -> BiasMap:
    """Fit a bias map.

    Parameters
    ----------
    flown : iterable
        Results of a PositionEstimator.
    static : sequence of path
        See `static_parts`.
    estimator : PositionEstimator
    step : float
        Spacing of the markers, m.

    Raises
    ------
    InputError
        If the anchors are unknown or differ.
    """
    parts = [part for path in static for part in static_parts(path, estimator)]
    flown = list(flown)
    parts += [part_of(score, odometry) for _, score, odometry in flown]
    anchors = _anchors([flight.anchors for flight, _, _ in flown], static, estimator)
    source = ", ".join(
        [flight.name for flight, _, _ in flown] + [Path(path).name for path in static]
    )
    return replace(
        fit(parts, step, LEAST if flown else 1),
        frame=anchors.frame,
        ids=anchors.ids,
        positions=anchors.positions,
        source=source,
    )


def _anchors(
    of_flights: Sequence[Anchors], static: Sequence[str | Path], estimator: PositionEstimator
) -> Anchors:
    """Return the anchors of all flights and recordings.

    Raises
    ------
    InputError
        If they differ, or tables have none.
    """
    found = list(of_flights)
    found += [estimator.reading.one(path).anchors for path in static if not is_table(path)]
    if not found:
        survey = estimator.reading.survey
        if survey is None or Path(survey).is_dir():
            raise InputError(
                f"--survey: {', '.join(map(str, static))} holds no anchors, and a map holds "
                "for one constellation; give the file of their survey."
            )
        found = [read_named_anchors(survey).anchors]
    first = found[0]
    if not all(other.stand_at(first.ids, first.positions, first.frame) for other in found):
        raise InputError(
            "FLIGHT: the flights are of different anchors or frames, and a map holds for one "
            "constellation; map them one by one."
        )
    return first


def cross_validated(
    flown: Sequence[Scored],
    static: Sequence[str | Path],
    estimator: PositionEstimator,
    step: float,
) -> Shrinkage | None:
    """Return the Shrinkage of maps, or None for fewer than FEWEST flights.

    Each map is fitted without one flight and evaluated on it. `step` is that of `fit_map`.
    """
    if len(flown) < FEWEST:
        return None
    errors: dict[str, dict[float | None, float]] = {}
    for number, one in enumerate(flown, start=1):
        made = fit_map([other for other in flown if other is not one], static, estimator, step)
        flight, score, _ = one
        name = flight.name if flight.name not in errors else f"{flight.name} ({number})"
        errors[name] = {None: score.row()["rmse_3d"]}
        for share in SHARES:
            after = evaluate_map(one, made.scaled(share), estimator.effects)
            errors[name][share] = after.row()["rmse_3d"]
    return Shrinkage(best_share(errors), errors)
