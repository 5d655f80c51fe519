"""Convert between the conventions of the filter, of ROS messages, and of a turned IMU.

nav_msgs/Odometry: REP-105, and the comments of its definition.
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


# s; angular acceleration is the slope of the rate after a low pass of this time constant
SLOW = 0.02
LONGEST_STEP = 0.1  # s between samples, above which there is no slope


class ImuMount:
    """rotation : Rotation, IMU to body; arm (3,) m, of the IMU in the body.

    Specific force of the origin: f - dw/dt x arm - w x (w x arm), with everything in the body frame
    (rigid body kinematics, e.g. Groves, Principles of GNSS, Inertial, and Multisensor Integrated
    Navigation Systems, 2013, section 2.3).
    """

    def __init__(self, rotation: Rotation, arm: ArrayLike) -> None:
        self._matrix, self._arm = rotation.as_matrix(), np.asarray(arm, dtype=float)
        self._centred = not self._arm.any()
        self._t: float | None = None
        # s, stamp of the last sample, and slow part of its rate, rad/s
        self._slow: np.ndarray = np.zeros(3)

    def __eq__(self, other: object) -> bool:
        """Whether it sits in the same place."""
        return (
            isinstance(other, ImuMount)
            and (self._matrix == other._matrix).all()
            and (self._arm == other._arm).all()
        )

    def in_body(
        self, t: np.ndarray, gyro: np.ndarray, accel: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """gyro (n, 3) rad/s and accel (n, 3) m/s^2 in the body frame, of samples at t (n,) s.

        Stamps rise, but for outliers.
        """
        gyro, accel = gyro @ self._matrix.T, accel @ self._matrix.T
        if not self._centred:
            slopes = np.zeros_like(gyro)
            for k in np.flatnonzero(np.isfinite(gyro).all(axis=1)):
                slopes[k] = self._angular_acceleration(t[k], gyro[k])
            accel = accel - np.cross(slopes, self._arm) - np.cross(gyro, np.cross(gyro, self._arm))
        return gyro, accel

    def _angular_acceleration(self, t: float, gyro: np.ndarray) -> np.ndarray:
        """rad/s^2, (3,): slope of the slow part."""
        dt = np.inf if self._t is None else t - self._t
        if dt <= 0.0:
            return np.zeros(3)
        before, self._t = self._slow, t
        if dt > LONGEST_STEP:
            self._slow = gyro
            return np.zeros(3)
        self._slow = before + min(1.0, dt / SLOW) * (gyro - before)
        return (self._slow - before) / dt


LARGEST = 1e16  # the square of what is far for an anchor, m^2


def pose_from_message(
    message: PoseWithCovarianceStamped, world: str, epoch: Epoch, newest: float
) -> tuple[float, np.ndarray, np.ndarray, float, float]:
    """(t s, p (3,) m, covariance (3, 3) m^2, yaw rad, its standard deviation rad) of a
    PoseWithCovarianceStamped.

    world : name of the world frame; epoch : Epoch; newest : s, stamp of the newest measurement,
        which a pose without
    stamp has. A coordinate, or the yaw, whose variance is 0 is not given, and NaN. Raises
    InputError.
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
