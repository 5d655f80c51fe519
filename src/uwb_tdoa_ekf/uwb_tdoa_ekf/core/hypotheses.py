"""Several yaws and places at once, while nobody knows which is right.

A tag that starts anywhere cannot see its yaw: only motion that its accelerometer feels and its
TDOAs see makes it observable. Anchors in a plane do not determine on which side of it a tag is. One
filter per direction and place runs until the TDOAs have decided (multiple model estimation, e.g.
Bar-Shalom et al., Estimation with Applications to Tracking and Navigation, 2001, section 11.6.2,
static case).
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from .memory import HYPOTHESES, N_YAWS
from .state import difference

YAW_STD = 0.6  # rad, of each hypothesis: they start 90 degrees apart
PRUNED_BELOW = -8.0  # log probability relative to the best at which a hypothesis is pruned
MERGED_BELOW, MERGED_WITHIN = 0.1, 0.3  # rad and m between two hypotheses that have become one
MERGE_PERIOD = 0.1  # s
LARGEST_NIS = 9.0  # normalised innovation squared that one measurement counts as at most


@compiled
def yaw_offset(h: int) -> float:
    """Angle of hypothesis h to initial_yaw, rad."""
    return h % N_YAWS * 2.0 * math.pi / N_YAWS


@compiled
def alive(hypothesis: Record) -> bool:
    """False once it was pruned."""
    return hypothesis.log_weight > -np.inf


@compiled
def add_log_likelihood(hypothesis: Record, innovation: Record, correlation_length: float) -> None:
    """Weigh a HYPOTHESIS by the Gaussian density of an INNOVATION; correlation_length as in
    robust.py.
    """
    variance = innovation.prior_variance + innovation.noise_variance * correlation_length
    nis = min(innovation.value**2 / variance, LARGEST_NIS)
    hypothesis.log_weight -= 0.5 * (nis + math.log(variance))


@compiled
def select(ekf: Record, t: float) -> bool:
    """Follow the most probable hypothesis at stamp t; prune those that are improbable, or have
    become the same. Returns whether one is left.
    """
    best = followed = 0
    for h in range(HYPOTHESES):
        if ekf.hypotheses[h].log_weight > ekf.hypotheses[best].log_weight:
            best = h
    highest = ekf.hypotheses[best].log_weight
    for h in range(HYPOTHESES):
        hypothesis = ekf.hypotheses[h]
        hypothesis.log_weight -= highest
        if hypothesis.log_weight < PRUNED_BELOW:
            hypothesis.log_weight = -np.inf
        followed += alive(hypothesis)
    ekf.best = best
    if t < ekf.next_merge:
        return followed == 1
    ekf.next_merge = t + MERGE_PERIOD
    for h in range(HYPOTHESES):
        for other in range(HYPOTHESES):
            one, better = ekf.hypotheses[h], ekf.hypotheses[other]
            if not alive(one) or (better.log_weight, -other) <= (one.log_weight, -h):
                continue
            apart = difference(better.x, one.x)
            turned, away = (
                apart[6] ** 2 + apart[7] ** 2 + apart[8] ** 2,
                apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2,
            )
            if turned < MERGED_BELOW**2 and away < MERGED_WITHIN**2:
                one.log_weight = -np.inf
    return followed == 1


@compiled
def add_spread_of_means(ekf: Record, covariance: np.ndarray) -> None:
    """Add to the (9, 9) covariance of the best hypothesis what the others say: their mean square
    distance from it.
    """
    best = ekf.hypotheses[ekf.best]
    weights = 0.0
    for h in range(HYPOTHESES):
        weights += math.exp(ekf.hypotheses[h].log_weight)
    for h in range(HYPOTHESES):
        other = ekf.hypotheses[h]
        if h != ekf.best and alive(other):
            apart = difference(best.x, other.x)
            share = math.exp(other.log_weight) / weights
            for i in range(9):
                for j in range(9):
                    covariance[i, j] += share * apart[i] * apart[j]
