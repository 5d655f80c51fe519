"""Three ways not to be misled by an outlier.

All work on a HYPOTHESIS and an INNOVATION after `update.project`, whose noise_variance is that of one measurement. The
errors of successive ones are alike: as many as `correlation_length` tell as much as one independent of the others. The
update therefore takes noise_variance times that, while the weight is judged with noise_variance itself.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.foundation.compiled import Record, compiled
from uwb_tdoa_bias.foundation.robust_loss import weight

from .config import ROBUST
from .state import ERROR_STATES
from .update import kalman

NEGLIGIBLE = 0.01  # weight below which a measurement is not used
SMALLEST_WEIGHT = 1e-6  # of a measurement in the M-estimation
_INNOVATION, _GATE = ROBUST.index("innovation"), ROBUST.index("gate")


@compiled
def update(hypothesis: Record, innovation: Record, parameters: Record) -> None:
    """Robust update in the way that PARAMETERS says. Sets weight, 0 for none, and total_variance, inf for none."""
    if parameters.robust == _INNOVATION:
        update_innovation(hypothesis, innovation, parameters)
    elif parameters.robust == _GATE:
        update_gate(hypothesis, innovation, parameters)
    else:
        update_m_estimation(hypothesis, innovation, parameters)


@compiled
def update_innovation(hypothesis: Record, innovation: Record, parameters: Record) -> None:
    """Weight from the whitened innovation, then one Kalman update with the variance divided by it.

    Because the prior's own uncertainty whitens the innovation, a filter that knows little listens to everything: the
    redescending weight cannot lock it out.
    """
    prior, noise = innovation.prior_variance, innovation.noise_variance
    w = weight(parameters.loss, innovation.value / math.sqrt(prior + noise), parameters.measurement_scale)
    if w < NEGLIGIBLE:
        innovation.weight, innovation.total_variance = 0.0, np.inf
        return
    innovation.weight, innovation.total_variance = w, prior + noise * parameters.tdoa_correlation_length * innovation.repeated / w
    kalman(hypothesis, innovation)


@compiled
def update_gate(hypothesis: Record, innovation: Record, parameters: Record) -> None:
    """Kalman update if the innovation is within `gate` standard deviations."""
    prior, noise = innovation.prior_variance, innovation.noise_variance
    if innovation.value**2 > parameters.gate**2 * (prior + noise):
        innovation.weight, innovation.total_variance = 0.0, np.inf
        return
    innovation.weight, innovation.total_variance = 1.0, prior + noise * parameters.tdoa_correlation_length * innovation.repeated
    kalman(hypothesis, innovation)


@compiled
def update_m_estimation(hypothesis: Record, innovation: Record, parameters: Record) -> None:
    """M-estimation update, Zhao et al. (RA-L 2021), eqs. 8 - 13; cross_covariance becomes that of the weighted prior.

    The error state is scaled by the Cholesky factor S of the prior (eq. 9), prior and measurement are re-weighted
    `iterations` times (eq. 10), and the posterior follows from the weighted gain (eqs. 11 - 13). For measurements of
    the position alone, the first three states: they move only the first three elements of the scaled error, so three
    columns of S suffice. The Jacobian is kept at the prior mean: over the centimetres of one update it does not change.
    """
    P, S, covariance = hypothesis.P, innovation.factor, innovation.cross_covariance
    _factorize(P, S)
    g0, g1, g2 = _position_row(innovation)
    y0 = S[0, 0] * g0 + S[1, 0] * g1 + S[2, 0] * g2  # S' h'; its other elements are zero
    y1 = S[1, 1] * g1 + S[2, 1] * g2
    y2 = S[2, 2] * g2
    noise = innovation.noise_variance * parameters.tdoa_correlation_length * innovation.repeated
    loss = parameters.loss
    e0 = e1 = e2 = 0.0  # scaled error of the state, eq. 9
    for _ in range(parameters.iterations):
        left = innovation.value - y0 * e0 - y1 * e1 - y2 * e2
        w = max(weight(loss, left / math.sqrt(noise), parameters.measurement_scale), SMALLEST_WEIGHT)
        w0, w1, w2 = (
            weight(loss, e0, parameters.state_scale),
            weight(loss, e1, parameters.state_scale),
            weight(loss, e2, parameters.state_scale),
        )
        total = y0 * y0 / w0 + y1 * y1 / w1 + y2 * y2 / w2 + noise / w
        step = innovation.value / total
        e0, e1, e2 = y0 / w0 * step, y1 / w1 * step, y2 / w2 * step
    for i in range(ERROR_STATES):  # the weighted prior: P + S (1/W - 1) S'
        s0, s1, s2 = (1.0 / w0 - 1.0) * S[i, 0], (1.0 / w1 - 1.0) * S[i, 1], (1.0 / w2 - 1.0) * S[i, 2]
        for j in range(i, ERROR_STATES):
            P[i, j] += s0 * S[j, 0] + s1 * S[j, 1] + s2 * S[j, 2]
            P[j, i] = P[i, j]
        covariance[i] = S[i, 0] * y0 / w0 + S[i, 1] * y1 / w1 + S[i, 2] * y2 / w2
    innovation.weight, innovation.total_variance = w, total
    kalman(hypothesis, innovation)


@compiled
def _factorize(P: np.ndarray, S: np.ndarray) -> None:
    """S (15, 3) <- the first three columns of the Cholesky factor of P."""
    for i in range(3):
        for j in range(i, ERROR_STATES):
            value = P[j, i]
            for k in range(i):
                value -= S[j, k] * S[i, k]
            S[j, i] = math.sqrt(max(value, 1e-18)) if j == i else value / S[i, i]
        for j in range(i):
            S[j, i] = 0.0


@compiled
def _position_row(innovation: Record) -> tuple[float, float, float]:
    """The entries of the Jacobian row for the position."""
    g0 = g1 = g2 = 0.0
    for n in range(innovation.entries):
        state, entry = innovation.states[n], innovation.row[n]
        g0 += entry if state == 0 else 0.0
        g1 += entry if state == 1 else 0.0
        g2 += entry if state == 2 else 0.0
    return g0, g1, g2
