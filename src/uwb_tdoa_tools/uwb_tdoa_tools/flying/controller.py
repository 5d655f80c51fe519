# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fly a quadrotor by an estimate of position, velocity and attitude, and by its gyroscope.

The controller is a cascade. Position and velocity give a wanted acceleration. The acceleration gives
thrust and attitude (geometric control on SE(3): Lee, Leok and McClamroch, CDC 2010). The attitude
gives body rates, and the rates give rotor speeds. The outer part runs once per estimate, the inner
part at each sample of the gyroscope. Between estimates the gyroscope predicts the attitude. The code
is compiled and needs no ROS.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.geometry import rotate

from .vehicle import CORNERS, GRAVITY, ROTORS, SPIN, Record, Vehicle

SUPPORT_TIME = 0.1  # s over which the support by the ground is averaged


# gains, from an error to the first derivative of the next quantity
POSITION_GAIN = 1.5  # 1/s, position to velocity
VELOCITY_GAIN = 4.5  # 1/s, velocity to acceleration
INTEGRAL_GAIN = 0.7  # 1/s^2, integrated velocity error to acceleration
ATTITUDE_GAIN, YAW_GAIN = 8.0, 3.0  # 1/s, attitude to body rates
RATE_GAIN, YAW_RATE_GAIN = 40.0, 8.0  # 1/s, body rates to angular accelerations
DAMPING = 1.6  # share of the measured angular acceleration that acts against it
REACH = 0.75  # m, limit of the position error
MOST_INTEGRAL = 2.0  # m/s^2, limit of the integral part
MOST_TILT, MOST_RATE = 0.5, 6.0  # rad and rad/s
LEAST_THRUST, MOST_THRUST = 0.3, 1.8  # limits of the thrust, in units of the weight
YAW_SHARE = 0.1  # of the full thrust of a rotor: the yaw has the lowest priority
LEAST_SHARE = 0.01  # of the full thrust of a rotor, so that rotors do not stop in the air


class Controller:
    """Compute thrust and body rates from an estimate.

    Attributes
    ----------
    vehicle : Vehicle
        Vehicle as the controller assumes it.
    weight : float
        Its weight, N.
    thrust : float
        Wanted thrust of all rotors together, N.
    lift : float
        Thrust that the rotors have reached, averaged over SUPPORT_TIME, N.
    rates : numpy.ndarray
        Wanted body rates (3,), rad/s.
    integral : numpy.ndarray
        Integral part of the acceleration (3,), m/s^2, world frame.
    """

    def __init__(self, vehicle: Vehicle | None = None) -> None:
        """Start with the rotors off. The default is a Vehicle without deviations."""
        self.vehicle = vehicle or Vehicle()
        self.weight = self.vehicle.mass * GRAVITY
        self.rates, self.integral = np.zeros(3), np.zeros(3)
        self.thrust = self.lift = 0.0

    def fly(
        self, p: np.ndarray, v: np.ndarray, q: np.ndarray, wanted: np.ndarray, yaw: float, dt: float
    ) -> None:
        """Set thrust and rates for one turn.

        Parameters
        ----------
        p, v, q : numpy.ndarray
            Estimated position (3,) m, velocity (3,) m/s and attitude (4,) x y z w, world frame.
        wanted : numpy.ndarray
            Position, velocity and acceleration (3, 3), m and s. NaN in a position leaves it to the velocity.
        yaw : float
            Wanted yaw, rad.
        dt : float
            Time since the last call, s.
        """
        self.lift += min(1.0, dt / (self.vehicle.motor_time + 0.5 * SUPPORT_TIME)) * (
            self.thrust - self.lift
        )
        self.thrust = outer((p, v, q), wanted, yaw, dt, self.weight, self.integral, self.rates)

    def support(self, force: float) -> float:
        """Return the share of the weight that the ground carries.

        Parameters
        ----------
        force : float
            Measured specific force along the z axis of the body, m/s^2.
        """
        return force / GRAVITY - self.lift / (self.weight * (1.0 + self.integral[2] / GRAVITY))

    def stop(self) -> None:
        """Turn the rotors off."""
        self.thrust = self.lift = 0.0
        self.rates[:] = self.integral[:] = 0.0


@compiled
def outer(
    estimate: tuple[np.ndarray, np.ndarray, np.ndarray],
    wanted: np.ndarray,
    yaw: float,
    dt: float,
    weight: float,
    integral: np.ndarray,
    rates: np.ndarray,
) -> float:
    """Return the wanted thrust, N, and write `integral` and `rates`.

    Parameters
    ----------
    estimate : tuple
        Position, velocity and attitude, as in `Controller.fly`.
    wanted, yaw, dt
        As in `Controller.fly`.
    weight : float
        N.
    integral, rates : numpy.ndarray
        Integral part (3,) m/s^2 and body rates (3,) rad/s. Both are written.
    """
    p, v, q = estimate[0], estimate[1], estimate[2]
    error = np.where(np.isnan(wanted[0]), 0.0, wanted[0] - p)
    far = math.sqrt(error[0] ** 2 + error[1] ** 2 + error[2] ** 2)
    slow = wanted[1] + POSITION_GAIN * min(1.0, REACH / max(far, 1e-9)) * error - v
    grown = integral + INTEGRAL_GAIN * np.clip(slow, -0.5, 0.5) * dt
    integral[:] = np.clip(grown, -MOST_INTEGRAL, MOST_INTEGRAL)
    a = wanted[2] + VELOCITY_GAIN * slow + integral
    a[2] = max(a[2] + GRAVITY, LEAST_THRUST * GRAVITY)
    level, most = math.hypot(a[0], a[1]), math.tan(MOST_TILT) * a[2]
    a[:2] *= most / max(level, most)
    size = math.sqrt(a[0] ** 2 + a[1] ** 2 + a[2] ** 2)
    zx, zy, zz = a[0] / size, a[1] / size, a[2] / size
    # wanted axes: z along the thrust, x toward the yaw
    cy, sy = math.cos(yaw), math.sin(yaw)
    yx, yy, yz = -zz * sy, zz * cy, zx * sy - zy * cy
    length = math.sqrt(yx * yx + yy * yy + yz * yz)
    yx, yy, yz = yx / length, yy / length, yz / length
    xx, xy, xz = yy * zz - yz * zy, yz * zx - yx * zz, yx * zy - yy * zx
    x, y, z, s = q[0], q[1], q[2], q[3]
    r00, r01, r02 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * s), 2.0 * (x * z + y * s)
    r10, r11, r12 = 2.0 * (x * y + z * s), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * s)
    r20, r21, r22 = 2.0 * (x * z - y * s), 2.0 * (y * z + x * s), 1.0 - 2.0 * (x * x + y * y)
    # the three numbers of e = (Rd' R - R' Rd) / 2
    yz_, zy_ = yx * r02 + yy * r12 + yz * r22, zx * r01 + zy * r11 + zz * r21
    zx_, xz_ = zx * r00 + zy * r10 + zz * r20, xx * r02 + xy * r12 + xz * r22
    xy_, yx_ = xx * r01 + xy * r11 + xz * r21, yx * r00 + yy * r10 + yz * r20
    rates[0] = -ATTITUDE_GAIN * 0.5 * (zy_ - yz_)
    rates[1] = -ATTITUDE_GAIN * 0.5 * (xz_ - zx_)
    rates[2] = -YAW_GAIN * 0.5 * (yx_ - xy_)
    rates[:] = np.clip(rates, -MOST_RATE, MOST_RATE)
    along = a[0] * r02 + a[1] * r12 + a[2] * r22
    return weight / GRAVITY * min(max(along, LEAST_THRUST * GRAVITY), MOST_THRUST * GRAVITY)


@compiled
def inner(
    thrust: float,
    rates: np.ndarray,
    gyro: np.ndarray,
    dt: float,
    vehicle: Record,
    speeds: np.ndarray,
) -> None:
    """Compute rotor speeds from thrust and body rates: rate control and mixing.

    The body axes are x forward, y left, z up. Rotors are in the order of CORNERS. Without a wanted
    thrust all rotors stop.

    Parameters
    ----------
    thrust : float
        Wanted thrust, N.
    rates : numpy.ndarray
        Wanted body rates (3,), rad/s.
    gyro : numpy.ndarray
        Measured body rates (2, 3), rad/s, now and `dt` ago.
    dt : float
        Time between samples, s.
    vehicle : Record
        Record of the Vehicle that the controller assumes.
    speeds : numpy.ndarray
        Rotor speeds (4,), rad/s. They are written.
    """
    if thrust <= 0.0:
        speeds[:] = 0.0
        return
    mx = vehicle.inertia_xy * (
        RATE_GAIN * (rates[0] - gyro[0, 0]) - DAMPING * (gyro[0, 0] - gyro[1, 0]) / dt
    )
    my = vehicle.inertia_xy * (
        RATE_GAIN * (rates[1] - gyro[0, 1]) - DAMPING * (gyro[0, 1] - gyro[1, 1]) / dt
    )
    mz = vehicle.inertia_z * YAW_RATE_GAIN * (rates[2] - gyro[0, 2])
    full = vehicle.thrust * vehicle.top_speed**2  # N, of one rotor
    for k in range(ROTORS):
        # forces, N: each square of CORNERS is 0.5, so 0.5 arm is the lever of a rotor over CORNERS
        of_tilt = 0.25 * (CORNERS[k, 1] * mx - CORNERS[k, 0] * my) / (0.5 * vehicle.arm)
        of_yaw = 0.25 * SPIN[k] * mz * vehicle.thrust / vehicle.moment
        of_yaw = min(max(of_yaw, -YAW_SHARE * full), YAW_SHARE * full)
        force = 0.25 * thrust + of_tilt + of_yaw
        speeds[k] = math.sqrt(min(max(force, LEAST_SHARE * full), full) / vehicle.thrust)


@compiled
def integrate(
    since: float,
    p: np.ndarray,
    v: np.ndarray,
    q: np.ndarray,
    times: np.ndarray,
    samples: np.ndarray,
) -> None:
    """Propagate position, velocity and attitude by inertial samples, in place.

    Parameters
    ----------
    since : float
        Stamp of the three, s.
    p, v, q : numpy.ndarray
        Position (3,), m, and velocity (3,), m/s, world frame, and attitude (4,) x y z w.
    times, samples : numpy.ndarray
        Later stamps (n,), s. Body rates, rad/s, and specific forces, m/s^2 (n, 6).
    """
    force = np.empty(3)
    for j in range(len(times)):
        dt, since = times[j] - since, times[j]
        rotate_attitude(q, samples[j, :3], dt)
        rotate(q, samples[j, 3:], force)
        force[2] -= GRAVITY
        for k in range(3):
            v[k] += force[k] * dt
            p[k] += v[k] * dt


@compiled
def rotate_attitude(q: np.ndarray, rate: np.ndarray, dt: float) -> None:
    """Rotate an attitude by a constant body rate, in place.

    Parameters
    ----------
    q : numpy.ndarray
        Attitude (4,) x y z w, body to world.
    rate : numpy.ndarray
        Body rate (3,), rad/s.
    dt : float
        Duration, s.
    """
    angle = math.sqrt(rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2) * dt
    share = 0.5 * dt if angle < 1e-9 else math.sin(0.5 * angle) / angle * dt
    a, b, c, d = rate[0] * share, rate[1] * share, rate[2] * share, math.cos(0.5 * angle)
    x, y, z, w = q[0], q[1], q[2], q[3]
    q[0], q[1] = w * a + x * d + y * c - z * b, w * b - x * c + y * d + z * a
    q[2], q[3] = w * c + x * b - y * a + z * d, w * d - x * a - y * b - z * c
