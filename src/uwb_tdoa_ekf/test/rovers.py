# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Small simulated drives of a rover on a floor: wheels, an inertial sensor and TDOAs.

Every error is known.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas, Truth
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.common.sensors import Velocity

GRAVITY = 9.81
# m, m, rad: height and tilt of the body over a floor that is not quite even
HEIGHT, HEIGHT_STD, TILT_STD = (0.2, 0.02, 0.01)
FINE = 500.0  # Hz, rate of the motion
ANCHORS = [[0, 0, 2.4], [12, 0, 1.8], [12, 8, 2.4], [0, 8, 1.8], [6, 0, 0.9], [6, 8, 2.7]]
STOPS = (25.0, 60.0)  # s, begin of each stop
STOP = 4.0  # s, duration of a stop
TURN = 0.8  # rad/s


def hall():
    """Return six Anchors in 12 x 8 m."""
    return Anchors.from_positions(np.array(ANCHORS, dtype=float), ids=3 + np.arange(6))


def motion(rng, duration, speed):
    """Return the motion of a unicycle that follows a point, with stops.

    Returns stamps (n,) in s, positions (n, 2) in m, yaws, speeds and yaw rates (n,). The yaw rate
    is at most TURN rad/s.
    """
    t = np.arange(int(duration * FINE) + 1) / FINE
    pace = speed * (1.0 + 0.4 * np.sin(0.31 * t + rng.uniform(0.0, 6.0))) * np.minimum(1.0, t / 2.0)
    for begin in STOPS:
        pace *= 1.0 - np.clip(np.minimum(t - begin, begin + STOP - t) + 0.5, 0.0, 1.0)
    phase, u = rng.uniform(0.0, 2.0 * np.pi, 2), 0.13 * speed * t[:, None]
    ahead = np.array([6.0, 4.0]) + [4.5, 2.6] * np.sin([1.0, 1.7] * u + phase)
    p, yaw, rate = np.empty((len(t), 2)), np.empty(len(t)), np.zeros(len(t))
    p[0], yaw[0] = [6.0, 4.0] + rng.uniform(-2.0, 2.0, 2), rng.uniform(-np.pi, np.pi)
    for k in range(len(t) - 1):
        x, y = ahead[k] - p[k]
        off = (np.arctan2(y, x) - yaw[k] + np.pi) % (2.0 * np.pi) - np.pi
        wanted = np.clip(1.2 * off, -TURN, TURN) * min(1.0, pace[k] / (0.3 * speed))
        rate[k + 1] = rate[k] + (wanted - rate[k]) * 3.0 / FINE
        yaw[k + 1] = yaw[k] + rate[k] / FINE
        p[k + 1] = p[k] + pace[k] / FINE * np.array([np.cos(yaw[k]), np.sin(yaw[k])])
    return t, p, yaw, pace, rate


def drive(
    seed=0,
    duration=90.0,
    speed=0.5,
    begin=10.0,
    tdoa_std=0.12,
    delay_std=0.05,
    scale=0.02,
    stated=False,
):
    """Simulate the flight of a rover with its true pose.

    The IMU has 100 Hz, the wheels 50 Hz, and the TDOAs of random pairs 100 Hz. The wheels slip at
    times. They state a covariance only if `stated`. Each anchor has a constant error.
    """
    rng, anchors = np.random.default_rng(seed), hall()
    t, p, yaw, pace, rate = motion(rng, duration, speed)
    height, tilt = HEIGHT + HEIGHT_STD * rng.standard_normal(), TILT_STD * rng.standard_normal(2)

    def at(stamps):
        x, y, psi = (np.interp(stamps, t, column) for column in (*p.T, yaw))
        turn = Rotation.from_euler(
            "ZYX", np.column_stack([psi, np.full(len(psi), tilt[0]), np.full(len(psi), tilt[1])])
        )
        return np.column_stack([x, y, np.full(len(x), height)]), turn, psi

    imu_t = np.arange(int(duration * 100.0)) / 100.0
    _, turn, psi = at(imu_t)
    v, w, dv = (np.interp(imu_t, t, column) for column in (pace, rate, np.gradient(pace, t)))
    across = v * w
    a = np.stack(
        [
            dv * np.cos(psi) - across * np.sin(psi),
            dv * np.sin(psi) + across * np.cos(psi),
            np.full(len(v), GRAVITY),
        ],
        axis=1,
    )
    accel = (
        turn.inv().apply(a)
        + 0.05 * rng.standard_normal(3)
        + 0.05 * rng.standard_normal((len(v), 3))
    )
    gyro = (
        turn.inv().apply(np.outer(w, [0.0, 0.0, 1.0]))
        + 0.01 * rng.standard_normal(3)
        + 0.005 * rng.standard_normal((len(v), 3))
    )
    wheel_t = (np.arange(int(duration * 50.0)) + 0.37) / 50.0
    v, w = (np.interp(wheel_t, t, column) for column in (pace, rate))
    moving = np.abs(v) > 1e-3
    # During slip, the wheels turn faster than the rover moves, and unequally.
    for start in rng.uniform(0.05, 0.95, round(duration / 22.0)) * duration:
        slips = (wheel_t > start) & (wheel_t < start + 0.7)
        v, w = np.where(slips, 1.3 * v, v), np.where(slips, w + 0.15 * moving, w)
    n = len(v)
    wheels = np.zeros((n, 3))
    wheels[:, 0] = (1.0 + scale) * v + moving * 0.01 * rng.standard_normal(n)
    turned = w * (1.0 + 0.02 * rng.standard_normal()) + moving * 0.02 * rng.standard_normal(n)
    std = np.tile([0.02, 0.01, 0.01] if stated else [0.0, 0.0, 0.0], (n, 1))
    rate_std = np.full(n, 0.02 if stated else 0.0)
    tdoa_t = (
        np.arange(int(duration * 100.0)) + rng.uniform(0.1, 0.9, int(duration * 100.0))
    ) / 100.0
    n = len(tdoa_t)
    one = rng.integers(0, 6, n)
    other = (one + rng.integers(1, 6, n)) % 6
    delays, true = delay_std * rng.standard_normal(6), at(tdoa_t)[0]
    d = (
        tdoa(true, anchors.positions[one], anchors.positions[other])
        + delays[other]
        - delays[one]
        + tdoa_std * rng.standard_normal(n)
    )
    d += np.where(rng.random(n) < 0.03, rng.uniform(-2.0, 2.0, n), 0.0)
    truth_t = np.arange(0.0, duration, 0.01)
    position, turn, _ = at(truth_t)
    return Flight(
        name=f"rover-{seed}",
        anchors=anchors,
        tdoa=Tdoas(tdoa_t + begin, anchors.ids[one], anchors.ids[other], d),
        imu=Imu(imu_t + begin, gyro, accel),
        truth=Truth(truth_t + begin, position, turn.as_quat()),
        velocity=Velocity(wheel_t + begin, wheels, std, turned, rate_std),
    )


def late(flight, rows=(0, 2), since=40.0, lasts=5.0, by=1.5):
    """Return the Flight with delayed anchors.

    Parameters
    ----------
    rows : sequence of int
        Rows of the delayed anchors.
    since, lasts : float
        Begin after the first stamp, and duration, in s.
    by : float
        Delay, in m.
    """
    tdoas, ids = flight.tdoa, flight.anchors.ids[list(rows)]
    during = (tdoas.t - flight.truth.t[0] > since) & (tdoas.t - flight.truth.t[0] < since + lasts)
    d = tdoas.d + by * during * (np.isin(tdoas.b, ids).astype(float) - np.isin(tdoas.a, ids))
    return replace(flight, tdoa=replace(tdoas, d=d))


def misled(flight, fault, since=28.0, lasts=8.0):
    """Return the Flight with wheels that are wrong from `since` s after its begin, for `lasts` s.

    They "stick", "spin" 0.6 m/s too fast, turn "twice" as fast, or report the "opposite" direction.
    """
    wheels, t = flight.velocity, flight.velocity.t - flight.truth.t[0]
    during, v, yaw_rate = (t > since) & (t < since + lasts), wheels.v.copy(), wheels.yaw_rate.copy()
    factor = {"stick": 0.0, "spin": 1.0, "twice": 2.0, "opposite": -1.0}[fault]
    v[during] *= factor
    yaw_rate[during] *= abs(factor)
    v[during, 0] += 0.6 * (fault == "spin")
    return replace(flight, velocity=replace(wheels, v=v, yaw_rate=yaw_rate))


def yaw_of(q):
    """Return the yaws (n,), in rad, of quaternions (n, 4)."""
    x, y, z, w = q.T
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y**2 + z**2))


class Errors:
    """Errors of an Odometry against a Flight, from `since` s after its begin on.

    position : (n, 3), in m.
    yaw, tilt : (n,), in rad.
    nees_xy, nees_z, nees_yaw : normalized squares.
    steps : (n - 1,), in m, changes of the horizontal error from one pose to the next.
    """

    def __init__(self, flight, odometry, since=0.0):
        kept = (odometry.t >= flight.truth.t[0] + since) & (odometry.t <= flight.truth.t[-1])
        self.t, q, covariance = odometry.t[kept], odometry.q[kept], odometry.covariance[kept]
        true = np.stack(
            [np.interp(self.t, flight.truth.t, column) for column in flight.truth.p.T], axis=1
        )
        yaw = np.interp(self.t, flight.truth.t, np.unwrap(yaw_of(flight.truth.q)))
        self.position = odometry.p[kept] - true
        self.yaw = (yaw_of(q) - yaw + np.pi) % (2.0 * np.pi) - np.pi
        turn = Rotation.from_quat(q)
        of_world = turn.as_matrix() @ covariance[:, 6:, 6:] @ np.swapaxes(turn.as_matrix(), 1, 2)
        self.yaw_std, self.z_std = np.sqrt(of_world[:, 2, 2]), np.sqrt(covariance[:, 2, 2])
        self.tilt = np.arccos(np.clip(turn.as_matrix()[:, 2, 2], -1.0, 1.0))
        xy = self.position[:, :2]
        self.nees_xy = np.einsum(
            "ni,ni->n", xy, np.linalg.solve(covariance[:, :2, :2], xy[:, :, None])[:, :, 0]
        )
        self.nees_z, self.nees_yaw = (
            self.position[:, 2] ** 2 / self.z_std**2,
            self.yaw**2 / self.yaw_std**2,
        )
        self.steps = np.linalg.norm(np.diff(xy, axis=0), axis=1)

    @property
    def xy(self):
        """Return the horizontal error (n,), in m."""
        return np.linalg.norm(self.position[:, :2], axis=1)
