"""The filter run over a flight, and judged."""

from dataclasses import replace

from ..localizing.estimate import Estimator
from .alignment import need_truth
from .metrics import Score


def evaluate(flight, config=None, effects=None, network=None):
    """Run the filter over a Flight with ground truth. Returns (Score, Run). Raises InputError if there is no truth."""
    return score_of(flight, Estimator(config, effects, network))


def score_of(flight, estimator):
    """(Score, Run) of a Flight with ground truth, by an Estimator. Raises InputError if there is no truth, or one on
    another clock."""
    need_truth(flight)
    run = estimator(flight)
    return Score(flight.name, run.odometry, judging_truth(flight, estimator.effects), run.residuals, flight.tdoa.t), run


def judging_truth(flight, effects=None):
    """The Truth to compare estimates with: that of the Flight, without what the EffectSet says is wrong with it."""
    return effects.correct_streams(replace(flight, imu=None)).truth if effects else flight.truth
