# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Three robust weights of a measurement: by the whitened innovation, by a gate, by M-estimation.

Each takes a HYPOTHESIS and an INNOVATION after `update.project`, and prepares `update.kalman`. noise_variance is the variance of
a single measurement. Errors of successive measurements are correlated: `correlation_length`
measurements give the information of a single independent one. The update therefore uses
noise_variance times this length. `by_innovation` and `by_gate` compute the weight with
noise_variance. `by_m_estimation` computes it with the variance that its update uses.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.robust_loss import weight

from . import auxiliary
from .auxiliary import OFFSET_STATES
from .config import ROBUST
from .state import ERROR_STATES

NEGLIGIBLE = 0.01  # weight below which a measurement is not used
SMALLEST_WEIGHT = 1e-6  # least weight of a measurement in the M-estimation
_INNOVATION, _GATE = ROBUST.index("innovation"), ROBUST.index("gate")


@compiled
def weigh(hypothesis: Record, innovation: Record, parameters: Record) -> None:
    """Set weight and total_variance of an INNOVATION with the method that PARAMETERS selects.

    The weight is 0 and the variance inf if the measurement is rejected.
    """
    if parameters.robust == _INNOVATION:
        by_innovation(innovation, parameters)
    elif parameters.robust == _GATE:
        by_gate(innovation, parameters)
    else:
        by_m_estimation(hypothesis, innovation, parameters)


@compiled
def by_innovation(innovation: Record, parameters: Record) -> None:
    """Compute the weight from the whitened innovation.

    The measurement noise is divided by the weight. The covariance of the prediction contributes to
    the whitening. So an uncertain filter accepts large innovations, and the redescending weight
    cannot lock it out.
    """
    prior, noise = innovation.prior_variance, innovation.noise_variance
    w = weight(
        parameters.loss, innovation.value / math.sqrt(prior + noise), parameters.measurement_scale
    )
    if w < NEGLIGIBLE:
        innovation.weight, innovation.total_variance = 0.0, np.inf
        return
    innovation.weight, innovation.total_variance = (
        w,
        prior + noise * parameters.tdoa_correlation_length * innovation.variance_inflation / w,
    )


@compiled
def by_gate(innovation: Record, parameters: Record) -> None:
    """Give the weight 1 to an innovation within `gate` standard deviations."""
    prior, noise = innovation.prior_variance, innovation.noise_variance
    if innovation.value**2 > parameters.gate**2 * (prior + noise):
        innovation.weight, innovation.total_variance = 0.0, np.inf
        return
    innovation.weight, innovation.total_variance = (
        1.0,
        prior + noise * parameters.tdoa_correlation_length * innovation.variance_inflation,
    )


@compiled
def by_m_estimation(hypothesis: Record, innovation: Record, parameters: Record) -> None:
    """Compute weight and prior of an M-estimation, Zhao et al. (RA-L 2021), eqs. 8 - 13.

    The error state, followed by the auxiliary states, is scaled by the Cholesky factor S of the
    prior (eq. 9). Prior and measurement are re-weighted `iterations` times (eq. 10). HYPOTHESIS and
    cross_covariance become those of the weighted prior. `update.kalman` then gives the posterior
    by the weighted gain (eqs. 11 - 13).

    A measurement moves only the scaled errors up to its last state. So that many columns of S
    suffice: three for a measurement of position. The Jacobian stays at the prior mean, because it
    does not change over the centimetres of an update.
    """
    y, e, w = innovation.scaled_row, innovation.scaled_error, innovation.prior_weights
    rows = ERROR_STATES + (OFFSET_STATES if auxiliary.present(hypothesis) else 0)
    columns = _columns(innovation)
    _factorize(hypothesis, innovation.factor, rows, columns)
    _scale(innovation, columns)
    noise = (
        innovation.noise_variance
        * parameters.tdoa_correlation_length
        * innovation.variance_inflation
    )
    loss = parameters.loss
    e[:] = 0.0  # scaled error of the state, eq. 9
    for _ in range(parameters.iterations):
        left, total = innovation.value, 0.0
        for k in range(columns):
            left -= y[k] * e[k]
            w[k] = weight(loss, e[k], parameters.state_scale)
            total += y[k] * y[k] / w[k]
        of_noise = max(
            weight(loss, left / math.sqrt(noise), parameters.measurement_scale), SMALLEST_WEIGHT
        )
        total += noise / of_noise + innovation.curvature
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

    Only the upper triangle of P is computed, because `update.kalman` mirrors it.
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
