# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Constraints of a vehicle on its floor: fixed height, planar motion and non-holonomic motion.

The height is known. A planar vehicle is also level and does not rise. A vehicle that cannot move
sideways has no velocity across its x axis. A constraint that is given once must not shrink the
covariance again and again. So a state is constrained only while its variance exceeds the variance
of the constraint.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from . import height, hypotheses, velocity
from .history import add_update
from .memory import HYPOTHESES
from .state import CONSTRAINT_PERIOD, isolate, rotation, yaw_of
from .update import GATE, kalman, kalman_direct, kalman_robust, project

RISE_STD = 0.02  # m/s, of the vertical velocity of a planar vehicle
# records in a history per application: height, rise, tilt about two axes, velocity along two
RECORDS = 6


@compiled
def is_given(parameters: Record) -> bool:
    """Return whether the user has set any constraint."""
    return parameters.fixed_height_std > 0.0 or parameters.non_holonomic_std > 0.0


@compiled
def hold(ekf: Record, parameters: Record, t: float, records: np.ndarray) -> None:
    """Apply the floor constraints to every hypothesis, predicted to stamp t.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    parameters : PARAMETERS
        Tuning of the filter.
    t : float
        Stamp, s.
    records : (n,) RECORD
        History for the smoother; empty for no recording.
    """
    ekf.next_floor = t + CONSTRAINT_PERIOD
    innovation, R, std = ekf.innovation, ekf.transition.rotation, parameters.fixed_height_std
    rolls = parameters.non_holonomic_std > 0.0 and (
        ekf.sensed or velocity.agrees(ekf.velocity, t, velocity.HELD)
    )
    alike = 2.0 * velocity.CORRELATION_TIME / CONSTRAINT_PERIOD
    held = height.holds(ekf, parameters, t, records)
    for h in range(HYPOTHESES):
        hypothesis = ekf.hypotheses[h]
        if not hypotheses.alive(hypothesis):
            continue
        if held and hypothesis.P[2, 2] > std**2:
            kalman_direct(hypothesis, innovation, 2, parameters.fixed_height, std)
            add_update(ekf, h, t, records)
        if parameters.planar and hypothesis.P[5, 5] > RISE_STD**2:
            kalman_direct(hypothesis, innovation, 5, 0.0, RISE_STD)
            add_update(ekf, h, t, records)
        for axis in range(2):
            if parameters.planar and _is_tilted(
                hypothesis, axis, parameters.tilt_std, R, innovation
            ):
                kalman(hypothesis, innovation)
                add_update(ekf, h, t, records)
            if rolls:
                velocity.compare(
                    hypothesis, 0.0, parameters.non_holonomic_std, 1 + axis, R, innovation
                )
                kalman_robust(hypothesis, innovation, alike, GATE)
                add_update(ekf, h, t, records)


@compiled
def _is_tilted(
    hypothesis: Record, axis: int, std: float, R: np.ndarray, innovation: Record
) -> bool:
    """Fill in the constraint that a body axis is horizontal, and return whether to apply it.

    Measurement model: u = R' e_z. With the true attitude R Exp(dtheta), du = u x dtheta.

    Parameters
    ----------
    hypothesis : HYPOTHESIS
        Hypothesis, predicted to the stamp.
    axis : int
        Body axis, 0 or 1.
    std : float
        Standard deviation of the tilt, rad.
    R : (3, 3) array
        Rotation from body to world. Filled.
    innovation : INNOVATION
        Filled by this function.

    Returns
    -------
    bool
        Whether the variance of the tilt exceeds std**2.
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
    """Change an odometry row to a planar vehicle: fixed height, level, neither rising nor tilting.

    Parameters
    ----------
    row : ODOMETRY
        Changed in place. The covariance gets the configured deviations of height, rise and tilt.
    parameters : PARAMETERS
        Tuning of the filter.
    wrong : float
        Difference between the height that TDOAs show and the fixed height, m.
    """
    x, P = row.x, row.covariance
    yaw = yaw_of(x)
    x[2], x[5] = parameters.fixed_height, 0.0
    x[6], x[7], x[8], x[9] = 0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)
    row.consider_covariance[2, :] = 0.0
    row.consider_covariance[:, 2] = 0.0
    isolate(P, 2, parameters.fixed_height_std**2 + wrong**2)
    isolate(P, 5, RISE_STD**2)
    isolate(P, 6, parameters.tilt_std**2)
    isolate(P, 7, parameters.tilt_std**2)


@compiled
def flatten_all(rows: np.ndarray, parameters: np.ndarray) -> None:
    """Apply `flatten` to (n,) ODOMETRY; parameters is (1,) PARAMETERS."""
    for k in range(len(rows)):
        flatten(rows[k], parameters[0], 0.0)
