# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Convert between the conventions of the filter, of ROS messages, and of a rotated IMU.

nav_msgs/Odometry follows REP 105 and the comments in its message definition.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors.sensor import UNKNOWN_VARIANCE
from uwb_tdoa_bias.correction.poses import known_yaw_std

from .core.state import rotation

if TYPE_CHECKING:
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from numpy.typing import ArrayLike
    from scipy.spatial.transform import Rotation

    from uwb_tdoa_bias.ros.topics import Epoch

    from .results import Odometry


POSE, TWIST = 3 + 4 + 36, 3 + 3 + 36  # numbers in a PoseWithCovariance and in a TwistWithCovariance


def to_odometry(
    q: np.ndarray, v: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the velocity in the body frame and the covariance as in nav_msgs/Odometry.

    The velocity is u = R(q)' v. An attitude error dtheta in the body frame is R dtheta in the world
    frame. With a velocity error dv, the error of u is R' dv + u x dtheta.

    Parameters
    ----------
    q : (n, 4) array
        Quaternions x y z w, body to world.
    v : (n, 3) array
        Velocity in the world frame, in m/s.
    covariance : (n, 9, 9) array
        Covariance of [p, v, attitude], the attitude error in the body frame.

    Returns
    -------
    u : (n, 3) array
        Velocity in the body frame, in m/s.
    covariance : (n, 9, 9) array
        Covariance of [position, rotation about the world axes, u].
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
    # Fill u and out of to_odometry. The Jacobian maps [p, v, attitude] to [p, rotation, u].
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
    # Write the product of two (9, 9) matrices to out.
    for i in range(9):
        for j in range(9):
            total = 0.0
            for k in range(9):
                total += a[i, k] * b[k, j]
            out[i, j] = total


def rotation_std(q: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return standard deviations of the rotation about the world axes, (n, 3) rad.

    They equal the diagonal of the covariance from to_odometry, which describes the parameters.
    """
    out = np.empty((len(q), 3))
    _rotation_std(np.ascontiguousarray(q), np.ascontiguousarray(covariance), out)
    return out


@compiled
def _rotation_std(q: np.ndarray, covariance: np.ndarray, out: np.ndarray) -> None:
    # Fill out, (n, 3) rad, with the roots of the diagonal of R P R'.
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
    """Return the poses that a Corrector needs of an Odometry, as bias_node receives them.

    Returns
    -------
    t : (n,) array
        Stamps, in s.
    p : (n, 3) array
        Position in the world frame, in m.
    q : (n, 4) array
        Quaternions x y z w, body to world.
    v : (n, 3) array
        Velocity in the world frame, in m/s.
    yaw_std : (n,) array
        Standard deviation of the yaw, in rad.
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
    """Return the numbers of PoseWithCovariance, (n, POSE), and of TwistWithCovariance, (n, TWIST).

    Parameters
    ----------
    odometry : Odometry
        n estimates.
    rates : (n, 3) array
        Angular velocity in the body frame, in rad/s; NaN if unknown.
    rate_variances : (n, 3) array
        Their variances, in rad^2/s^2.
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
    # Fill the covariances of pose and twist, (6, 6) by rows, and the angular rates. Unknown rates
    # are 0 with UNKNOWN_VARIANCE, as the message has no other mark for them.
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


# s, time constant of the low-pass filter whose slope is the angular acceleration
SLOW = 0.02
LONGEST_STEP = 0.1  # s between samples above which the angular acceleration is taken as 0


class ImuMount:
    """Convert samples of a rotated, off-center IMU to the origin and axes of the body.

    The specific force at the origin is f - dw/dt x arm - w x (w x arm). All vectors are in the body
    frame. This is rigid body kinematics (e.g. Groves, Principles of GNSS, Inertial, and Multisensor
    Integrated Navigation Systems, 2013, section 2.3).

    Parameters
    ----------
    rotation : Rotation
        Rotation from the IMU frame to the body frame.
    arm : (3,) array
        Lever arm: position of the IMU in the body frame, in m.
    """

    def __init__(self, rotation: Rotation, arm: ArrayLike) -> None:
        self._matrix, self._arm = rotation.as_matrix(), np.asarray(arm, dtype=float)
        self._centred = not self._arm.any()
        self._t: float | None = None
        # s, stamp of the last sample; rad/s, low-pass filtered rate
        self._slow: np.ndarray = np.zeros(3)

    def __eq__(self, other: object) -> bool:
        """Return whether rotation and lever arm are equal."""
        return (
            isinstance(other, ImuMount)
            and (self._matrix == other._matrix).all()
            and (self._arm == other._arm).all()
        )

    def in_body(
        self, t: np.ndarray, gyro: np.ndarray, accel: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (gyro, accel) in the body frame, in rad/s and m/s^2.

        Parameters
        ----------
        t : (n,) array
            Stamps, in s, ascending except for outliers.
        gyro : (n, 3) array
            Angular velocity in the IMU frame, in rad/s.
        accel : (n, 3) array
            Specific force in the IMU frame, in m/s^2.
        """
        gyro, accel = gyro @ self._matrix.T, accel @ self._matrix.T
        if not self._centred:
            slopes = np.zeros_like(gyro)
            for k in np.flatnonzero(np.isfinite(gyro).all(axis=1)):
                slopes[k] = self._angular_acceleration(t[k], gyro[k])
            accel = accel - np.cross(slopes, self._arm) - np.cross(gyro, np.cross(gyro, self._arm))
        return gyro, accel

    def _angular_acceleration(self, t: float, gyro: np.ndarray) -> np.ndarray:
        """Return the slope of the low-pass filtered rate, (3,) rad/s^2."""
        dt = np.inf if self._t is None else t - self._t
        if dt <= 0.0:
            return np.zeros(3)
        before, self._t = self._slow, t
        if dt > LONGEST_STEP:
            self._slow = gyro
            return np.zeros(3)
        self._slow = before + min(1.0, dt / SLOW) * (gyro - before)
        return (self._slow - before) / dt


LARGEST = 1e16  # m^2, square of a distance that no anchor has


def pose_from_message(
    message: PoseWithCovarianceStamped, world: str, epoch: Epoch, newest: float
) -> tuple[float, np.ndarray, np.ndarray, float, float]:
    """Return the pose and covariance of a PoseWithCovarianceStamped.

    A coordinate, or the yaw, with variance 0 counts as unknown and is returned as NaN.

    Parameters
    ----------
    message : PoseWithCovarianceStamped
        Message from `initialpose`.
    world : str
        Name of the world frame.
    epoch : Epoch
        Conversion from stamps to seconds.
    newest : float
        Stamp of the newest measurement, in s. A pose without stamp gets this stamp.

    Returns
    -------
    t : float
        Stamp, in s.
    p : (3,) array
        Position in the world frame, in m.
    covariance : (3, 3) array
        Covariance of the position, in m^2.
    yaw, yaw_std : float
        Yaw in the world frame and its standard deviation, in rad.

    Raises
    ------
    InputError
        If the frame, the stamp, or a number cannot be used.
    """
    frame = message.header.frame_id
    if frame not in ("", world):
        raise InputError(
            f"its frame is '{frame}', and the filter's is '{world}'; give it in that (RViz: "
            "Fixed Frame)."
        )
    stamp, p, q = message.header.stamp, message.pose.pose.position, message.pose.pose.orientation
    covariance = np.reshape(message.pose.covariance, (6, 6))
    variances = np.diag(covariance)
    numbers = [p.x, p.y, p.z, q.x, q.y, q.z, q.w, *covariance.ravel()]
    if not (np.abs(numbers) <= LARGEST).all() or (variances < 0.0).any():
        raise InputError(
            f"it holds numbers that are not finite or above {LARGEST:g}, or negative "
            "variances; give others."
        )
    if np.linalg.eigvalsh(0.5 * (covariance + covariance.T)[:3, :3]).min() < -1e-9:
        raise InputError(
            "its covariance is none: the correlations are larger than 1; give a smaller "
            "off-diagonal."
        )
    at = np.where(variances[:3] > 0.0, [p.x, p.y, p.z], math.nan)
    t = epoch.seconds(stamp) if stamp.sec or stamp.nanosec else newest
    if not math.isfinite(t):
        raise InputError(
            "it has no stamp, and there is no measurement whose time it could have; give it a "
            "stamp."
        )
    length = math.hypot(q.x, q.y, q.z, q.w)
    if not variances[5] > 0.0 or length < 0.5:
        return t, at, covariance[:3, :3], math.nan, math.nan
    yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), length**2 - 2.0 * (q.y**2 + q.z**2))
    return t, at, covariance[:3, :3], yaw, math.sqrt(variances[5])
