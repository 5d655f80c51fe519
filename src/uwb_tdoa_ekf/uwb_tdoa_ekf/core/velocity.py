# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Velocity in the body frame: wheels, optical flow, visual odometry.

Slip and lost features show as innovations. A velocity with a yaw rate comes from wheels. Without
inertial samples, wheels drive the prediction: the yaw turns by their yaw rate, and the velocity of
the state follows theirs. Their errors persist for CORRELATION_TIME and become process noise of
position and yaw. With inertial samples, velocities are measurements, and the yaw rate shows the
bias of the gyroscope.
"""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from .height import STUCK_TIME
from .history import add_update
from .hypotheses import add_log_likelihood, alive
from .memory import REJECTED, USED
from .state import rotation
from .update import GATE, kalman_robust, project

# Set on the six flights of 0425/TDOA2, see docs/notebook/auxiliary_sensors.md. They have no wheels:
# SLIP, HELD and STANDING were set on simulated drives.
CORRELATION_TIME = 1.0  # s over which the error of a velocity persists
LONGEST_STD = 1e3  # m/s and rad/s; a component with a larger standard deviation is not measured
# equal velocities, in STUCK_TIME at least, after which the sensor of a vibrating tag is stuck
STUCK_COUNT = 5
AVERAGE = 0.5  # s over which innovations are averaged to compare the sensor with all others
# mean normalized innovation squared above which the sensor is refused, and below which it is used
# again
DISAGREES, AGREES = (4.0, 2.0)
# index of the yaw rate in a SENSOR_ROW, and of the error state of the gyroscope bias about z
YAW_RATE, GYRO_BIAS = (3, 14)
SLIP = 2.0  # s for which disagreeing wheels may slip
HELD = 0.5  # s for which the last velocity of wheels drives the prediction
STANDING = 0.1  # factor on the standard deviations of wheels that do not turn at all
# Hz, sample rate of a gyroscope: the noise of a sample is gyro_noise * sqrt(GYRO_RATE)
GYRO_RATE = 100.0


@compiled
def observe(
    ekf: Record, parameters: Record, sensor: Record, residual: Record, records: np.ndarray
) -> None:
    """Update a running filter with a velocity.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    parameters : PARAMETERS
        Tuning of the filter.
    sensor : SENSOR_ROW
        Velocity (m/s, body frame) and yaw rate (rad/s). Missing standard deviations are set.
    residual : RESIDUAL
        Filled with the component that has the largest normalized innovation.
    records : (n,) RECORD
        History for the smoother; empty for no recording.
    """
    state, innovation = ekf.velocity, ekf.innovation
    dt = min(max(sensor.t - state.heard, 1e-3), AVERAGE)
    _complete(sensor, parameters)
    of_wheels = sensor.std[YAW_RATE] <= LONGEST_STD
    frozen = _repeats(state, sensor) and not ekf.quiet
    state.heard = sensor.t
    leads = of_wheels and not ekf.sensed
    inflation = max(1.0, 2.0 * CORRELATION_TIME / dt)
    worst = _worst(ekf, sensor, residual)
    state.nis += min(1.0, dt / AVERAGE) * (min(worst, GATE**4) - state.nis)
    # simulated wheels turn evenly, so they may repeat values
    stuck = frozen and (state.refused or (np.any(state.value != 0.0) and not of_wheels))
    state.refused = state.nis > (AGREES if state.refused else DISAGREES) or stuck
    residual.weight, residual.verdict = 0.0, REJECTED
    if state.refused or worst > GATE**2:
        return
    residual.weight, residual.verdict = 1.0, USED
    if of_wheels:
        state.agreed, state.yaw_rate = sensor.t, sensor.value[YAW_RATE]
        state.yaw_rate_variance = sensor.std[YAW_RATE] ** 2
        state.speed_variance = sensor.std[0] ** 2 if sensor.std[0] <= LONGEST_STD else 0.0
    for h in range(len(ekf.hypotheses)):
        hypothesis = ekf.hypotheses[h]
        if not alive(hypothesis):
            continue
        for axis in range(3):
            if sensor.std[axis] > LONGEST_STD:
                continue
            compare(
                hypothesis,
                sensor.value[axis],
                sensor.std[axis],
                axis,
                ekf.transition.rotation,
                innovation,
            )
            add_log_likelihood(hypothesis, innovation, inflation)
            w = kalman_robust(hypothesis, innovation, 1.0 if leads else inflation, GATE)
            add_update(ekf, h, sensor.t, records)
            if h == ekf.best:
                residual.weight = min(residual.weight, w)
        if of_wheels and ekf.sensed:
            _compare_yaw_rate(hypothesis, sensor, ekf.imu, innovation)
            innovation.prior_variance += GYRO_RATE * parameters.gyro_noise**2
            kalman_robust(hypothesis, innovation, inflation, GATE)
            add_update(ekf, h, sensor.t, records)


@compiled
def drives(state: Record, t: float) -> bool:
    """Return whether wheels, by their VELOCITY state, drive the prediction at stamp t (s)."""
    return not state.refused and t - state.agreed < HELD


@compiled
def agrees(state: Record, t: float) -> bool:
    """Return whether wheels, by their VELOCITY state, have agreed lately at stamp t (s).

    Slip ends within SLIP seconds, so older agreement does not count.
    """
    return t - state.agreed < SLIP


@compiled
def _complete(sensor: Record, parameters: Record) -> None:
    """Set missing standard deviations of a SENSOR_ROW to the configured ones, and reduce them at rest.

    The reduction by STANDING applies to wheels that do not turn.
    """
    for axis in range(3):
        if sensor.std[axis] == 0.0:
            sensor.std[axis] = parameters.velocity_std
    if sensor.std[YAW_RATE] == 0.0:
        sensor.std[YAW_RATE] = (
            parameters.yaw_rate_std if parameters.yaw_rate_std > 0.0 else 2.0 * LONGEST_STD
        )
    if sensor.std[YAW_RATE] > LONGEST_STD:
        return
    for axis in range(4):
        if sensor.value[axis] != 0.0:
            return
    for axis in range(4):
        if sensor.std[axis] <= LONGEST_STD:
            sensor.std[axis] *= STANDING


@compiled
def _repeats(state: Record, sensor: Record) -> bool:
    """Store a velocity and return whether the sensor has repeated it for too long.

    A working sensor never repeats a value for this long.
    """
    since = sensor.t - state.heard
    for k in range(4):
        if sensor.std[k] <= LONGEST_STD and sensor.value[k] != state.value[k]:
            state.value[k], state.changed = sensor.value[k], sensor.t
    return sensor.t - state.changed > max(STUCK_TIME, STUCK_COUNT * since)


@compiled
def _worst(ekf: Record, sensor: Record, residual: Record) -> float:
    """Return the largest normalized innovation squared of the components, for the best hypothesis.

    The residual is filled with this component.
    """
    innovation, worst = ekf.innovation, -1.0
    for axis in range(3):
        if sensor.std[axis] > LONGEST_STD:
            continue
        compare(
            ekf.hypotheses[ekf.best],
            sensor.value[axis],
            sensor.std[axis],
            axis,
            ekf.transition.rotation,
            innovation,
        )
        total = innovation.prior_variance + innovation.noise_variance
        nis = innovation.value**2 / total
        if nis > worst:
            worst, residual.innovation, residual.variance = nis, innovation.value, total
    return worst


@compiled
def compare(
    hypothesis: Record, value: float, std: float, axis: int, R: np.ndarray, innovation: Record
) -> None:
    """Fill in the innovation of a velocity component in the body frame.

    Measurement model: u = R' v. With the true attitude q * Exp(dtheta), du = R' dv + [u]x dtheta.

    Parameters
    ----------
    hypothesis : HYPOTHESIS
        Hypothesis, predicted to the stamp of the measurement.
    value, std : float
        Measured component and its standard deviation, m/s.
    axis : int
        Body axis, 0 to 2.
    R : (3, 3) array
        Rotation from body to world. Filled.
    innovation : INNOVATION
        Filled by this function.
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
    innovation.value = value - u
    innovation.noise_variance = std**2
    project(hypothesis.P, innovation)


@compiled
def _compare_yaw_rate(hypothesis: Record, sensor: Record, imu: Record, innovation: Record) -> None:
    """Fill in the innovation of a yaw rate: it measures the bias of the gyroscope.

    imu is an IMU_STATE; its last angular rate is compared with the yaw rate of the SENSOR_ROW.
    """
    innovation.entries, innovation.states[0], innovation.row[0] = 1, GYRO_BIAS, -1.0
    innovation.value = sensor.value[YAW_RATE] - (imu.gyro[2] - hypothesis.x[GYRO_BIAS + 1])
    innovation.noise_variance = sensor.std[YAW_RATE] ** 2
    project(hypothesis.P, innovation)
