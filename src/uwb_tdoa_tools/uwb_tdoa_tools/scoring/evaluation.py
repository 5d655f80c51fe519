"""The filter run over a flight, and judged."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from ..estimate import FlightEstimator
from .alignment import need_truth
from .metrics import Score

if TYPE_CHECKING:
    from uwb_tdoa_bias.correction.network import Network
    from uwb_tdoa_bias.effects.effect_set import EffectSet
    from uwb_tdoa_bias.foundation.flight import Flight, Truth
    from uwb_tdoa_ekf.core.config import FilterConfig
    from uwb_tdoa_ekf.offline import Run


def evaluate(
    flight: Flight,
    config: FilterConfig | None = None,
    effects: EffectSet | None = None,
    network: Network | None = None,
) -> tuple[Score, Run]:
    """Run the filter over a Flight with ground truth.

    Returns (Score, Run). Raises InputError if there is no truth.
    """
    return score_of(flight, FlightEstimator(config, effects, network))


def score_of(flight: Flight, estimator: FlightEstimator) -> tuple[Score, Run]:
    """(Score, Run) of a Flight with ground truth, by a FlightEstimator. Raises InputError if there
    is no truth, or one on another clock.
    """
    need_truth(flight)
    run = estimator(flight)
    return Score(
        flight.name,
        run.odometry,
        corrected_truth(flight, estimator.effects),
        run.residuals,
        flight.tdoa.t,
    ), run


def corrected_truth(flight: Flight, effects: EffectSet | None = None) -> Truth:
    """The Truth to compare estimates with: that of the Flight, which has one, without what the
    EffectSet says is wrong with it.
    """
    truth = effects.correct_streams(replace(flight, imu=None)).truth if effects else flight.truth
    assert truth is not None
    return truth
