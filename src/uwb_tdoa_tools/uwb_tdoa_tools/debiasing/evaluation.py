"""Flights before and after a bias map."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flight import Flight
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.results import Odometry

from ..readers.inputs import Reading
from ..scoring.alignment import NONE
from ..scoring.evaluation import corrected_truth, evaluate, with_aligned_truth
from ..scoring.metrics import Score

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    from uwb_tdoa_ekf.debias import BiasMap


Scored = tuple[Flight, Score, Odometry]  # a flight with its errors and the estimate that has them


def debiased(odometry: Odometry, bias_map: BiasMap) -> Odometry:
    """The Odometry, of run_offline, that debias_node would make of it: another position and its
    covariance.
    """
    covariance = odometry.covariance.copy()
    p, covariance[:, :3, :3], _ = bias_map.correct(odometry.p, covariance[:, :3, :3])
    return replace(odometry, p=p, covariance=covariance)


def fly(
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
        return fly(self.reading.read(recording), self.config, self.effects, self.align)


def of_its_anchors(flown: Iterable[Scored], bias_map: BiasMap) -> Iterator[Scored]:
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
