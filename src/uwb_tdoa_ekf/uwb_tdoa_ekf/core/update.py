# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Kalman update with a scalar measurement of any kind.

Each kind of measurement fills an INNOVATION: the Jacobian row with its error states, measured minus
predicted value, and the variance of the measurement noise. `project` and `kalman` then work for all
kinds. If the measurement may be an outlier, `robust.weigh` comes between the two.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from . import auxiliary
from .state import ERROR_STATES, inject

GATE = 3.0  # standard deviations beyond which a measurement is an outlier
SMALLEST = 0.5  # m, 3D standard deviation below which the second-order term is negligible
NEAREST = 0.1  # m, least distance to an anchor, for the curvature of its range
LONGEST_ROW = 6  # most error states that a measurement depends on
JOINT_STATES = ERROR_STATES + auxiliary.OFFSET_STATES

INNOVATION = np.dtype(
    [
        ("states", np.int64, LONGEST_ROW),  # error states with an entry in the Jacobian row h
        ("row", float, LONGEST_ROW),  # the entries
        ("entries", np.int64),  # number of entries
        ("value", float),  # measured minus predicted
        ("noise_variance", float),  # of a single measurement
        ("prior_variance", float),  # h P h', plus curvature
        # variance of the second-order term of a TDOA within P, see `variance`
        ("curvature", float),
        # P h', covariance of error state and prediction; the gain is this over total_variance
        ("cross_covariance", float, ERROR_STATES),
        # entries of the Jacobian row for the auxiliary states; nonzero only for their own sensors
        ("offset_jacobian", float, auxiliary.OFFSET_STATES),
        ("offset_covariance", float, auxiliary.OFFSET_STATES),  # scratch of auxiliary.correct
        # factor on the variance by repetition of the same error, in units of
        # tdoa_correlation_length; 1 unless the tag is at rest
        ("variance_inflation", float),
        ("weight", float),  # 0 to 1, set by robust.weigh
        ("total_variance", float),  # variance of the value, as the update used it
        # scratch of the M-estimation: S', whose rows are the columns of S
        ("factor", float, (JOINT_STATES, JOINT_STATES)),
        ("scaled_row", float, JOINT_STATES),  # S' h'
        ("scaled_error", float, JOINT_STATES),  # error of the state, scaled by S
        ("prior_weights", float, JOINT_STATES),  # weights of the scaled error
    ],
    align=True,
)


@compiled
def project(P: np.ndarray, innovation: Record) -> None:
    """Compute prior_variance and cross_covariance of an INNOVATION from the prior P (15, 15)."""
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
    """Update a HYPOTHESIS with an INNOVATION.

    The function uses value, cross_covariance and total_variance.
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
    """Update a HYPOTHESIS with a direct measurement of a position or velocity state.

    Parameters
    ----------
    hypothesis : HYPOTHESIS
        Updated in place.
    innovation : INNOVATION
        Scratch.
    state : int
        Index of the state, 0 to 5.
    value, std : float
        Measured value and its standard deviation, m or m/s, world frame.
    """
    innovation.entries, innovation.states[0], innovation.row[0] = 1, state, 1.0
    innovation.value, innovation.noise_variance = value - hypothesis.x[state], std * std
    project(hypothesis.P, innovation)
    innovation.total_variance = innovation.prior_variance + innovation.noise_variance
    kalman(hypothesis, innovation)


@compiled
def variance(x: np.ndarray, P: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Return the mean square of the second-order term of a TDOA, in m^2.

    Parameters
    ----------
    x : (16,) array
        Nominal state. Only the position is used, m, world frame.
    P : (15, 15) array
        Covariance of the error state.
    a, b : (3,) array
        Positions of the anchors, m, world frame.
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
                # Hessian times covariance
                product[j, i] += sign * (P[j, i] - away[j] * along) / distance
    mean = squared = 0.0
    for i in range(3):
        mean += 0.5 * product[i, i]
        for j in range(3):
            squared += 0.5 * product[i, j] * product[j, i]
    return mean**2 + squared
