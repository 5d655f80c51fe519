# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Convert samples of a rotated IMU, and poses that the user sets, to what the filter takes."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.errors import InputError

if TYPE_CHECKING:
    from geometry_msgs.msg import PoseWithCovarianceStamped
    from numpy.typing import ArrayLike
    from scipy.spatial.transform import Rotation

    from uwb_tdoa_bias.ros.topics import Epoch

# s, time constant of the low-pass filter whose slope is the angular acceleration
SLOW = 0.02
LONGEST_STEP = 0.1  # s between samples, either way, above which the angular acceleration is 0


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
        if -LONGEST_STEP < dt <= 0.0:
            return np.zeros(3)
        before, self._t = self._slow, t
        if abs(dt) > LONGEST_STEP:  # a gap, or the stamps start again
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
