"""Three ways not to be misled by an outlier.

All work on a HYPOTHESIS and an INNOVATION after `update.project`, whose noise_variance is that of
one measurement. The errors of successive ones are alike: as many as `correlation_length` tell as
much as one independent of the others. The update therefore takes noise_variance times that.
`innovation` and `gate` judge the weight with noise_variance itself, `m_estimation` with the
variance that its update takes.
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
from .update import kalman

NEGLIGIBLE = 0.01  # weight below which a measurement is not used
SMALLEST_WEIGHT = 1e-6  # of a measurement in the M-estimation
_INNOVATION, _GATE = ROBUST.index("innovation"), ROBUST.index("gate")


@compiled
def update(hypothesis: Record, innovation: Record, parameters: Record) -> None:
    """Robust update in the way that PARAMETERS says.

    Sets weight, 0 for none, and total_variance, inf for none.
    """
    if parameters.robust == _INNOVATION:
        update_innovation(hypothesis, innovation, parameters)
    elif parameters.robust == _GATE:
        update_gate(hypothesis, innovation, parameters)
    else:
        update_m_estimation(hypothesis, innovation, parameters)


@compiled
def update_innovation(hypothesis: Record, innovation: Record, parameters: Record) -> None:
    """Weight from the whitened innovation, then one Kalman update with the variance divided by it.

    Because the prior's own uncertainty whitens the innovation, a filter that knows little listens
    to everything: the redescending weight cannot lock it out.
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
    kalman(hypothesis, innovation)


@compiled
def update_gate(hypothesis: Record, innovation: Record, parameters: Record) -> None:
    """Kalman update if the innovation is within `gate` standard deviations."""
    prior, noise = innovation.prior_variance, innovation.noise_variance
    if innovation.value**2 > parameters.gate**2 * (prior + noise):
        innovation.weight, innovation.total_variance = 0.0, np.inf
        return
    innovation.weight, innovation.total_variance = (
        1.0,
        prior + noise * parameters.tdoa_correlation_length * innovation.variance_inflation,
    )
    kalman(hypothesis, innovation)


@compiled
def update_m_estimation(hypothesis: Record, innovation: Record, parameters: Record) -> None:
    """M-estimation update, Zhao et al. (RA-L 2021), eqs. 8 - 13; cross_covariance becomes that of
    the weighted prior.

    The error state, with the auxiliary states behind it, is scaled by the Cholesky factor S of the
    prior (eq. 9). Prior and measurement are re-weighted `iterations` times (eq. 10), and the
    posterior follows from the weighted gain (eqs. 11 - 13). A measurement moves only those elements
    of the scaled error that come before its last state, so as many columns of S suffice: three for
    one of the position. The Jacobian is kept at the prior mean: over the centimetres of one update
    it does not change.
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
    kalman(hypothesis, innovation)


@compiled
def _columns(innovation: Record) -> int:
    """How many states, in the order of the error state and then of the auxiliary ones, come up to
    the last one that an INNOVATION depends on.
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
    """factor (columns, rows) <- the first columns of the Cholesky factor S of the joint covariance
    of error state and auxiliary states, each as a row: what is then done to it is contiguous.
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
    """scaled_row <- S' h', whose other elements are zero."""
    factor, y = innovation.factor, innovation.scaled_row
    for k in range(columns):
        y[k] = 0.0
        for n in range(innovation.entries):
            y[k] += factor[k, innovation.states[n]] * innovation.row[n]
        for m in range(max(0, columns - ERROR_STATES)):
            y[k] += factor[k, ERROR_STATES + m] * innovation.offset_jacobian[m]


@compiled
def _weigh_prior(hypothesis: Record, innovation: Record, rows: int, columns: int) -> None:
    """Make the prior the weighted one, P + S (1/W - 1) S', with what it says of the INNOVATION in
    cross_covariance. Of P the upper triangle: `update.kalman` mirrors it.
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
