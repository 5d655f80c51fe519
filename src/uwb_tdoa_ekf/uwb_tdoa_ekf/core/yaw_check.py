# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Test of the yaw that the filter follows, by innovations and the inertial sensor.

A yaw error psi turns each predicted change of velocity. The resulting error of the state is linear
in cos(psi) - 1 and sin(psi). The predictions and updates of the filter propagate it, as two
responses of the error state. They give the log likelihood ratio of each yaw error to none
(Willsky and Jones, IEEE Trans. Automatic Control 1976). Its sum over time never falls below zero
(Page, Biometrika 1954): a yaw that was right for long is doubted as soon as one that was just
given. A yaw error turns measured velocities, too. Less evidence is needed against a given yaw that
velocities have not confirmed yet. The test changes the filter only if the evidence suffices.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from .memory import YAW_ERRORS
from .state import CHECK_PERIOD, ERROR_STATES, propagate_vector
from .update import GATE

YAW_KNOWN = math.radians(20.0)  # rad, standard deviation below which the yaw counts as known
# Log likelihood ratio above which the yaw is opened again, and the limit for a given yaw that velocities
# have not confirmed. The innovations of CHECK_PERIOD add the third number at most, or a quarter of what
# they gain. All trade false alarms against late detection: a moment of bad TDOAs must not suffice. See
# docs/notebook/reliability.md for the ratios of 22 measured flights.
EVIDENCE, UNCONFIRMED_EVIDENCE, MOST_AT_ONCE = (6.0, 1.6, 0.4)
CONFIRMED = 4.0  # s of motion with velocities that agree, after which a given yaw is confirmed
HEARD = 1.0  # s after the last velocity in which a wrong velocity may explain innovations
ANGLES = math.pi * np.arange(3, 3 + YAW_ERRORS) / 12.0  # rad, yaw errors to test: 45 to 315 degrees
COSINES, SINES = (np.cos(ANGLES) - 1.0, np.sin(ANGLES))  # the error of the state is linear in both


@compiled
def clear(doubt: Record) -> None:
    """Clear the responses of a YAW_TEST, because position and velocity were replaced."""
    doubt.response[:] = 0.0


@compiled
def forget(doubt: Record, given: bool) -> None:
    """Clear a YAW_TEST, because the yaw was replaced.

    given is whether measurements have not confirmed the new yaw yet: a user or an earlier filter gave it.
    """
    clear(doubt)
    doubt.vector[:] = 0.0
    doubt.information[:] = 0.0
    doubt.ratios[:] = 0.0
    doubt.unconfirmed = CONFIRMED if given else 0.0


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
def observe(
    ekf: Record, correlation_length: float, shows: bool, cosine: float = 0.0, sine: float = 0.0
) -> None:
    """Update the test with the innovation of the best hypothesis, after its Kalman update.

    Parameters
    ----------
    ekf : EKF
        State of the filter; yaw_test is updated.
    correlation_length : float
        Number of measurements that count as a single independent one, see update.py.
    shows : bool
        Whether the innovation is evidence. Otherwise only the responses follow the update.
    cosine, sine : float
        Responses of the measurement itself, besides those of the state.
    """
    doubt, innovation = ekf.yaw_test, ekf.innovation
    to_cosine, to_sine = doubt.response[0], doubt.response[1]
    for n in range(innovation.entries):
        cosine += innovation.row[n] * to_cosine[innovation.states[n]]
        sine += innovation.row[n] * to_sine[innovation.states[n]]
    if shows:
        variance = innovation.prior_variance + innovation.noise_variance * correlation_length
        per_variance = 1.0 / variance
        largest = GATE * math.sqrt(variance)
        value = min(max(innovation.value, -largest), largest) * per_variance
        doubt.vector[0] += cosine * value
        doubt.vector[1] += sine * value
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
def accumulate(doubt: Record, measured: bool) -> float:
    """Add recent innovations to the log likelihood ratio of each yaw error; return the largest.

    measured is whether a sensor measures velocities. Their scale may be wrong, down to meaningless: a yaw
    error must explain the innovations better than that.
    """
    v, J = doubt.vector, doubt.information
    scale = min(1.0, max(-1.0, v[0] / J[0, 0])) if measured and J[0, 0] > 0.0 else 0.0
    other = scale * (v[0] - 0.5 * scale * J[0, 0])
    for k in range(len(ANGLES)):
        c, s = COSINES[k], SINES[k]
        gained = (
            c * v[0] + s * v[1] - 0.5 * (c * c * J[0, 0] + 2.0 * c * s * J[0, 1] + s * s * J[1, 1])
        ) - other
        doubt.ratios[k] = max(0.0, doubt.ratios[k] + min(gained, max(MOST_AT_ONCE, 0.25 * gained)))
    v[:] = 0.0
    J[:] = 0.0
    return float(np.max(doubt.ratios))


@compiled
def contradicts(ekf: Record, t: float) -> bool:
    """Return whether the evidence at stamp t (s) contradicts a yaw that counts as known.

    The test runs once per CHECK_PERIOD.
    """
    doubt = ekf.yaw_test
    if t < doubt.next_look:
        return False
    doubt.next_look = t + CHECK_PERIOD
    measured = t - ekf.velocity.heard < HEARD
    unconfirmed = measured and doubt.unconfirmed > 0.0
    limit = UNCONFIRMED_EVIDENCE if unconfirmed else EVIDENCE
    best = ekf.hypotheses[ekf.best]
    return accumulate(doubt, measured) > limit and known(best.x, best.P)


@compiled
def known(x: np.ndarray, P: np.ndarray) -> bool:
    """Return whether the yaw counts as known, for a state x and the covariance P of its errors.

    The variance is that of the rotation about the vertical of the world.
    """
    u0 = 2.0 * (x[6] * x[8] - x[9] * x[7])
    u1 = 2.0 * (x[7] * x[8] + x[9] * x[6])
    u2 = 1.0 - 2.0 * (x[6] ** 2 + x[7] ** 2)
    square = u0 * u0 * P[6, 6] + u1 * u1 * P[7, 7] + u2 * u2 * P[8, 8]
    square += 2.0 * (u0 * u1 * P[6, 7] + u0 * u2 * P[6, 8] + u1 * u2 * P[7, 8])
    return square < YAW_KNOWN**2
