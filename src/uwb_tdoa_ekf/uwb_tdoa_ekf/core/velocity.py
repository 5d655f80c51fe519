"""A velocity in the body frame: wheels, optical flow, visual odometry. Slip and lost features show as innovations."""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.foundation.compiled import Record, compiled
from uwb_tdoa_bias.foundation.robust_loss import GEMAN_MCCLURE, weight

from .hypotheses import add_log_likelihood, alive
from .history import add_update
from .state import rotation
from .update import kalman, project
from .verdicts import REJECTED, USED

GATE = 3.0  # standard deviations beyond which a component is not used
CORRELATION_TIME = 1.0  # s over which its error stays alike
LONGEST_STD = 1e3  # m/s; a component that is less precise is not measured
STUCK_TIME, STUCK_COUNT = 0.5, 5  # s, and velocities, all the same, after which the sensor of a tag that shakes is stuck
AVERAGE = 0.5  # s of innovations that tell whether it agrees with everything else
DISAGREES, AGREES = 4.0, 2.0  # mean normalised innovation squared above which it is not used any more, below which again


@compiled
def observe(ekf: Record, parameters: Record, aid: Record, residual: Record, records: np.ndarray) -> None:
    """Take a velocity, one of AID, into a running filter; fills one of RESIDUAL with its worst component."""
    state, innovation = ekf.velocity, ekf.innovation
    dt = min(max(aid.t - state.heard, 1e-3), AVERAGE)
    frozen = _repeats(state, aid) and not ekf.quiet
    state.heard = aid.t
    inflation = max(1.0, 2.0 * CORRELATION_TIME / dt)
    _complete(aid, parameters)
    worst = _worst(ekf, aid, residual)
    state.nis += min(1.0, dt / AVERAGE) * (min(worst, GATE**4) - state.nis)
    state.refused = state.nis > (AGREES if state.refused else DISAGREES) or (frozen and (state.refused or np.any(state.value != 0.0)))
    residual.weight, residual.verdict = 0.0, REJECTED
    if state.refused or worst > GATE**2:
        return
    residual.weight, residual.verdict = 1.0, USED
    for h in range(len(ekf.hypotheses)):
        hypothesis = ekf.hypotheses[h]
        if not alive(hypothesis):
            continue
        for axis in range(3):
            if aid.std[axis] > LONGEST_STD:
                continue
            compare(hypothesis, aid, axis, ekf.transition.rotation, innovation)
            total = innovation.prior_variance + innovation.noise_variance
            w = weight(GEMAN_MCCLURE, innovation.value / math.sqrt(total), GATE)
            add_log_likelihood(hypothesis, innovation, inflation)
            innovation.total_variance = innovation.prior_variance + innovation.noise_variance * inflation / w
            kalman(hypothesis, innovation)
            if h == ekf.best:
                residual.weight = min(residual.weight, w)
                add_update(ekf, aid.t, records)


@compiled
def _complete(aid: Record, parameters: Record) -> None:
    """Give the components of AID the configured deviation, where the message states none."""
    for axis in range(3):
        if aid.std[axis] == 0.0:
            aid.std[axis] = parameters.velocity_std


@compiled
def _repeats(state: Record, aid: Record) -> bool:
    """Remember a velocity, one of AID; returns whether it has been the same for as long as a sensor that works repeats none."""
    since = aid.t - state.heard
    for k in range(3):
        if aid.std[k] <= LONGEST_STD and aid.value[k] != state.value[k]:
            state.value[k], state.changed = aid.value[k], aid.t
    return aid.t - state.changed > max(STUCK_TIME, STUCK_COUNT * since)


@compiled
def _worst(ekf: Record, aid: Record, residual: Record) -> float:
    """The largest normalised innovation squared of the components, for the best hypothesis; fills the residual."""
    innovation, worst = ekf.innovation, -1.0
    for axis in range(3):
        if aid.std[axis] > LONGEST_STD:
            continue
        compare(ekf.hypotheses[ekf.best], aid, axis, ekf.transition.rotation, innovation)
        total = innovation.prior_variance + innovation.noise_variance
        nis = innovation.value**2 / total
        if nis > worst:
            worst, residual.innovation, residual.variance = nis, innovation.value, total
    return worst


@compiled
def compare(hypothesis: Record, aid: Record, axis: int, R: np.ndarray, innovation: Record) -> None:
    """Fill in what one component of a velocity in the body frame says to a HYPOTHESIS, and R (3, 3), body to world.

    u = R' v; with the true attitude q * Exp(dtheta), du = R' dv + [u]x dtheta.
    """
    x = hypothesis.x
    rotation(x[6], x[7], x[8], x[9], R)
    following, last = (axis + 1) % 3, (axis + 2) % 3
    u = R[0, axis] * x[3] + R[1, axis] * x[4] + R[2, axis] * x[5]
    u_following = R[0, following] * x[3] + R[1, following] * x[4] + R[2, following] * x[5]
    u_last = R[0, last] * x[3] + R[1, last] * x[4] + R[2, last] * x[5]
    innovation.entries = 5
    for k in range(3):
        innovation.states[k], innovation.row[k] = 3 + k, R[k, axis]
    innovation.states[3], innovation.row[3] = 6 + following, -u_last
    innovation.states[4], innovation.row[4] = 6 + last, u_following
    innovation.value = aid.value[axis] - u
    innovation.noise_variance = aid.std[axis] ** 2
    project(hypothesis.P, innovation)
