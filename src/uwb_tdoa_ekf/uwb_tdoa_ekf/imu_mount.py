"""An IMU that is turned and off the origin of the body: its samples as one in the origin would
measure them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from scipy.spatial.transform import Rotation

SLOW = (
    0.02  # s; angular acceleration is the slope of the rate after a low pass of this time constant
)
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
        self._slow: np.ndarray = np.zeros(
            3
        )  # s, stamp of the last sample, and slow part of its rate, rad/s

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
