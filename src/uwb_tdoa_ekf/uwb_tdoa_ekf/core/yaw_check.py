# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Test of the yaw that the filter follows, by innovations and the inertial sensor.

A yaw error psi turns each predicted change of velocity. The resulting error of the state is linear
in cos(psi) - 1 and sin(psi). The predictions and updates of the filter propagate it, as two
responses of the error state. A generalized likelihood ratio (Willsky and Jones, IEEE Trans.
Automatic Control 1976) tests recent innovations against both responses, for any psi. The test
changes the filter only if the evidence suffices.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from .state import CHECK_PERIOD, ERROR_STATES, propagate_vector

MEMORY = 6.0  # s over which innovations count
YAW_KNOWN = math.radians(20.0)  # rad, standard deviation below which the yaw counts as known
# Log likelihood ratio above which the yaw is opened again. It trades false alarms against late
# detection. Of 22 measured flights the largest ratio is 3.5; the worst flight has 9.9 without its
# range finder. See docs/notebook/reliability.md.
EVIDENCE = 12.0
ANGLES = 2.0 * math.pi * np.arange(1, 24) / 24.0  # rad, yaw errors to test
COSINES, SINES = (np.cos(ANGLES) - 1.0, np.sin(ANGLES))  # the error of the state is linear in both


@compiled
def clear(doubt: Record) -> None:
    """Clear all evidence of a YAW_TEST, because the state was replaced."""
    doubt.response[:] = 0.0
    doubt.vector[:] = 0.0
    doubt.information[:] = 0.0


@compiled
def predict(ekf: Record, vx: float, vy: float) -> None:
    """Propagate the responses, after `state.predict` of the best hypothesis.

    vx and vy are its horizontal velocity before the prediction, m/s, world frame.
    """
    x, dt = ekf.hypotheses[ekf.best].x, ekf.transition.dt
    along, across = x[3] - vx, x[4] - vy
    for c in range(2):
        response = ekf.yaw_test.response[c]
        propagate_vector(response, ekf.transition)
        dx, dy = (along, across) if c == 0 else (-across, along)
        response[0] += 0.5 * dt * dx
        response[1] += 0.5 * dt * dy
        response[3] += dx
        response[4] += dy


@compiled
def observe(ekf: Record, correlation_length: float, shows: bool) -> None:
    """Update the test with the innovation of the best hypothesis, after its Kalman update.

    Parameters
    ----------
    ekf : EKF
        State of the filter; yaw_test is updated.
    correlation_length : float
        Number of measurements that count as a single independent one, see update.py.
    shows : bool
        Whether the innovation is evidence. Otherwise only the responses follow the update.
    """
    doubt, innovation = ekf.yaw_test, ekf.innovation
    to_cosine, to_sine = doubt.response[0], doubt.response[1]
    cosine = sine = 0.0
    for n in range(innovation.entries):
        cosine += innovation.row[n] * to_cosine[innovation.states[n]]
        sine += innovation.row[n] * to_sine[innovation.states[n]]
    if shows:
        variance = innovation.prior_variance + innovation.noise_variance * correlation_length
        per_variance = 1.0 / variance
        doubt.vector[0] += cosine * innovation.value * per_variance
        doubt.vector[1] += sine * innovation.value * per_variance
        doubt.information[0, 0] += cosine * cosine * per_variance
        doubt.information[0, 1] += cosine * sine * per_variance
        doubt.information[1, 1] += sine * sine * per_variance
    if innovation.weight > 0.0:
        gain, per_total = innovation.cross_covariance, 1.0 / innovation.total_variance
        cosine *= per_total
        sine *= per_total
        for i in range(ERROR_STATES):
            to_cosine[i] -= gain[i] * cosine
            to_sine[i] -= gain[i] * sine


@compiled
def _forget(doubt: Record, dt: float) -> None:
    """Discount the evidence of a YAW_TEST over dt (s)."""
    kept = math.exp(-dt / MEMORY)
    for i in range(2):
        doubt.vector[i] *= kept
        for j in range(i, 2):
            doubt.information[i, j] *= kept


@compiled
def evidence(doubt: Record) -> float:
    """Return the log likelihood ratio of the best other yaw."""
    v, J = doubt.vector, doubt.information
    best = 0.0
    for k in range(len(ANGLES)):
        c, s = COSINES[k], SINES[k]
        best = max(
            best,
            c * v[0] + s * v[1] - 0.5 * (c * c * J[0, 0] + 2.0 * c * s * J[0, 1] + s * s * J[1, 1]),
        )
    return best


@compiled
def contradicts(ekf: Record, t: float) -> bool:
    """Return whether the evidence at stamp t (s) contradicts a yaw that counts as known.

    The test runs once per CHECK_PERIOD.
    """
    doubt = ekf.yaw_test
    if t < doubt.next_look:
        return False
    _forget(doubt, max(t - doubt.t, 0.0))
    doubt.t, doubt.next_look = t, t + CHECK_PERIOD
    doubt.evidence = evidence(doubt)
    return doubt.evidence > EVIDENCE and _yaw_variance(ekf.hypotheses[ekf.best]) < YAW_KNOWN**2


@compiled
def _yaw_variance(hypothesis: Record) -> float:
    """Return the variance of the rotation about the vertical of the world, in rad^2."""
    x, P = hypothesis.x, hypothesis.P
    u0 = 2.0 * (x[6] * x[8] - x[9] * x[7])
    u1 = 2.0 * (x[7] * x[8] + x[9] * x[6])
    u2 = 1.0 - 2.0 * (x[6] ** 2 + x[7] ** 2)
    square = u0 * u0 * P[6, 6] + u1 * u1 * P[7, 7] + u2 * u2 * P[8, 8]
    return square + 2.0 * (u0 * u1 * P[6, 7] + u0 * u2 * P[6, 8] + u1 * u2 * P[7, 8])
