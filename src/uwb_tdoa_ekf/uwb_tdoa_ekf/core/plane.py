"""A vehicle on its floor: the height is known, and of a planar one also that it is level and does
not rise. What cannot move sideways does not.

What is given once is not known better by being repeated: a state is held where the filter knows
less of it than that.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.robust_loss import GEMAN_MCCLURE, weight

from . import hypotheses, velocity
from .history import add_update
from .memory import HYPOTHESES
from .state import rotation
from .update import kalman, project, update_state

PERIOD = 0.05  # s between two times
RISE_STD = 0.02  # m/s, of the vertical velocity of a planar vehicle
RECORDS = 6  # of one time in a history: height, rise, tilt about two axes, velocity along two


@compiled
def is_given(parameters: Record) -> bool:
    """Whether anything is to be held."""
    return parameters.fixed_height_std > 0.0 or parameters.non_holonomic_std > 0.0


@compiled
def hold(ekf: Record, parameters: Record, t: float, records: np.ndarray) -> None:
    """Hold every hypothesis, predicted to stamp t, s, on its floor."""
    ekf.next_floor = t + PERIOD
    innovation, R, std = ekf.innovation, ekf.transition.rotation, parameters.fixed_height_std
    rolls = parameters.non_holonomic_std > 0.0 and (ekf.sensed or velocity.drives(ekf.velocity, t))
    for h in range(HYPOTHESES):
        hypothesis, best = ekf.hypotheses[h], h == ekf.best
        if not hypotheses.alive(hypothesis):
            continue
        if std > 0.0 and hypothesis.P[2, 2] > std**2:
            update_state(hypothesis, innovation, 2, parameters.fixed_height, std)
            if best:
                add_update(ekf, t, records)
        if parameters.planar and hypothesis.P[5, 5] > RISE_STD**2:
            update_state(hypothesis, innovation, 5, 0.0, RISE_STD)
            if best:
                add_update(ekf, t, records)
        for axis in range(2):
            if parameters.planar and _is_tilted(
                hypothesis, axis, parameters.tilt_std, R, innovation
            ):
                kalman(hypothesis, innovation)
                if best:
                    add_update(ekf, t, records)
            if rolls:
                velocity.compare(
                    hypothesis, 0.0, parameters.non_holonomic_std, 1 + axis, R, innovation
                )
                total = innovation.prior_variance + innovation.noise_variance
                w = weight(GEMAN_MCCLURE, innovation.value / math.sqrt(total), velocity.GATE)
                alike = 2.0 * velocity.CORRELATION_TIME / PERIOD
                innovation.total_variance = (
                    innovation.prior_variance + innovation.noise_variance * alike / w
                )
                kalman(hypothesis, innovation)
                if best:
                    add_update(ekf, t, records)


@compiled
def _is_tilted(
    hypothesis: Record, axis: int, std: float, R: np.ndarray, innovation: Record
) -> bool:
    """Fill in that the vertical has no component along an axis of the body, 0 or 1, and R (3, 3),
    body to world. Returns whether a HYPOTHESIS knows less of that.

    u = R' e_z; with the true attitude R Exp(dtheta), du = u x dtheta.
    """
    x, other = hypothesis.x, 1 - axis
    rotation(x[6], x[7], x[8], x[9], R)
    sign = 1.0 if axis == 1 else -1.0
    innovation.entries = 2
    innovation.states[0], innovation.row[0] = 6 + other, sign * R[2, 2]
    innovation.states[1], innovation.row[1] = 8, -sign * R[2, other]
    innovation.value, innovation.noise_variance = -R[2, axis], std**2
    project(hypothesis.P, innovation)
    innovation.total_variance = innovation.prior_variance + innovation.noise_variance
    return innovation.prior_variance > std**2


@compiled
def flatten(row: Record, parameters: Record, wrong: float) -> None:
    """Make one of ODOMETRY that of a planar vehicle: at its height, level, neither rising nor
    tilting; with the deviations that these have.
    wrong : m, by which TDOAs contradict the height.
    """
    x, P = row.x, row.covariance
    yaw = math.atan2(2.0 * (x[9] * x[8] + x[6] * x[7]), 1.0 - 2.0 * (x[7] ** 2 + x[8] ** 2))
    x[2], x[5], x[6], x[7], x[8], x[9] = (
        parameters.fixed_height,
        0.0,
        0.0,
        0.0,
        math.sin(0.5 * yaw),
        math.cos(0.5 * yaw),
    )
    row.consider_covariance[2, :] = 0.0
    row.consider_covariance[:, 2] = 0.0
    for state in (2, 5, 6, 7):
        P[state, :] = 0.0
        P[:, state] = 0.0
    P[2, 2], P[5, 5] = parameters.fixed_height_std**2 + wrong**2, RISE_STD**2
    P[6, 6] = P[7, 7] = parameters.tilt_std**2


@compiled
def flatten_all(rows: np.ndarray, parameters: np.ndarray) -> None:
    """`flatten` (n,) of ODOMETRY; parameters : (1,) of PARAMETERS."""
    for k in range(len(rows)):
        flatten(rows[k], parameters[0], 0.0)
