# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Small simulated flights with known errors, for the tests of the filter."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas, Truth
from uwb_tdoa_bias.common.geometry import tdoa
from uwb_tdoa_bias.common.sensors import Height, Pressure, Ranges, Velocity
from uwb_tdoa_bias.common.sensors.pressure import pressure_at
from uwb_tdoa_ekf.core.memory import IMU_SAMPLE, TDOA, Measurements, structured

GRAVITY = 9.81


def corners(size=(7.0, 8.0, 3.0), first_id=10):
    """Return Anchors at the corners of a box with one corner at the origin.

    Their ids differ from their rows.
    """
    box = np.stack(np.meshgrid(*([0.0, 1.0],) * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return Anchors.from_positions(box * size, ids=first_id + np.arange(8)[::-1])


class Wave:
    """A smooth path with exact derivatives: each coordinate and Euler angle is a sine of time."""

    def __init__(self, rng, middle, reach=1.5, tilt=0.15, yaw=0.5):
        self.middle = np.asarray(middle, dtype=float)
        self.size = reach * rng.uniform(0.5, 1.0, 3) * [1.0, 1.0, 0.5]
        self.pace = rng.uniform(0.4, 0.9, 3)
        self.phase = rng.uniform(0.0, 2.0 * np.pi, 3)
        self.angle_size = np.array([yaw, tilt, tilt])
        self.angle_pace = rng.uniform(0.5, 1.2, 3)
        self.angle_phase = rng.uniform(0.0, 2.0 * np.pi, 3)

    def motion(self, t):
        """Return the motion at stamps t.

        These are p and v (n, 3) in the world in m and m/s, and the Rotation from body to world.
        Then follow specific force and body rates (n, 3) in m/s^2 and rad/s.
        """
        t = np.asarray(t)[:, None]
        p = self.middle + self.size * np.sin(self.pace * t + self.phase)
        v = self.size * self.pace * np.cos(self.pace * t + self.phase)
        a = -self.size * self.pace**2 * np.sin(self.pace * t + self.phase)
        yaw, pitch, roll = (self.angle_size * np.sin(self.angle_pace * t + self.angle_phase)).T
        dyaw, dpitch, droll = (
            self.angle_size * self.angle_pace * np.cos(self.angle_pace * t + self.angle_phase)
        ).T
        attitude = Rotation.from_euler("ZYX", np.stack([yaw, pitch, roll], axis=1))
        rates = np.stack(
            [
                droll - dyaw * np.sin(pitch),
                dpitch * np.cos(roll) + dyaw * np.sin(roll) * np.cos(pitch),
                -dpitch * np.sin(roll) + dyaw * np.cos(roll) * np.cos(pitch),
            ],
            axis=1,
        )
        return p, v, attitude, attitude.inv().apply(a + [0.0, 0.0, GRAVITY]), rates


def fly(
    seed=0,
    duration=10.0,
    imu_rate=200.0,
    tdoa_rate=200.0,
    tdoa_std=0.1,
    accel_noise=0.0,
    gyro_noise=0.0,
    accel_bias=0.0,
    gyro_bias=0.0,
    accel_bias_walk=0.0,
    gyro_bias_walk=0.0,
    anchors=None,
    outliers=0.0,
    hover=False,
    begin=0.0,
):
    """Simulate a flight with TDOAs of random pairs of anchors and the exact pose every 5 ms.

    The errors follow the model of the filter.

    Parameters
    ----------
    tdoa_std : float
        White noise of TDOAs, in m.
    accel_noise, gyro_noise : float
        White noise densities, in m/s^2/sqrt(Hz) and rad/s/sqrt(Hz).
    accel_bias, gyro_bias : float
        Standard deviations of the first bias, in m/s^2 and rad/s.
    accel_bias_walk, gyro_bias_walk : float
        Random walks of the biases, per sqrt(s).
    outliers : float
        Share of TDOAs that are metres off.
    """
    rng = np.random.default_rng(seed)
    anchors = corners() if anchors is None else anchors
    middle = anchors.positions.mean(axis=0)
    wave = Wave(rng, middle, 0.0, 0.0, 0.0) if hover else Wave(rng, middle)
    imu_t = np.arange(int(duration * imu_rate)) / imu_rate
    _, _, _, accel, rates = wave.motion(imu_t)
    accel = accel + _inertial_error(
        rng, len(imu_t), imu_rate, accel_noise, accel_bias, accel_bias_walk
    )
    rates = rates + _inertial_error(
        rng, len(imu_t), imu_rate, gyro_noise, gyro_bias, gyro_bias_walk
    )
    # TDOAs are off the grid of the IMU: streams share no stamp.
    tdoa_t = (
        np.arange(int(duration * tdoa_rate)) + rng.uniform(0.1, 0.9, int(duration * tdoa_rate))
    ) / tdoa_rate
    n = len(tdoa_t)
    a = rng.integers(0, len(anchors), n)
    b = (a + rng.integers(1, len(anchors), n)) % len(anchors)
    p = wave.motion(tdoa_t)[0]
    d = tdoa(p, anchors.positions[a], anchors.positions[b]) + tdoa_std * rng.standard_normal(n)
    d += np.where(
        rng.random(n) < outliers, rng.choice([-1.0, 1.0], n) * rng.uniform(1.0, 5.0, n), 0.0
    )
    truth_t = np.arange(0.0, duration, 0.005)
    p, _, attitude, _, _ = wave.motion(truth_t)
    return Flight(
        name=f"wave-{seed}",
        anchors=anchors,
        tdoa=Tdoas(tdoa_t + begin, anchors.ids[a], anchors.ids[b], d),
        imu=Imu(imu_t + begin, rates, accel),
        truth=Truth(truth_t + begin, p, attitude.as_quat()),
        meta={"wave": wave},
    )


def with_sensors(
    flight, seed=0, rate=25.0, height_std=0.01, pressure_std=0.05, drift=0.0, velocity_std=0.05
):
    """Add height, pressure and velocity to a flight of `fly`.

    The ground of the range finder is at z = 0. The noise is white.

    Parameters
    ----------
    height_std, pressure_std, velocity_std : float
        Standard deviations, in m, m and m/s.
    drift : float
        Drift of the barometer, in m/s.
    """
    rng, begin = np.random.default_rng(seed), flight.truth.t[0]
    since = (np.arange(int((flight.truth.t[-1] - begin) * rate)) + 0.37) / rate
    t = since + begin
    p, v, attitude, _, _ = flight.meta["wave"].motion(since)
    n, up = len(t), attitude.as_matrix()[:, 2, 2]
    return replace(
        flight,
        height=Height(t, (p[:, 2] + height_std * rng.standard_normal(n)) / up),
        pressure=Pressure(
            t, pressure_at(100.0 + p[:, 2] + drift * since + pressure_std * rng.standard_normal(n))
        ),
        velocity=Velocity(
            t,
            attitude.inv().apply(v) + velocity_std * rng.standard_normal((n, 3)),
            np.full((n, 3), velocity_std),
        ),
    )


def with_ranges(flight, seed=0, rate=200.0, std=0.02):
    """Add distances to the anchors in turn to a flight of `fly`, with white noise of `std` m."""
    t = np.arange(flight.truth.t[0], flight.truth.t[-1], 1.0 / rate)
    row, p = np.arange(len(t)) % len(flight.anchors), position_at(flight, t)
    d = np.linalg.norm(p - flight.anchors.positions[row], axis=1) + std * np.random.default_rng(
        seed
    ).standard_normal(len(t))
    return replace(flight, range=Ranges(t, flight.anchors.ids[row], d, np.zeros(len(t))))


def only_ranges(std=0.1, rate=100.0):
    """Return a flight of `fly` with distances to its anchors instead of TDOAs."""
    return without_tdoas(with_ranges(fly(seed=1), 3, rate, std))


def kept(stream, rows):
    """Return some rows of an Imu, Tdoas or another stream of columns."""
    columns = {name: column[rows] for name, column in vars(stream).items() if column is not None}
    return replace(stream, **columns)


def without_tdoas(flight, low=-np.inf, high=np.inf):
    """Return the Flight without its TDOAs between two stamps, in s."""
    return replace(flight, tdoa=kept(flight.tdoa, (flight.tdoa.t < low) | (flight.tdoa.t > high)))


def errors_of(flight, odometry, after=-np.inf):
    """Return position errors (n, 3), in m, after the stamp `after`, and their NEES (n,)."""
    late = odometry.t > after
    error = odometry.p[late] - position_at(flight, odometry.t[late])
    information = np.linalg.inv(odometry.covariance[late, :3, :3])
    return error, np.einsum("ni,nij,nj->n", error, information, error)


def rms_error(flight, odometry, after=2.0):
    """Return the RMS position error, in m, from `after` s after the first odometry on."""
    error, _ = errors_of(flight, odometry, odometry.t[0] + after)
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))


def _inertial_error(rng, n, rate, noise, bias, walk):
    steps = walk / np.sqrt(rate) * rng.standard_normal((n, 3))
    white = noise * np.sqrt(rate) * rng.standard_normal((n, 3))
    return bias * rng.standard_normal(3) + np.cumsum(steps, axis=0) + white


def measurements(flight):
    """Return a Flight as Measurements for the core."""
    imu, d, rows = flight.imu, flight.tdoa, flight.anchors.index
    return Measurements(
        structured(IMU_SAMPLE, imu.t, imu.gyro, imu.accel),
        structured(TDOA, d.t, rows(d.a), rows(d.b), d.d, np.zeros(len(d))),
    )


def position_at(flight, t):
    """Return the true positions (n, 3), in m, at stamps t."""
    return np.stack([np.interp(t, flight.truth.t, flight.truth.p[:, k]) for k in range(3)], axis=1)


# Bounds of the workspace with the anchors of corners(), in m.
WORKSPACE = np.array([[-1.0, -1.0, -1.5], [8.0, 9.0, 4.5]])


def leaving(flight):
    """Replace the TDOAs of a hovering Flight: until 3 s, the tag leaves its workspace.

    It moves level, at constant velocity, along all axes.
    """
    t, anchors = flight.tdoa.t, flight.anchors
    p = np.array([6.0, 7.0, 3.0]) + np.minimum(t, 3.0)[:, None] * [1.2, 1.2, 1.0]
    a, b = (anchors.positions[anchors.index(ids)] for ids in (flight.tdoa.a, flight.tdoa.b))
    noise = 0.02 * np.random.default_rng(0).standard_normal(len(t))
    return replace(flight, tdoa=replace(flight.tdoa, d=tdoa(p, a, b) + noise))
