# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fit a bias map to flights and to places where a tag stood still.

Cross-validation over flights scales the map.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import read_head
from uwb_tdoa_bias.correction.corrector import Corrector
from uwb_tdoa_ekf.debias import Part, fit
from uwb_tdoa_ekf.offline import run_offline

from ..readers import read_survey
from ..readers.tables import read_numbers
from ..scoring.evaluation import corrected_truth
from ..scoring.gains import SHARES, Shrinkage, best_share
from ..scoring.metrics import position_at
from .evaluation import PositionEstimator, evaluate_map

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from uwb_tdoa_bias.common.anchors import Anchors
    from uwb_tdoa_ekf.debias import BiasMap
    from uwb_tdoa_ekf.results import Odometry

    from ..scoring.metrics import Score
    from .evaluation import Scored


LEAST = 10  # positions of flights, 5 ms apart, least number for a marker
COLUMNS = ("true_x", "true_y", "true_z", "x", "y", "z")
SETTLE = 1.0  # s, excluded at the start of each place
REST = 0.02  # m, largest motion at rest within SETTLE
SHORTEST = 100  # positions, least number at one place


def part_of(score: Score, odometry: Odometry) -> Part:
    """Return airborne estimates of a flight with their true positions, at the stamps of the Score."""
    measured = odometry.p[(odometry.t >= score.first) & (odometry.t <= score.last)]
    return Part(measured, measured - score.error, score.covariance)


def static_parts(
    path: str | Path, estimator: PositionEstimator = PositionEstimator(), planar: bool = False
) -> list[Part]:
    """Return one Part for each place where a tag stood still.

    Parameters
    ----------
    path : str or Path
        A CSV file with the columns true_x, true_y, true_z, x, y, z in m, one row per measured position,
        without z if planar. Or a recording with ground truth: the time at rest counts from SETTLE s on.
    estimator : PositionEstimator
    planar : bool

    Raises
    ------
    InputError
        If the file holds no position at rest.
    """
    if is_table(path):
        return _from_table(path, planar)
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
    return not Path(path).is_dir() and b"true_x" in read_head(path, 1000)


def _from_table(path: str | Path, planar: bool) -> list[Part]:
    names = [name for name in COLUMNS if not (planar and name.endswith("z"))]
    table = read_numbers(path, names)
    if not len(table):
        raise InputError(f"{path}: holds no positions; give one row for each.")
    d = len(names) // 2
    _, place, counts = np.unique(table[:, :d], axis=0, return_inverse=True, return_counts=True)
    true, measured = (np.pad(side, ((0, 0), (0, 3 - d))) for side in (table[:, :d], table[:, d:]))
    return [
        Part(measured[rows], true[rows])
        for rows in np.split(np.argsort(place.ravel(), kind="stable"), np.cumsum(counts)[:-1])
    ]


FEWEST = 2  # flights; a single one cannot be validated


def fit_map(
    flown: Iterable[Scored],
    static: Sequence[str | Path],
    estimator: PositionEstimator,
    step: float = 0.35,
    planar: bool = False,
    interpolator: str = "thin_plate",
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
    planar, interpolator
        See `uwb_tdoa_ekf.debias.fit`.

    Raises
    ------
    InputError
        If the anchors are unknown or differ.
    """
    parts = [part for path in static for part in static_parts(path, estimator, planar)]
    flown = list(flown)
    parts += [part_of(score, odometry) for _, score, odometry in flown]
    anchors = _anchors([flight.anchors for flight, _, _ in flown], static, estimator)
    source = ", ".join(
        [flight.name for flight, _, _ in flown] + [Path(path).name for path in static]
    )
    return fit(parts, step, LEAST if flown else 1, planar, interpolator, anchors, source)


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
        found = [read_survey(survey)]
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
    **options: Any,
) -> Shrinkage | None:
    """Return the Shrinkage of maps, or None for fewer than FEWEST flights.

    Each map is fitted without one flight and evaluated on it. `options` are those of `fit_map`.
    """
    if len(flown) < FEWEST:
        return None
    errors: dict[str, dict[float | None, float]] = {}
    for number, one in enumerate(flown, start=1):
        made = fit_map([other for other in flown if other is not one], static, estimator, **options)
        flight, score, _ = one
        name = flight.name if flight.name not in errors else f"{flight.name} ({number})"
        errors[name] = {None: score.row()["rmse_3d"]}
        for share in SHARES:
            after = evaluate_map(one, made.scaled(share), estimator.effects)
            errors[name][share] = after.row()["rmse_3d"]
    return Shrinkage(best_share(errors), errors)
