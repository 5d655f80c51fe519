# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Velocity in the body frame: wheels, optical flow, visual odometry.

Slip and lost features show as innovations. A velocity with a yaw rate comes from wheels. Without
inertial samples, wheels drive the prediction: the yaw turns by their yaw rate, and the velocity of
the state follows theirs. Their errors persist for CORRELATION_TIME and become process noise of
position and yaw. With inertial samples, velocities are measurements, and the yaw rate shows the
bias of the gyroscope.

Wheels give the path of the last seconds, up to its place and heading. They are refused while TDOAs
fit another path much better. If TDOAs fit their path, but with another heading than that of the
filter, its yaw is wrong.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.geometry import linearized_tdoa

from . import ground, yaw_check
from .height import STUCK_TIME
from .history import add_update
from .hypotheses import add_log_likelihood, alive
from .memory import REJECTED, USED
from .state import rotation, yaw_of
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
MOVING = 0.3  # m/s; a faster velocity that is used confirms the yaw
# Hz, sample rate of a gyroscope: the noise of a sample is gyro_noise * sqrt(GYRO_RATE)
GYRO_RATE = 100.0
# s of a path that is compared with TDOAs, their least number, and s between two comparisons
SECONDS, FEWEST, PERIOD = (2.0, 24, 0.25)
# Excess of the sum of squared residuals that contradicts a path: in variances of a TDOA, and as rms in
# m, to which the deviation of the wheels over 1 s is added. In simulated drives without a fault it is
# 61 variances with 0.05 m, or 25 with 0.15 m.
SHOWN, LARGE = (30.0, 0.1)
SCALES = (0.85, 1.0, 1.15)  # of a velocity that is right
TURNED = 10.0  # s after which the opposite of a confirmed heading is that of a tag that was turned
LED = 0.3  # m from TDOAs beyond which wrong wheels have led the filter away
HEADINGS = 2.0 * math.pi / 48.0 * np.arange(48)  # rad
# entries of a fit with any acceleration and of one along the path, see `_accumulate`
FREE, PATH = np.array([0, 1, 2, 3, 4, 5, 6, 9]), np.array([0, 3, 6, 7, 8, 10])
SWEEPS, COARSE = (7, 2.0)  # Gauss-Newton steps, and m, limit of the residuals in the first


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
    if of_wheels:
        _extend_path(ekf, sensor)
    state.heard = sensor.t
    leads = of_wheels and not ekf.sensed
    inflation = max(1.0, 2.0 * CORRELATION_TIME / dt)
    worst = _worst(ekf, sensor, residual)
    state.nis += min(1.0, dt / AVERAGE) * (min(worst, GATE**4) - state.nis)
    # simulated wheels turn evenly, so they may repeat values
    stuck = frozen and (state.refused or (np.any(state.value != 0.0) and not of_wheels))
    disagrees = state.nis > (AGREES if state.refused else DISAGREES)
    state.refused = disagrees or stuck or state.contradicted
    residual.weight, residual.verdict = 0.0, REJECTED
    used = not (state.refused or worst > GATE**2)
    doubt = ekf.yaw_test
    if used:
        residual.weight, residual.verdict = 1.0, USED
        if np.sum(sensor.value[:2] ** 2) > MOVING**2:
            doubt.unconfirmed -= dt
        if of_wheels:
            state.agreed, state.yaw_rate = sensor.t, sensor.value[YAW_RATE]
            state.yaw_rate_variance = sensor.std[YAW_RATE] ** 2
            state.speed_variance = sensor.std[0] ** 2 if sensor.std[0] <= LONGEST_STD else 0.0
    elif not (doubt.alone and doubt.unconfirmed > 0.0):
        return
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
            innovation.weight = 0.0
            if used:
                add_log_likelihood(hypothesis, innovation, inflation)
                w = kalman_robust(hypothesis, innovation, 1.0 if leads else inflation, GATE)
                add_update(ekf, h, sensor.t, records)
                if h == ekf.best:
                    residual.weight = min(residual.weight, w)
            if doubt.alone:
                _test_yaw(ekf, sensor, axis, inflation)
        if used and of_wheels and ekf.sensed:
            _compare_yaw_rate(hypothesis, sensor, ekf.imu, innovation)
            innovation.prior_variance += GYRO_RATE * parameters.gyro_noise**2
            kalman_robust(hypothesis, innovation, inflation, GATE)
            add_update(ekf, h, sensor.t, records)


@compiled
def agrees(state: Record, t: float, seconds: float) -> bool:
    """Return whether wheels, by their VELOCITY state, have agreed within `seconds` before stamp t (s).

    Within HELD they drive the prediction. Slip ends within SLIP, so older agreement does not count.
    """
    return not state.refused and t - state.agreed < seconds


@compiled
def carry(state: Record, t: float, pose: np.ndarray) -> None:
    """Fill in the pose to which the last velocity of a VELOCITY state leads at stamp t (s).

    pose (3,) is x and y in m and the heading in rad, in the frame of the path.
    """
    vx, vy, rate = state.path_velocity[0], state.path_velocity[1], state.path_velocity[2]
    dt = t - state.path_until
    if dt > HELD:  # the path ends, and a new one does not use this pose
        return
    heading = state.pose[2] + 0.5 * dt * rate
    c, s = math.cos(heading), math.sin(heading)
    pose[0] = state.pose[0] + dt * (c * vx - s * vy)
    pose[1] = state.pose[1] + dt * (s * vx + c * vy)
    pose[2] = state.pose[2] + dt * rate


@compiled
def _extend_path(ekf: Record, sensor: Record) -> None:
    """Extend the path of wheels to the stamp of a velocity.

    The gyroscope turns it, or without inertial samples the yaw rate of the wheels.
    """
    state, x, R = ekf.velocity, ekf.hypotheses[ekf.best].x, ekf.transition.rotation
    carry(state, sensor.t, state.pose)
    if sensor.t - state.path_until > HELD or sensor.std[0] > LONGEST_STD:
        state.path_since = sensor.t
    state.path_until = sensor.t
    rotation(x[6], x[7], x[8], x[9], R)
    c, s = math.cos(yaw_of(x)), math.sin(yaw_of(x))
    vx, vy = _horizontal(R, sensor)
    state.path_velocity[0], state.path_velocity[1] = c * vx + s * vy, c * vy - s * vx
    state.path_velocity[2] = (
        np.sum(R[2] * (ekf.imu.gyro - x[13:])) if ekf.sensed else sensor.value[YAW_RATE]
    )


@compiled
def _horizontal(R: np.ndarray, sensor: Record) -> tuple[float, float]:
    """Return the velocity of a SENSOR_ROW along x and y of the world, m/s; R turns body to world."""
    return np.sum(R[0] * sensor.value[:3]), np.sum(R[1] * sensor.value[:3])


@compiled
def compare_path(
    ekf: Record, anchors: np.ndarray, window: np.ndarray, std: float, t: float
) -> float:
    """Compare the path of wheels with TDOAs, and return by which angle the yaw must turn, rad.

    It is 0.0 for none. Two paths are fitted: that of the wheels, with any place and heading, and one
    with any constant acceleration. The wheels are refused while the second is much better.

    Parameters
    ----------
    ekf : EKF
        State of the filter; its velocity is updated.
    anchors : (N,) ANCHOR
        All anchors, by row.
    window : (n,) TDOA
        TDOAs of the last SECONDS.
    std : float
        Standard deviation of a TDOA, m.
    t : float
        Stamp, s.
    """
    state, x, n = ekf.velocity, ekf.hypotheses[ekf.best].x, len(window)
    state.next_look = t + PERIOD
    if t - state.path_until > HELD:
        state.contradicted = False
        return 0.0
    if n < FEWEST or not state.path_since < window[0].t < t - 0.75 * SECONDS:
        return 0.0
    fit, gram = np.zeros(7), np.zeros((11, 11))
    fit[0], fit[3], fit[6] = x[0], x[1], x[2]
    for sweep in range(SWEEPS):
        step = gram[:, FREE][:7].copy()
        ground.solve(step)
        fit += step[:, 7]
        _accumulate(window, anchors, x, fit, max(COARSE * 0.5**sweep, GATE * std), gram)
    free, of_path = gram[9, 9], gram[PATH][:, PATH].copy()
    variance = max(free / (n - 7), (0.7 * std) ** 2)
    needed = max(SHOWN * variance, n * (LARGE**2 + state.speed_variance))
    for k in range(3):  # the place
        of_path -= np.outer(of_path[k] / of_path[k, k], of_path[k])
    costs = np.array([_cost(of_path, angle) for angle in HEADINGS])
    least, heading = np.min(costs), yaw_of(x) - window[n - 1].pose[2]
    if variance > std**2:  # late anchors may make the difference
        return 0.0
    turns = _cost(of_path, heading) - least >= needed
    # a body does not turn round at once: wheels report the opposite direction
    opposite = _cost(of_path, state.heading + math.pi) - least < needed
    opposite &= t - state.confirmed < TURNED and _cost(of_path, state.heading) - least >= needed
    contradicted = opposite or least - free > (0.5 if state.contradicted else 1.0) * needed
    away = math.hypot(np.sum(fit[:3]) - x[0], np.sum(fit[3:6]) - x[1])
    if contradicted and not state.contradicted and agrees(state, t, SLIP) and away > LED:
        ekf.distrusted = True
    state.contradicted = contradicted
    if contradicted or state.refused:
        return 0.0
    if turns:
        return HEADINGS[np.argmin(costs)] - heading
    if np.max(costs) - least >= needed:
        state.heading, state.confirmed = heading, t
    return 0.0


@compiled
def _accumulate(
    window: np.ndarray,
    anchors: np.ndarray,
    x: np.ndarray,
    fit: np.ndarray,
    limit: float,
    gram: np.ndarray,
) -> None:
    """Fill in the information of a window of TDOAs, for the paths of `compare_path`.

    gram (11, 11) is the sum of squares of the entries of each TDOA: Jacobian with respect to fit (7),
    with respect to cosine and sine of the heading (2), residual of fit, and residual of a path at x.
    fit is three coefficients of x, three of y, and z, in m. Residuals beyond limit (m) have a smaller
    weight.
    """
    first, middle, last = window[0], window[len(window) // 2], window[len(window) - 1]
    half, p, row, entries = 0.5 * (last.t - first.t), np.empty(3), np.empty(3), np.empty(11)
    gram[:, :] = 0.0
    gram[6, 6], gram[6, 9] = 1.0, x[2] - fit[6]  # z is about that of the filter
    for i in range(len(window)):
        tdoa = window[i]
        tau = (tdoa.t - first.t) / half - 1.0
        powers = np.array([1.0, tau, tau**2])
        p[0], p[1], p[2] = np.sum(powers * fit[:3]), np.sum(powers * fit[3:6]), fit[6]
        predicted = linearized_tdoa(p, anchors[tdoa.a].position, anchors[tdoa.b].position, row)
        dx, dy = tdoa.pose[0] - middle.pose[0], tdoa.pose[1] - middle.pose[1]
        entries[:3], entries[3:6], entries[6] = row[0] * powers, row[1] * powers, row[2]
        entries[7], entries[8] = row[0] * dx + row[1] * dy, row[1] * dx - row[0] * dy
        entries[9] = tdoa.d - predicted
        entries[10] = entries[9] + np.sum(row * (p - x[:3]))
        gram += min(1.0, limit / max(abs(entries[9]), 1e-9)) * np.outer(entries, entries)


@compiled
def _cost(of_path: np.ndarray, heading: float) -> float:
    """Return the sum of squared residuals, m^2, of the path with a heading (rad), of the best scale."""
    least = np.inf
    for scale in SCALES:
        u = np.array([scale * math.cos(heading), scale * math.sin(heading), -1.0])
        least = min(least, np.sum(np.outer(u, u) * of_path[3:, 3:]))
    return least


@compiled
def _complete(sensor: Record, parameters: Record) -> None:
    """Set missing standard deviations of a SENSOR_ROW to the configured ones, and reduce them at rest.

    The reduction by STANDING applies to wheels that do not turn.
    """
    sensor.std[:3] = np.where(sensor.std[:3] == 0.0, parameters.velocity_std, sensor.std[:3])
    if sensor.std[YAW_RATE] == 0.0:
        sensor.std[YAW_RATE] = (
            parameters.yaw_rate_std if parameters.yaw_rate_std > 0.0 else 2.0 * LONGEST_STD
        )
    if sensor.std[YAW_RATE] > LONGEST_STD or np.any(sensor.value != 0.0):
        return
    sensor.std[:] = np.where(sensor.std <= LONGEST_STD, STANDING * sensor.std, sensor.std)


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
    """Return the largest normalized innovation squared of the components, least of all hypotheses.

    A velocity that fits one hypothesis decides between them. The residual is filled with its component.
    """
    innovation, least = ekf.innovation, np.inf
    for h in range(len(ekf.hypotheses)):
        if not alive(ekf.hypotheses[h]):
            continue
        worst, value, variance = -1.0, 0.0, 0.0
        for axis in range(3):
            if sensor.std[axis] <= LONGEST_STD:
                compare(
                    ekf.hypotheses[h],
                    sensor.value[axis],
                    sensor.std[axis],
                    axis,
                    ekf.transition.rotation,
                    innovation,
                )
                total = innovation.prior_variance + innovation.noise_variance
                if innovation.value**2 / total > worst:
                    worst, value, variance = innovation.value**2 / total, innovation.value, total
        if worst < least:
            least, residual.innovation, residual.variance = worst, value, variance
    return least


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
def _test_yaw(ekf: Record, sensor: Record, axis: int, inflation: float) -> None:
    """Update the test of the yaw with the innovation of one axis of a SENSOR_ROW.

    A yaw error turns the measured velocity in the world frame.
    """
    R = ekf.transition.rotation
    vx, vy = _horizontal(R, sensor)
    x, y = R[0, axis], R[1, axis]
    yaw_check.observe(ekf, inflation, True, -x * vx - y * vy, x * vy - y * vx)


@compiled
def _compare_yaw_rate(hypothesis: Record, sensor: Record, imu: Record, innovation: Record) -> None:
    """Fill in the innovation of a yaw rate: it measures the bias of the gyroscope.

    imu is an IMU_STATE; its last angular rate is compared with the yaw rate of the SENSOR_ROW.
    """
    innovation.entries, innovation.states[0], innovation.row[0] = 1, GYRO_BIAS, -1.0
    innovation.value = sensor.value[YAW_RATE] - (imu.gyro[2] - hypothesis.x[GYRO_BIAS + 1])
    innovation.noise_variance = sensor.std[YAW_RATE] ** 2
    project(hypothesis.P, innovation)
