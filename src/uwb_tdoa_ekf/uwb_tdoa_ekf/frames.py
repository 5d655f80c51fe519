"""From the filter's conventions to those of nav_msgs/Odometry (REP-105, and the comments of its
definition).

The filter: position and velocity in the world, attitude error in the body frame. Odometry: pose in
the parent (world) frame with rotations about its fixed axes, twist in the child (body) frame.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.sensors.sensor import UNKNOWN_VARIANCE
from uwb_tdoa_bias.correction.poses import known_yaw_std

from .core.state import rotation

if TYPE_CHECKING:
    from .results import Odometry

POSE, TWIST = 3 + 4 + 36, 3 + 3 + 36  # numbers in a PoseWithCovariance and in a TwistWithCovariance


def to_odometry(
    q: np.ndarray, v: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Velocity in the body frame, and the covariance of what an Odometry holds.

    q : (n, 4) x y z w, body to world; v : (n, 3) m/s, world; covariance : (n, 9, 9) of [p, v,
        attitude], the attitude
    in the body frame. Returns u = R(q)' v, (n, 3) m/s, and (n, 9, 9) of [position, rotation about
    the world's axes, u]. An attitude error dtheta is R dtheta in the world; with an error dv, u
    changes by R' dv + u x dtheta.
    """
    u, out = np.empty((len(q), 3)), np.empty((len(q), 9, 9))
    _to_odometry(
        np.ascontiguousarray(q), np.ascontiguousarray(v), np.ascontiguousarray(covariance), u, out
    )
    return u, out


@compiled
def _to_odometry(
    q: np.ndarray, v: np.ndarray, covariance: np.ndarray, u: np.ndarray, out: np.ndarray
) -> None:
    R, jacobian, half = np.empty((3, 3)), np.zeros((9, 9)), np.empty((9, 9))
    for n in range(len(q)):
        rotation(q[n, 0], q[n, 1], q[n, 2], q[n, 3], R)
        for i in range(3):
            u[n, i] = R[0, i] * v[n, 0] + R[1, i] * v[n, 1] + R[2, i] * v[n, 2]
            jacobian[i, i] = 1.0
            for j in range(3):
                jacobian[3 + i, 6 + j] = R[i, j]
                jacobian[6 + i, 3 + j] = R[j, i]
        jacobian[6, 7], jacobian[6, 8] = -u[n, 2], u[n, 1]  # [u]x
        jacobian[7, 6], jacobian[7, 8] = u[n, 2], -u[n, 0]
        jacobian[8, 6], jacobian[8, 7] = -u[n, 1], u[n, 0]
        _multiply(jacobian, covariance[n], half)
        _multiply(half, jacobian.T, out[n])


@compiled
def _multiply(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    for i in range(9):
        for j in range(9):
            total = 0.0
            for k in range(9):
                total += a[i, k] * b[k, j]
            out[i, j] = total


def rotation_std(q: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Standard deviations of the rotation about the world's axes, (n, 3) rad: those of to_odometry.
    Arguments as there, without v.
    """
    out = np.empty((len(q), 3))
    _rotation_std(np.ascontiguousarray(q), np.ascontiguousarray(covariance), out)
    return out


@compiled
def _rotation_std(q: np.ndarray, covariance: np.ndarray, out: np.ndarray) -> None:
    R = np.empty((3, 3))
    for n in range(len(q)):
        rotation(q[n, 0], q[n, 1], q[n, 2], q[n, 3], R)
        for axis in range(3):
            variance = 0.0
            for i in range(3):
                for j in range(3):
                    variance += R[axis, i] * covariance[n, 6 + i, 6 + j] * R[axis, j]
            out[n, axis] = math.sqrt(variance)


def poses_of(
    odometry: Odometry,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """What a Corrector takes of an Odometry, as bias_node gets it: (t (n,) s, p (n, 3) m, q (n, 4),
    v (n, 3) m/s, yaw_std (n,) rad).
    """
    return (
        odometry.t,
        odometry.p,
        odometry.q,
        odometry.v,
        known_yaw_std(rotation_std(odometry.q, odometry.covariance)),
    )


def pose_and_twist(
    odometry: Odometry, rates: np.ndarray, rate_variances: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The numbers of PoseWithCovariance, (n, POSE), and of TwistWithCovariance, (n, TWIST), of
    Odometry messages.
    """
    velocity, covariance = to_odometry(odometry.q, odometry.v, odometry.covariance)
    pose, twist = np.empty((len(odometry), POSE)), np.zeros((len(odometry), TWIST))
    pose[:, :3], pose[:, 3:7], twist[:, :3] = odometry.p, odometry.q, velocity
    _fill(covariance, rates, rate_variances, pose, twist)
    return pose, twist


@compiled
def _fill(
    covariance: np.ndarray,
    rates: np.ndarray,
    rate_variances: np.ndarray,
    pose: np.ndarray,
    twist: np.ndarray,
) -> None:
    for n in range(len(pose)):
        for i in range(6):
            for j in range(6):
                pose[n, 7 + 6 * i + j] = covariance[n, i, j]
        for i in range(3):
            known = math.isfinite(rates[n, i]) and math.isfinite(rate_variances[n, i])
            twist[n, 3 + i] = rates[n, i] if known else 0.0
            twist[n, 6 + 7 * (3 + i)] = rate_variances[n, i] if known else UNKNOWN_VARIANCE
            for j in range(3):
                twist[n, 6 + 6 * i + j] = covariance[n, 6 + i, 6 + j]
