# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Kalman update with a scalar measurement of any kind, and its robust weight.

Each kind of measurement fills an INNOVATION: the Jacobian row with its error states, measured minus
predicted value, and the variance of the measurement noise. `project` and `kalman` then work for all
kinds. If the measurement may be an outlier, `weigh` comes between the two.

Errors of successive TDOAs are correlated. The update therefore uses the variance of a single
measurement times `variance_inflation` (noise.py). The methods `innovation` and `gate` compute the weight with the variance of a single
measurement, `m_estimation` with the variance that its update uses.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.robust_loss import GEMAN_MCCLURE, weight

from . import auxiliary
from .auxiliary import OFFSET_STATES
from .config import ROBUST
from .state import ERROR_STATES, inject

GATE = 3.0  # standard deviations beyond which a measurement is an outlier
NEGLIGIBLE = 0.01  # weight below which a measurement is not used
SMALLEST_WEIGHT = 1e-6  # least weight of a measurement in the M-estimation
SMALLEST = 0.5  # m, 3D standard deviation below which the second-order term is negligible
NEAREST = 0.1  # m, least distance to an anchor, for the curvature of its range
LONGEST_ROW = 6  # most error states that a measurement depends on
JOINT_STATES = ERROR_STATES + OFFSET_STATES
_GATE, _M_ESTIMATION = ROBUST.index("gate"), ROBUST.index("m_estimation")

INNOVATION = np.dtype(
    [
        ("states", np.int64, LONGEST_ROW),  # error states with an entry in the Jacobian row h
        ("row", float, LONGEST_ROW),  # the entries
        ("entries", np.int64),  # number of entries
        ("value", float),  # measured minus predicted
        ("noise_variance", float),  # of a single measurement
        ("prior_variance", float),  # h P h', plus curvature if the update adds it
        # variance of the second-order term of a TDOA within P, see `second_order_variance`
        ("curvature", float),
        # P h', covariance of error state and prediction; the gain is this over total_variance
        ("cross_covariance", float, ERROR_STATES),
        # entries of the Jacobian row for the auxiliary states; nonzero only for their own sensors
        ("offset_jacobian", float, OFFSET_STATES),
        ("offset_covariance", float, OFFSET_STATES),  # scratch of auxiliary.correct
        # factor on noise_variance in an update, because successive errors are alike; see noise.py
        ("variance_inflation", float),
        ("weight", float),  # 0 to 1, set by `weigh`
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
    covariance[:] = 0.0
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
def kalman_robust(
    hypothesis: Record, innovation: Record, variance_inflation: float, gate: float
) -> float:
    """Update a HYPOTHESIS with an INNOVATION by Geman-McClure, and return the weight.

    Parameters
    ----------
    hypothesis : HYPOTHESIS
        Updated in place.
    innovation : INNOVATION
        After `project`.
    variance_inflation : float
        Number of measurements with the same error. The variance of the noise is multiplied by it.
    gate : float
        Scale of the loss, in standard deviations.
    """
    prior, noise = innovation.prior_variance, innovation.noise_variance
    w = weight(GEMAN_MCCLURE, innovation.value / math.sqrt(prior + noise), gate)
    innovation.weight, innovation.total_variance = w, prior + noise * variance_inflation / w
    kalman(hypothesis, innovation)
    return w


@compiled
def kalman_direct(
    hypothesis: Record, innovation: Record, state: int, value: float, std: float
) -> None:
    """Update a HYPOTHESIS with a direct measurement of one position or velocity state.

    The measurement has neither a robust weight nor a correlation length: it counts fully.

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
def second_order_variance(x: np.ndarray, P: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    """Return the second-order variance of a TDOA: the mean square of its second-order term, in m^2.

    It is 0 where the position is certain to SMALLEST.

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


@compiled
def weigh(hypothesis: Record, innovation: Record, parameters: Record) -> None:
    """Set weight and total_variance of an INNOVATION after `project`, as `robust` selects.

    The method `innovation` weighs the whitened innovation, and divides the measurement noise by the
    weight. The covariance of the prediction contributes to the whitening. So an uncertain filter
    accepts large innovations, and the redescending weight cannot lock it out. The method `gate`
    gives the weight 1 within `gate` standard deviations. A rejected measurement has the weight 0
    and the variance inf.
    """
    if parameters.robust == _M_ESTIMATION:
        _weigh_by_m_estimation(hypothesis, innovation, parameters)
        return
    prior, noise = innovation.prior_variance, innovation.noise_variance
    if parameters.robust == _GATE:
        w = 0.0 if innovation.value**2 > parameters.gate**2 * (prior + noise) else 1.0
    else:
        w = weight(
            parameters.loss,
            innovation.value / math.sqrt(prior + noise),
            parameters.measurement_scale,
        )
    if w < NEGLIGIBLE:
        innovation.weight, innovation.total_variance = 0.0, np.inf
        return
    innovation.weight = w
    innovation.total_variance = prior + noise * innovation.variance_inflation / w


@compiled
def _weigh_by_m_estimation(hypothesis: Record, innovation: Record, parameters: Record) -> None:
    """Compute weight and prior of an M-estimation, Zhao et al. (RA-L 2021), eqs. 8 - 13.

    The error state, followed by the auxiliary states, is scaled by the Cholesky factor S of the
    prior (eq. 9). Prior and measurement are re-weighted `iterations` times (eq. 10). HYPOTHESIS and
    cross_covariance become those of the weighted prior. `kalman` then gives the posterior by the
    weighted gain (eqs. 11 - 13).

    A measurement moves only the scaled errors up to its last state. So that many columns of S
    suffice: three for a measurement of position. The Jacobian stays at the prior mean, because it
    does not change over the centimetres of an update.
    """
    y, e, w = innovation.scaled_row, innovation.scaled_error, innovation.prior_weights
    rows = ERROR_STATES + (OFFSET_STATES if auxiliary.present(hypothesis) else 0)
    columns = _columns(innovation)
    _factorize(hypothesis, innovation.factor, rows, columns)
    _scale(innovation, columns)
    noise = innovation.noise_variance * innovation.variance_inflation
    loss = parameters.loss
    e[:] = 0.0  # scaled error of the state, eq. 9
    for _ in range(parameters.iterations):
        left, total = innovation.value, innovation.prior_variance
        for k in range(columns):
            left -= y[k] * e[k]
            w[k] = weight(loss, e[k], parameters.state_scale)
            total += y[k] * y[k] * (1.0 / w[k] - 1.0)
        of_noise = max(
            weight(loss, left / math.sqrt(noise), parameters.measurement_scale), SMALLEST_WEIGHT
        )
        total += noise / of_noise
        for k in range(columns):
            e[k] = y[k] / w[k] * (innovation.value / total)
    _weigh_prior(hypothesis, innovation, rows, columns)
    innovation.weight, innovation.total_variance = of_noise, total


@compiled
def _columns(innovation: Record) -> int:
    """Return the number of states up to the last entry in the Jacobian of an INNOVATION.

    The order is error state, then auxiliary states.
    """
    columns = 0
    for n in range(innovation.entries):
        if innovation.row[n] != 0.0:
            columns = max(columns, innovation.states[n] + 1)
    for m in range(OFFSET_STATES):
        if innovation.offset_jacobian[m] != 0.0:
            columns = ERROR_STATES + m + 1
    return columns


@compiled
def _factorize(hypothesis: Record, factor: np.ndarray, rows: int, columns: int) -> None:
    """Compute the first columns of the Cholesky factor S of the joint covariance.

    The joint covariance contains the error state, then the auxiliary states. factor is (columns,
    rows). Each column of S is stored as a row, because contiguous memory is faster.
    """
    P, cross, of_offset = hypothesis.P, hypothesis.offset_cross, hypothesis.offset_P
    for k in range(columns):
        column = factor[k]
        for i in range(ERROR_STATES):
            column[i] = P[k, i] if k < ERROR_STATES else cross[k - ERROR_STATES, i]
        for i in range(ERROR_STATES, rows):
            column[i] = (
                cross[i - ERROR_STATES, k]
                if k < ERROR_STATES
                else of_offset[k - ERROR_STATES, i - ERROR_STATES]
            )
        for m in range(k):
            entry = factor[m, k]
            for i in range(rows):
                column[i] -= entry * factor[m, i]
        deviation = math.sqrt(max(column[k], 1e-18))
        for i in range(rows):
            column[i] /= deviation
        column[:k] = 0.0
        column[k] = deviation


@compiled
def _scale(innovation: Record, columns: int) -> None:
    """Compute scaled_row = S' h'; all later elements are zero."""
    factor, y = innovation.factor, innovation.scaled_row
    for k in range(columns):
        y[k] = 0.0
        for n in range(innovation.entries):
            y[k] += factor[k, innovation.states[n]] * innovation.row[n]
        for m in range(max(0, columns - ERROR_STATES)):
            y[k] += factor[k, ERROR_STATES + m] * innovation.offset_jacobian[m]


@compiled
def _weigh_prior(hypothesis: Record, innovation: Record, rows: int, columns: int) -> None:
    """Replace the prior by the weighted prior, P + S (1/W - 1) S', and update cross_covariance.

    Only the upper triangle of P is computed, because `kalman` mirrors it.
    """
    P, cross, of_offset = hypothesis.P, hypothesis.offset_cross, hypothesis.offset_P
    y, w, covariance = innovation.scaled_row, innovation.prior_weights, innovation.cross_covariance
    covariance[:] = 0.0
    for k in range(columns):
        column, more, told = innovation.factor[k], 1.0 / w[k] - 1.0, y[k] / w[k]
        for i in range(ERROR_STATES):
            covariance[i] += column[i] * told
            entry = more * column[i]
            for j in range(i, ERROR_STATES):
                P[i, j] += entry * column[j]
        for m in range(rows - ERROR_STATES):
            entry = more * column[ERROR_STATES + m]
            for i in range(ERROR_STATES):
                cross[m, i] += entry * column[i]
            for n in range(rows - ERROR_STATES):
                of_offset[m, n] += entry * column[ERROR_STATES + n]
