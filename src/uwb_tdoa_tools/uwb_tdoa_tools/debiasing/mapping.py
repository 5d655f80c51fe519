"""A bias map from flights and from places where a tag stood still, scaled to the share that
cross-validation over flights supports.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.debias import fit

from ..readers import read_survey
from ..scoring.gains import SHARES, Shrinkage, best_share
from .evaluation import evaluate_map
from .parts import LEAST, is_table, part_of, static_parts

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from uwb_tdoa_bias.foundation.anchors import Anchors
    from uwb_tdoa_ekf.debias import BiasMap

    from .evaluation import PositionEstimator, Scored

FEWEST = 2  # flights; one alone leaves none to judge


def fit_map(
    flown: Iterable[Scored],
    static: Sequence[str | Path],
    estimator: PositionEstimator,
    step: float = 0.35,
    planar: bool = False,
    interpolator: str = "thin_plate",
) -> BiasMap:
    """BiasMap of flights, as a PositionEstimator gave them, and of files of a tag that stood still.
    Raises InputError.

    static : paths, see `static_parts`; step : m; planar, interpolator : see
        `uwb_tdoa_ekf.debias.fit`.
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
    """The Anchors of all flights and recordings.

    Raises InputError where they differ, or a table comes without.
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
    """Shrinkage of maps, each made without one of the flights that a PositionEstimator gave and
    judged on it; None for fewer than FEWEST. static, options : as of `fit_map`.
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
            errors[name][share] = evaluate_map(one, made.scaled(share), estimator.effects).row()[
                "rmse_3d"
            ]
    return Shrinkage(best_share(errors), errors)
