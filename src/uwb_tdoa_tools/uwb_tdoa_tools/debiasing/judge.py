"""Flights before and after a bias map."""

from dataclasses import replace

from ..scoring.evaluation import evaluate, judging_truth
from ..scoring.metrics import Score


def debiased(odometry, bias_map):
    """The Odometry, of run_offline, that debias_node would make of it: another position and its covariance."""
    covariance = odometry.covariance.copy()
    p, covariance[:, :3, :3], _ = bias_map.correct(odometry.p, covariance[:, :3, :3])
    return replace(odometry, p=p, covariance=covariance)


def fly(flight, config=None, effects=None):
    """(Flight, Score, odometry) of a Flight with ground truth, run through the filter. Raises InputError."""
    score, run = evaluate(flight, config, effects)
    return flight, score, run.odometry


def judge(flown, bias_map, effects=None):
    """Score of a flight from `fly` with its positions corrected by a BiasMap. effects : those it was flown with."""
    flight, _, odometry = flown
    return Score(flight.name, debiased(odometry, bias_map), judging_truth(flight, effects))
