"""One scalar measurement against the state, whatever it measures.

A kind of measurement fills an INNOVATION: which error states it depends on and how, by how much it
differs from what the state predicts, and the variance of its noise. The rest is the same for all:
`project`, then `kalman`, by way of `robust.update` if the measurement may be an outlier.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from . import auxiliary
from .state import ERROR_STATES, inject

LONGEST_ROW = 6  # error states that one measurement may depend on
JOINT_STATES = ERROR_STATES + auxiliary.OFFSET_STATES

INNOVATION = np.dtype(
    [
        # the error states that the Jacobian row h has an entry for,
        ("states", np.int64, LONGEST_ROW),
        ("row", float, LONGEST_ROW),  # the entries,
        ("entries", np.int64),  # and how many there are
        ("value", float),  # measured minus predicted
        ("noise_variance", float),  # of one measurement
        ("prior_variance", float),  # h P h', and
        # what of it comes from a TDOA that is curved within P, see curvature.py
        ("curvature", float),
        # P h', of state and prediction; the gain is this over total_variance
        ("cross_covariance", float, ERROR_STATES),
        # entries of the Jacobian row for the auxiliary states: 0, but of their own sensors
        ("offset_jacobian", float, auxiliary.OFFSET_STATES),
        ("offset_covariance", float, auxiliary.OFFSET_STATES),  # scratch of auxiliary.correct
        # how often the same error is met, in tdoa_correlation_length: 1, but for a tag that does
        # not move
        ("variance_inflation", float),
        ("weight", float),  # 0 to 1, given by robust.update
        ("total_variance", float),  # of the value, as the update took it
        # scratch of the M-estimation: S', by rows the columns of S,
        ("factor", float, (JOINT_STATES, JOINT_STATES)),
        ("scaled_row", float, JOINT_STATES),  # S' h',
        ("scaled_error", float, JOINT_STATES),  # and of the state scaled by S the error
        ("prior_weights", float, JOINT_STATES),  # and its weights
    ],
    align=True,
)


@compiled
def project(P: np.ndarray, innovation: Record) -> None:
    """Fill in what the prior P (15, 15) makes of the Jacobian row: prior_variance and
    cross_covariance.
    """
    covariance = innovation.cross_covariance
    for j in range(ERROR_STATES):
        covariance[j] = 0.0
    for n in range(innovation.entries):
        state, entry = innovation.states[n], innovation.row[n]
        for j in range(ERROR_STATES):
            covariance[j] += entry * P[state, j]
    variance = 0.0
    for n in range(innovation.entries):
        variance += innovation.row[n] * covariance[innovation.states[n]]
    innovation.prior_variance, innovation.variance_inflation = variance, 1.0
    innovation.offset_jacobian[:] = 0.0


@compiled
def kalman(hypothesis: Record, innovation: Record) -> None:
    """Kalman update of a HYPOTHESIS with an INNOVATION of value, cross_covariance and
    total_variance.
    """
    P, covariance, total = hypothesis.P, innovation.cross_covariance, innovation.total_variance
    if auxiliary.present(hypothesis):
        auxiliary.correct(hypothesis, innovation)
    inject(hypothesis.x, covariance, innovation.value / total)
    for i in range(ERROR_STATES):
        gain = covariance[i] / total
        for j in range(i, ERROR_STATES):
            P[i, j] -= gain * covariance[j]
            P[j, i] = P[i, j]


@compiled
def update_state(
    hypothesis: Record, innovation: Record, state: int, value: float, std: float
) -> None:
    """Kalman update with a measurement of one of the first six states, position and velocity:
    `value` +- `std`.
    """
    innovation.entries, innovation.states[0], innovation.row[0] = 1, state, 1.0
    innovation.value, innovation.noise_variance = value - hypothesis.x[state], std * std
    project(hypothesis.P, innovation)
    innovation.total_variance = innovation.prior_variance + innovation.noise_variance
    kalman(hypothesis, innovation)


SMALLEST = 0.5  # m, 3D standard deviation below which it is negligible
NEAREST = 0.1  # m, of an anchor, for its curvature


@compiled
def variance(x: np.ndarray, P: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Mean square, m^2, of the second-order term of a TDOA between anchors at a and b (3,), of a
    tag at x (3,), m, with covariance P (15, 15).
    """
    if P[0, 0] + P[1, 1] + P[2, 2] < SMALLEST**2:
        return 0.0
    product = np.zeros((3, 3))
    for anchor, sign in ((a, -1.0), (b, 1.0)):
        away = np.array([x[k] - anchor[k] for k in range(3)])
        distance = max(math.sqrt(np.sum(away**2)), NEAREST)
        for i in range(3):
            along = 0.0
            for k in range(3):
                along += away[k] * P[k, i] / distance**2
            for j in range(3):
                # of Hessian and covariance
                product[j, i] += sign * (P[j, i] - away[j] * along) / distance
    mean = squared = 0.0
    for i in range(3):
        mean += 0.5 * product[i, i]
        for j in range(3):
            squared += 0.5 * product[i, j] * product[j, i]
    return mean**2 + squared
