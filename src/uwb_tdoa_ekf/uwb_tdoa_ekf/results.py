# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Define the results of the filter: estimates, and the outcome of each TDOA.

Estimates are converted to the numbers of nav_msgs/Odometry, by REP 105 and the comments in its
message definition.
"""

from __future__ import annotations

from collections.abc import Sequence, Sized
from dataclasses import dataclass
import math
from typing import TypeVar

import numpy as np

from uwb_tdoa_bias.common.arrays import Stamped
from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.sensors.sensor import UNKNOWN_VARIANCE
from uwb_tdoa_bias.correction.corrector import known_yaw_std

from .core.memory import COMPENSATED, INVALID, LATE, REJECTED, REPEATED, STARTUP, USED
from .core.state import rotation

VERDICTS = {
    USED: "used",
    REJECTED: "rejected",
    LATE: "late",
    INVALID: "invalid",
    STARTUP: "startup",
    COMPENSATED: "compensated",
    REPEATED: "repeated",
}
POSE, TWIST = 3 + 4 + 36, 3 + 3 + 36  # numbers in a PoseWithCovariance and in a TwistWithCovariance
OF_ROW = "innovation", "variance", "weight", "verdict"  # fields of memory.RESIDUAL


@dataclass(frozen=True)
class Residuals(Stamped):
    """Store the outcome of each TDOA.

    Attributes
    ----------
    t : (n,) array
        Stamps, in s.
    a, b : (n,) array
        Anchor ids.
    innovation : (n,) array
        Innovation, in m. NaN unless the filter used, rejected or compensated the TDOA.
    variance : (n,) array
        Variance of the innovation, in m^2, NaN where the innovation is.
    weight : (n,) array
        Robust weight, 0 to 1.
    verdict : (n,) array
        Keys of VERDICTS.
    """

    t: np.ndarray
    a: np.ndarray
    b: np.ndarray
    innovation: np.ndarray
    variance: np.ndarray
    weight: np.ndarray
    verdict: np.ndarray

    @classmethod
    def from_rows(cls, t: np.ndarray, a: np.ndarray, b: np.ndarray, rows: np.ndarray) -> Residuals:
        """Return the Residuals of TDOAs from (n,) of memory.RESIDUAL.

        Parameters
        ----------
        t : (n,) array
            Stamps, in s.
        a, b : (n,) array
            Anchor ids.
        rows : (n,) array of memory.RESIDUAL
            Outcomes.
        """
        return cls(t, a, b, *(rows[name] for name in OF_ROW))

    @classmethod
    def refused(
        cls, t: np.ndarray, a: np.ndarray, b: np.ndarray, verdict: int | np.ndarray
    ) -> Residuals:
        """Return the Residuals of TDOAs that did not reach the filter.

        Parameters
        ----------
        t : (n,) array
            Stamps, in s.
        a, b : (n,) array
            Anchor ids.
        verdict : int or (n,) array
            Verdict of all, or of each.
        """
        n = len(t)
        unknown = np.full(n, math.nan)
        return cls(t, a, b, unknown, unknown, np.zeros(n), np.full(n, verdict, np.uint8))


@dataclass(frozen=True)
class Odometry(Stamped):
    """Store estimates of the filter.

    Attributes
    ----------
    t : (n,) array
        Stamps, in s.
    p : (n, 3) array
        Position in the world frame, in m.
    v : (n, 3) array
        Velocity in the world frame, in m/s.
    q : (n, 4) array
        Quaternions x y z w, body to world.
    accel_bias : (n, 3) array
        Accelerometer bias in the body frame, in m/s^2.
    gyro_bias : (n, 3) array
        Gyroscope bias in the body frame, in rad/s.
    covariance : (n, 9, 9) array
        Covariance of [p, v, attitude], the attitude error in the body frame, in rad.
    consider_covariance : (n, 3, 3) array
        Part of the position covariance from errors that do not average out, in m^2.
    rate, rate_variance : (n, 3) array
        Angular rate in the body frame, in rad/s, and its variances; NaN where nothing measures it.
    """

    t: np.ndarray
    p: np.ndarray
    v: np.ndarray
    q: np.ndarray
    accel_bias: np.ndarray
    gyro_bias: np.ndarray
    covariance: np.ndarray
    consider_covariance: np.ndarray
    rate: np.ndarray = None  # type: ignore[assignment]  # becomes NaN
    rate_variance: np.ndarray = None  # type: ignore[assignment]  # becomes NaN

    def __post_init__(self) -> None:
        for name in ("rate", "rate_variance"):
            if getattr(self, name) is None:
                object.__setattr__(self, name, np.full((len(self.t), 3), math.nan))

    @classmethod
    def from_rows(cls, rows: np.ndarray) -> Odometry:
        """Return the Odometry of (n,) of memory.ODOMETRY."""
        x = rows["x"]
        return cls(
            rows["t"],
            x[:, :3],
            x[:, 3:6],
            x[:, 6:10],
            x[:, 10:13],
            x[:, 13:],
            rows["covariance"],
            rows["consider_covariance"],
            rows["rate"],
            rows["rate_variance"],
        )


# a dataclass of arrays of equal length: Odometry, Residuals, a stream of a Flight
Arrays = TypeVar("Arrays", bound=Sized)


def rows_of(part: Arrays, rows: np.ndarray | slice) -> Arrays:
    """Return selected rows of a dataclass of arrays of equal length."""
    return type(part)(*(column[rows] for column in vars(part).values()))


def concatenated(parts: Sequence[Arrays]) -> Arrays:
    """Return the concatenation of several dataclasses of arrays, at least one."""
    parts = [part for part in parts if len(part)] or parts[:1]
    return (
        parts[0]
        if len(parts) == 1
        else type(parts[0])(*map(np.concatenate, zip(*(vars(part).values() for part in parts))))
    )


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
    of_axes = to_odometry(q, np.zeros((len(q), 3)), covariance)[1][:, 3:6, 3:6]
    return np.sqrt(np.diagonal(of_axes, axis1=1, axis2=2))


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
    rates, rate_variances = map(np.ascontiguousarray, (rates, rate_variances))
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
