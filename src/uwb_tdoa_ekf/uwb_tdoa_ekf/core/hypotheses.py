# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Multiple hypotheses: several yaws and places, until the measurements decide.

A tag that starts anywhere cannot observe its yaw. The yaw becomes observable by motion that both
accelerometer and TDOAs measure. Anchors in a plane leave a mirror ambiguity: the tag may be on
either side. A filter for each yaw and place runs until the TDOAs have decided (multiple model
estimation, e.g. Bar-Shalom et al., Estimation with Applications to Tracking and Navigation, 2001,
section 11.6.2, static case).
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from . import auxiliary
from .memory import HYPOTHESES, N_YAWS
from .state import CHECK_PERIOD, difference, isolate
from .update import GATE

YAW_STD = 0.6  # rad, of the yaw of each hypothesis: their yaws start 90 degrees apart
# minus the log probability relative to the best, above which a hypothesis or a place is dropped
IMPROBABLE = 8.0
MERGED_BELOW, MERGED_WITHIN = 0.1, 0.3  # rad and m: two hypotheses that are closer are merged
ALIKE = 0.35  # rad; hypotheses that are closer have one yaw for who uses it
LARGEST_NIS = GATE**2  # normalized innovation squared; limits the weight of a single measurement


@compiled
def yaw_offset(h: int) -> float:
    """Return the yaw of hypothesis h at the start, relative to initial_yaw, in rad."""
    return h % N_YAWS * 2.0 * math.pi / N_YAWS


@compiled
def alive(hypothesis: Record) -> bool:
    """Return False if a HYPOTHESIS was pruned."""
    return hypothesis.log_weight > -np.inf


@compiled
def followed(ekf: Record) -> int:
    """Return the number of hypotheses that are alive."""
    count = 0
    for h in range(HYPOTHESES):
        count += alive(ekf.hypotheses[h])
    return count


@compiled
def alike(ekf: Record) -> bool:
    """Return whether the attitudes of all hypotheses that are alive differ by less than ALIKE."""
    best = ekf.hypotheses[ekf.best].x
    for h in range(HYPOTHESES):
        if alive(ekf.hypotheses[h]):
            apart = difference(best, ekf.hypotheses[h].x)
            if apart[6] ** 2 + apart[7] ** 2 + apart[8] ** 2 > ALIKE**2:
                return False
    return True


@compiled
def set_state(hypothesis: Record, x: np.ndarray, covariance: np.ndarray) -> None:
    """Set position and velocity x (6,) of a HYPOTHESIS and their covariance (6, 6).

    They are then independent of attitude and biases, which stay the same. An inverse is symmetric up
    to rounding; the covariance of a hypothesis is symmetric.
    """
    auxiliary.forget(hypothesis)
    hypothesis.x[:6] = x
    hypothesis.P[:6, :] = 0.0
    hypothesis.P[:, :6] = 0.0
    hypothesis.P[:6, :6] = 0.5 * (covariance + covariance.T)


@compiled
def set_states(ekf: Record, x: np.ndarray, covariance: np.ndarray) -> None:
    """Set position and velocity of all hypotheses, see `set_state`."""
    for h in range(HYPOTHESES):
        set_state(ekf.hypotheses[h], x, covariance)


@compiled
def set_yaw_variance(hypothesis: Record, variance: float) -> None:
    """Set the variance of the yaw of a HYPOTHESIS, in rad^2, independent of all other states."""
    isolate(hypothesis.P, 8, variance)


@compiled
def add_log_likelihood(
    hypothesis: Record, innovation: Record, correlation_length: float, share: float = 1.0
) -> None:
    """Add the Gaussian log likelihood of an INNOVATION to the weight of a HYPOTHESIS.

    Parameters
    ----------
    hypothesis : HYPOTHESIS
        Updated in place.
    innovation : INNOVATION
        After `update.project`.
    correlation_length : float
        Number of measurements that count as a single independent one, see update.py.
    share : float
        Power of the likelihood, 0 to 1.
    """
    variance = innovation.prior_variance + innovation.noise_variance * correlation_length
    nis = min(innovation.value**2 / variance, LARGEST_NIS)
    hypothesis.log_weight -= 0.5 * share * (nis + math.log(variance))


@compiled
def select(ekf: Record, t: float) -> bool:
    """Select the most probable hypothesis, prune improbable ones and merge equal ones.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    t : float
        Stamp, s.

    Returns
    -------
    bool
        Whether a single hypothesis is left.
    """
    best = 0
    for h in range(HYPOTHESES):
        if ekf.hypotheses[h].log_weight > ekf.hypotheses[best].log_weight:
            best = h
    highest = ekf.hypotheses[best].log_weight
    for h in range(HYPOTHESES):
        hypothesis = ekf.hypotheses[h]
        hypothesis.log_weight -= highest
        if hypothesis.log_weight < -IMPROBABLE:
            hypothesis.log_weight = -np.inf
    ekf.best = best
    alone = followed(ekf) == 1
    if t < ekf.next_merge:
        return alone
    ekf.next_merge = t + CHECK_PERIOD
    for h in range(HYPOTHESES):
        for other in range(HYPOTHESES):
            one, better = ekf.hypotheses[h], ekf.hypotheses[other]
            if not alive(one) or (better.log_weight, -other) <= (one.log_weight, -h):
                continue
            apart = difference(better.x, one.x)
            turned = apart[6] ** 2 + apart[7] ** 2 + apart[8] ** 2
            away = apart[0] ** 2 + apart[1] ** 2 + apart[2] ** 2
            if turned < MERGED_BELOW**2 and away < MERGED_WITHIN**2:
                one.log_weight = -np.inf
    return alone


@compiled
def add_spread_of_means(ekf: Record, covariance: np.ndarray) -> None:
    """Add the spread of the means of all hypotheses to a covariance.

    Parameters
    ----------
    ekf : EKF
        State of the filter.
    covariance : (9, 9) array
        Covariance of position, velocity and attitude of the best hypothesis. The mean squared
        distance of the other hypotheses is added in place.
    """
    best = ekf.hypotheses[ekf.best]
    weights = 0.0
    for h in range(HYPOTHESES):
        weights += math.exp(ekf.hypotheses[h].log_weight)
    for h in range(HYPOTHESES):
        other = ekf.hypotheses[h]
        if h != ekf.best and alive(other):
            apart = np.array(difference(best.x, other.x))
            share = math.exp(other.log_weight) / weights
            covariance += np.outer(share * apart, apart)
