"""A barometer: its altitude is the height of the body plus an offset that wanders and drifts.

Offset and drift are states beside the 15 of the error state, with their own covariance and their covariance with those;
without a barometer (variance of the offset 0) nothing is computed for them.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.foundation.compiled import Record, compiled
from uwb_tdoa_bias.foundation.robust_loss import GEMAN_MCCLURE, weight

from .hypotheses import alive
from .state import ERROR_STATES
from .update import OFFSET_STATES, kalman, project
from .verdicts import REJECTED, USED

GATE = 4.0  # standard deviations beyond which an altitude is not used
LONGEST_DISAGREEMENT = 1.0  # s, after which the offset is taken anew
AVERAGE = 3.0  # s of innovations that tell how much worse a barometer is than its standard deviation
UNTRIED, WORST = 10.0, 100.0  # at first, and at most, in standard deviations


@compiled
def observe(ekf: Record, parameters: Record, aid: Record, residual: Record, records: np.ndarray) -> None:
    """Take an altitude of the standard atmosphere, one of AID, into a running filter; fills one of RESIDUAL."""
    barometer, innovation, altitude = ekf.barometer, ekf.innovation, aid.value[0]
    dt = min(max(aid.t - barometer.heard, 0.0), AVERAGE)
    barometer.heard = aid.t
    excess = max(1.0, barometer.nis)
    anew = aid.t - barometer.agreed > LONGEST_DISAGREEMENT
    for h in range(len(ekf.hypotheses)):
        hypothesis = ekf.hypotheses[h]
        if not alive(hypothesis):
            continue
        if anew or hypothesis.offset_P[0, 0] == 0.0:
            _take_anew(hypothesis, altitude, parameters)
            continue
        hypothesis.offset_P[0, 0] += dt * excess * parameters.pressure_walk**2
        _compare(hypothesis, altitude, parameters, innovation)
        total = innovation.prior_variance + innovation.noise_variance
        normalized = innovation.value / math.sqrt(total)
        w = weight(GEMAN_MCCLURE, normalized, GATE) if abs(normalized) < GATE else 0.0
        if w > 0.0:
            innovation.total_variance = innovation.prior_variance + innovation.noise_variance / w
            kalman(hypothesis, innovation)
        if h == ekf.best:
            step = min(1.0, dt / AVERAGE)
            barometer.nis += step * (min(normalized**2, GATE**2) * excess - barometer.nis)
            barometer.nis = min(barometer.nis, WORST**2)
            residual.innovation, residual.variance, residual.weight = innovation.value, total, w
            residual.verdict = USED if w > 0.0 else REJECTED
            if w > 0.0:
                barometer.agreed = aid.t
    if anew:
        barometer.agreed, barometer.nis = aid.t, UNTRIED**2
        residual.weight, residual.verdict = 0.0, REJECTED


@compiled
def _compare(hypothesis: Record, altitude: float, parameters: Record, innovation: Record) -> None:
    """Fill in what an altitude (m) says to a HYPOTHESIS and its offset."""
    innovation.entries, innovation.states[0], innovation.row[0] = 1, 2, 1.0
    innovation.value = altitude - hypothesis.x[2] - hypothesis.offset[0]
    innovation.noise_variance = parameters.pressure_std**2
    project(hypothesis.P, innovation)
    cross, P = hypothesis.offset_cross, hypothesis.offset_P
    for j in range(ERROR_STATES):
        innovation.cross_covariance[j] += cross[0, j]
    innovation.prior_variance += 2.0 * cross[0, 2] + P[0, 0]
    innovation.on_offset = 1.0


@compiled
def _take_anew(hypothesis: Record, altitude: float, parameters: Record) -> None:
    """The offset is what leads from the height of the filter to an altitude; the drift is not known."""
    hypothesis.offset[0], hypothesis.offset[1] = altitude - hypothesis.x[2], 0.0
    hypothesis.offset_cross[:] = 0.0
    for j in range(ERROR_STATES):
        hypothesis.offset_cross[0, j] = -hypothesis.P[2, j]
    hypothesis.offset_P[:] = 0.0
    hypothesis.offset_P[0, 0] = hypothesis.P[2, 2] + parameters.pressure_std**2
    hypothesis.offset_P[1, 1] = parameters.pressure_drift**2


@compiled
def predict(hypothesis: Record, transition: Record) -> None:
    """After `state.predict` of a HYPOTHESIS that has an offset: its covariance with the state, by the same TRANSITION."""
    dt, cross = transition.dt, hypothesis.offset_cross
    A, B, E = transition.velocity_attitude, transition.velocity_accel_bias, transition.attitude_attitude
    for k in range(OFFSET_STATES):
        t0, t1, t2 = cross[k, 6], cross[k, 7], cross[k, 8]
        for r in range(3):
            cross[k, r] += dt * cross[k, 3 + r]
            by_attitude = A[r, 0] * t0 + A[r, 1] * t1 + A[r, 2] * t2
            by_bias = B[r, 0] * cross[k, 9] + B[r, 1] * cross[k, 10] + B[r, 2] * cross[k, 11]
            cross[k, 3 + r] += by_attitude + by_bias
            cross[k, 6 + r] = E[r, 0] * t0 + E[r, 1] * t1 + E[r, 2] * t2 - dt * cross[k, 12 + r]
    _drift(hypothesis, dt)


@compiled
def coast(hypothesis: Record, dt: float) -> None:
    """The same after `state.coast`."""
    cross = hypothesis.offset_cross
    for k in range(OFFSET_STATES):
        for r in range(3):
            cross[k, r] += dt * cross[k, 3 + r]
    _drift(hypothesis, dt)


@compiled
def _drift(hypothesis: Record, dt: float) -> None:
    cross, P = hypothesis.offset_cross, hypothesis.offset_P
    hypothesis.offset[0] += dt * hypothesis.offset[1]
    for j in range(ERROR_STATES):
        cross[0, j] += dt * cross[1, j]
    P[0, 0] += dt * (2.0 * P[0, 1] + dt * P[1, 1])
    P[0, 1] += dt * P[1, 1]
    P[1, 0] = P[0, 1]
