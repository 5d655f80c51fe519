# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Nominal state, error state, and their prediction with an IMU sample.

Nominal state x, (16,): position p (m) and velocity v (m/s) in the world, quaternion q (x y z w,
body to world), accelerometer bias (m/s^2) and gyroscope bias (rad/s) in the body frame. Error
state, (15,), with covariance P: [dp, dv, dtheta, dba, dbg]. The true attitude is q * Exp(dtheta),
with dtheta (rad) in the body frame. Motion model: eq. 14 of Zhao et al. (RA-L 2021).
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

GRAVITY = 9.81  # m/s^2, along -z of the world
# s between two searches for the tag, checks of rest, tests of the yaw, and merges of hypotheses
CHECK_PERIOD = 0.1
CONSTRAINT_PERIOD = 0.05  # s between two updates of a tag at rest, or of a vehicle on its floor
NOMINAL_STATES, ERROR_STATES = 16, 15
MOVING_STATES = 9  # first error states; the states behind are biases, which only random-walk

Quaternion = tuple[float, float, float, float]  # x, y, z, w

# Transition of the error state over a step: the blocks that differ from the identity, see
# `propagate`.
TRANSITION = np.dtype(
    [
        ("dt", float),  # s
        ("rotation", float, (3, 3)),  # body to world, at the beginning of the step
        ("velocity_attitude", float, (3, 3)),  # -R [f]x dt
        ("velocity_accel_bias", float, (3, 3)),  # -R diag(accel_weight) dt
        ("attitude_attitude", float, (3, 3)),  # Exp(-w dt)
        # scratch: upper rows of the transition times a matrix
        ("product", float, (MOVING_STATES, ERROR_STATES)),
    ],
    align=True,
)


@compiled
def rotation(qx: float, qy: float, qz: float, qw: float, R: np.ndarray) -> None:
    """Compute the rotation matrix R (3, 3), body to world, from a unit quaternion."""
    R[0, 0] = 1 - 2 * (qy * qy + qz * qz)
    R[0, 1] = 2 * (qx * qy - qz * qw)
    R[0, 2] = 2 * (qx * qz + qy * qw)
    R[1, 0] = 2 * (qx * qy + qz * qw)
    R[1, 1] = 1 - 2 * (qx * qx + qz * qz)
    R[1, 2] = 2 * (qy * qz - qx * qw)
    R[2, 0] = 2 * (qx * qz - qy * qw)
    R[2, 1] = 2 * (qy * qz + qx * qw)
    R[2, 2] = 1 - 2 * (qx * qx + qy * qy)


@compiled
def exponential(r0: float, r1: float, r2: float) -> Quaternion:
    """Return Exp(r): the quaternion (x, y, z, w) of a rotation vector in rad."""
    angle = math.sqrt(r0 * r0 + r1 * r1 + r2 * r2)
    s = 0.5 if angle < 1e-8 else math.sin(0.5 * angle) / angle
    return s * r0, s * r1, s * r2, math.cos(0.5 * angle)


@compiled
def product(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the product a * b of two quaternions."""
    return (
        a[3] * b[0] + a[0] * b[3] + a[1] * b[2] - a[2] * b[1],
        a[3] * b[1] - a[0] * b[2] + a[1] * b[3] + a[2] * b[0],
        a[3] * b[2] + a[0] * b[1] - a[1] * b[0] + a[2] * b[3],
        a[3] * b[3] - a[0] * b[0] - a[1] * b[1] - a[2] * b[2],
    )


@compiled
def turn(x: np.ndarray, bx: float, by: float, bz: float, bw: float) -> None:
    """Turn the attitude of a nominal state x (16,) in the body frame: q <- q * b, normalised.

    b is the unit quaternion (bx, by, bz, bw) of the rotation.
    """
    q = product((x[6], x[7], x[8], x[9]), (bx, by, bz, bw))
    n = 1.0 / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    x[6], x[7], x[8], x[9] = q[0] * n, q[1] * n, q[2] * n, q[3] * n


@compiled
def inject(x: np.ndarray, direction: np.ndarray, size: float) -> None:
    """Add the error direction * size, (15,), to the nominal state x (16,)."""
    for j in range(6):
        x[j] += direction[j] * size
    turn(x, *exponential(direction[6] * size, direction[7] * size, direction[8] * size))
    for j in range(9, ERROR_STATES):
        x[j + 1] += direction[j] * size


@compiled
def isolate(P: np.ndarray, state: int, variance: float) -> None:
    """Make an error state independent of all others in a covariance P, with a variance."""
    P[state, :] = 0.0
    P[:, state] = 0.0
    P[state, state] = variance


@compiled
def predict(
    hypothesis: Record, imu: Record, parameters: Record, dt: float, transition: Record
) -> None:
    """Predict a HYPOTHESIS over dt with an inertial sample.

    Parameters
    ----------
    hypothesis : HYPOTHESIS
        State and covariance, updated in place.
    imu : IMU_STATE
        Holds the input: angular rate (rad/s) and specific force (m/s^2) in the body frame, and its
        noise.
    parameters : PARAMETERS
        Tuning of the filter.
    dt : float
        Duration, s.
    transition : TRANSITION
        Filled by this function.
    """
    _move(hypothesis.x, imu, dt, transition)
    P, T = hypothesis.P, transition.product
    propagate(P, transition)
    A, B, E = (  # P <- T Phi', T = Phi P: one triangle is computed, the rest is mirrored.
        transition.velocity_attitude,
        transition.velocity_accel_bias,
        transition.attitude_attitude,
    )
    for i in range(MOVING_STATES):
        for j in range(MOVING_STATES, ERROR_STATES):
            P[i, j] = P[j, i] = T[i, j]
    for r in range(3):
        a0, a1, a2 = A[r, 0], A[r, 1], A[r, 2]
        b0, b1, b2 = B[r, 0], B[r, 1], B[r, 2]
        e0, e1, e2 = E[r, 0], E[r, 1], E[r, 2]
        for i in range(r + 1):
            P[i, r] = P[r, i] = T[i, r] + dt * T[i, 3 + r]
        for i in range(3 + r + 1):
            by_attitude = a0 * T[i, 6] + a1 * T[i, 7] + a2 * T[i, 8]
            by_bias = b0 * T[i, 9] + b1 * T[i, 10] + b2 * T[i, 11]
            P[i, 3 + r] = P[3 + r, i] = T[i, 3 + r] + by_attitude + by_bias
        for i in range(6 + r + 1):
            by_rotation = e0 * T[i, 6] + e1 * T[i, 7] + e2 * T[i, 8]
            P[i, 6 + r] = P[6 + r, i] = by_rotation - dt * T[i, 12 + r]
    _add_noise(P, transition.rotation, imu, parameters, dt)


@compiled
def _move(x: np.ndarray, imu: Record, dt: float, transition: Record) -> None:
    """Predict the nominal state over dt (s) and fill in the TRANSITION.

    The specific force lies between hovering (gravity along body z) and the measurement.
    imu.accel_weight sets the share of the measurement for each axis.
    """
    R, weight = transition.rotation, imu.accel_weight
    rotation(x[6], x[7], x[8], x[9], R)
    f0 = weight[0] * (imu.accel[0] - x[10])
    f1 = weight[1] * (imu.accel[1] - x[11])
    f2 = GRAVITY + weight[2] * (imu.accel[2] - x[12] - GRAVITY)
    transition.dt = dt
    for r in range(3):
        a = R[r, 0] * f0 + R[r, 1] * f1 + R[r, 2] * f2 - (GRAVITY if r == 2 else 0.0)
        x[r] += dt * (x[3 + r] + 0.5 * dt * a)
        x[3 + r] += dt * a
        transition.velocity_attitude[r, 0] = dt * (R[r, 2] * f1 - R[r, 1] * f2)
        transition.velocity_attitude[r, 1] = dt * (R[r, 0] * f2 - R[r, 2] * f0)
        transition.velocity_attitude[r, 2] = dt * (R[r, 1] * f0 - R[r, 0] * f1)
        for c in range(3):
            transition.velocity_accel_bias[r, c] = -dt * R[r, c] * weight[c]
    w0, w1, w2 = (imu.gyro[0] - x[13]) * dt, (imu.gyro[1] - x[14]) * dt, (imu.gyro[2] - x[15]) * dt
    bx, by, bz, bw = exponential(w0, w1, w2)
    turn(x, bx, by, bz, bw)
    rotation(-bx, -by, -bz, bw, transition.attitude_attitude)


@compiled
def propagate(M: np.ndarray, transition: Record) -> None:
    """Compute transition.product, the upper rows of Phi M, for a matrix M (15, 15).

    The lower rows of M stay the same. The blocks of Phi that differ from the identity follow from:
    dp' = dp + dv dt; dv' = dv - R ([f]x dtheta + W dba) dt; dtheta' = Exp(-w dt) dtheta - dbg dt.
    """
    dt, out = transition.dt, transition.product
    A, B, E = (
        transition.velocity_attitude,
        transition.velocity_accel_bias,
        transition.attitude_attitude,
    )
    for r in range(3):
        # read before the loop, which is then vectorized
        a0, a1, a2 = A[r, 0], A[r, 1], A[r, 2]
        b0, b1, b2 = B[r, 0], B[r, 1], B[r, 2]
        e0, e1, e2 = E[r, 0], E[r, 1], E[r, 2]
        for j in range(ERROR_STATES):
            out[r, j] = M[r, j] + dt * M[3 + r, j]
            by_attitude = a0 * M[6, j] + a1 * M[7, j] + a2 * M[8, j]
            by_bias = b0 * M[9, j] + b1 * M[10, j] + b2 * M[11, j]
            out[3 + r, j] = M[3 + r, j] + by_attitude + by_bias
            out[6 + r, j] = e0 * M[6, j] + e1 * M[7, j] + e2 * M[8, j] - dt * M[12 + r, j]


@compiled
def propagate_vector(vector: np.ndarray, transition: Record) -> None:
    """Multiply a vector (15,) of the error state by Phi in place, see `propagate`."""
    dt = transition.dt
    A, B, E = (
        transition.velocity_attitude,
        transition.velocity_accel_bias,
        transition.attitude_attitude,
    )
    t0, t1, t2 = vector[6], vector[7], vector[8]
    for r in range(3):
        vector[r] += dt * vector[3 + r]
        by_attitude = A[r, 0] * t0 + A[r, 1] * t1 + A[r, 2] * t2
        by_bias = B[r, 0] * vector[9] + B[r, 1] * vector[10] + B[r, 2] * vector[11]
        vector[3 + r] += by_attitude + by_bias
        vector[6 + r] = E[r, 0] * t0 + E[r, 1] * t1 + E[r, 2] * t2 - dt * vector[12 + r]


@compiled
def _add_noise(P: np.ndarray, R: np.ndarray, imu: Record, parameters: Record, dt: float) -> None:
    """Add the process noise over dt (s) to the covariance P (15, 15).

    It consists of the white noise of the sensors and the random walks of their biases. R (3, 3) is
    body to world. imu is an IMU_STATE, whose noise is in the body frame.
    """
    accel_psd = imu.accel_psd
    s0, s1, s2 = dt * accel_psd[0], dt * accel_psd[1], dt * accel_psd[2]
    for r in range(3):
        for c in range(r, 3):
            P[3 + r, 3 + c] += (
                R[r, 0] * s0 * R[c, 0] + R[r, 1] * s1 * R[c, 1] + R[r, 2] * s2 * R[c, 2]
            )
            P[3 + c, 3 + r] = P[3 + r, 3 + c]
        P[6 + r, 6 + r] += dt * (parameters.gyro_noise**2 + imu.gyro_psd[r])
        P[9 + r, 9 + r] += dt * parameters.accel_bias_walk**2
        P[12 + r, 12 + r] += dt * parameters.gyro_bias_walk**2


@compiled
def coast(hypothesis: Record, dt: float, accel_psd: float, tilt_psd: float, yaw_psd: float) -> None:
    """Predict a HYPOTHESIS without inertial samples: constant velocity, constant attitude.

    Parameters
    ----------
    hypothesis : HYPOTHESIS
        State and covariance, updated in place.
    dt : float
        Duration, s.
    accel_psd : float
        Power spectral density of the random acceleration, (m/s^2)^2/Hz.
    tilt_psd, yaw_psd : float
        Growth of the variance of the attitude about x and y, and about z, of the body, (rad/s)^2/Hz.
    """
    x, P = hypothesis.x, hypothesis.P
    # P <- F P F': first the rows of the position, then its columns; only dp' = dp + dt dv changes
    for i in range(3):
        x[i] += dt * x[3 + i]
        for j in range(ERROR_STATES):
            P[i, j] += dt * P[3 + i, j]
    for i in range(3):
        for j in range(i, 3):
            P[i, j] += dt * P[i, 3 + j]
        for j in range(i, ERROR_STATES):
            P[j, i] = P[i, j]
    # Noise of velocity and attitude alone: its parts in the position (dt^2 / 2, dt^3 / 3) and the
    # random walks of the biases are left out.
    for i in range(3):
        P[3 + i, 3 + i] += dt * accel_psd
        P[6 + i, 6 + i] += dt * (yaw_psd if i == 2 else tilt_psd)


@compiled
def yaw_of(x: np.ndarray) -> float:
    """Return the yaw of a nominal state, in rad."""
    qx, qy, qz, qw = x[6], x[7], x[8], x[9]
    return math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))


@compiled
def turn_about_vertical(x: np.ndarray, angle: float) -> None:
    """Rotate the attitude of a nominal state by an angle (rad) about the z axis of the world.

    The attitude error stays the same, because it is in the body frame.
    """
    sine, cosine = math.sin(0.5 * angle), math.cos(0.5 * angle)
    qx, qy, qz, qw = x[6], x[7], x[8], x[9]
    x[6], x[7] = cosine * qx - sine * qy, cosine * qy + sine * qx
    x[8], x[9] = cosine * qz + sine * qw, cosine * qw - sine * qz


@compiled
def difference(
    a: np.ndarray, b: np.ndarray
) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return the error from nominal state a to b, without biases: [dp, dv, dtheta], 9 elements.

    dtheta is the rotation vector in the body frame of a, as `inject` adds it.
    """
    inverse = -a[6], -a[7], -a[8], a[9]
    x, y, z, w = product(inverse, (b[6], b[7], b[8], b[9]))
    if w < 0.0:
        x, y, z, w = -x, -y, -z, -w
    norm = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 if norm < 1e-9 else 2.0 * math.atan2(norm, w) / norm
    return (
        b[0] - a[0],
        b[1] - a[1],
        b[2] - a[2],
        b[3] - a[3],
        b[4] - a[4],
        b[5] - a[5],
        scale * x,
        scale * y,
        scale * z,
    )
