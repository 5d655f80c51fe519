"""A tag that does not move, through the whole filter."""

from dataclasses import replace

from flights import corners, fly
import numpy as np
import pytest

from uwb_tdoa_bias.foundation.flight import Imu, Tdoas
from uwb_tdoa_bias.foundation.geometry import tdoa
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.offline import run_offline

PLACE = np.array([2.5, 5.0, 0.03])


def on_floor(seed, duration, late=3.3, shaking=0.0, lift=np.inf):
    """A flight that stands at PLACE and, from `lift` s on, rises by 0.5 m/s^2 for 2 s and stays up; the anchors at 0.15 m are `late` m
    later while it is below 0.12 m. shaking : m/s^2, white, of the accelerometer."""
    low = replace(corners(), positions=np.array(corners().positions) + [0.0, 0.0, 0.15])
    flight, rng = fly(seed, duration, hover=True, anchors=low, imu_rate=400.0, tdoa_rate=360.0), np.random.default_rng(seed)

    def height(t):
        since = np.clip(t - lift, 0.0, 2.0)
        return np.where(since < 1.0, 0.25 * since**2, 0.25 + 0.5 * (since - 1.0) - 0.25 * (since - 1.0) ** 2)

    def at(t):
        return PLACE + np.stack([0.0 * t, 0.0 * t, height(t)], axis=1)

    t, positions = flight.tdoa.t, low.positions
    a, b = low.index(flight.tdoa.a), low.index(flight.tdoa.b)
    p = at(t)
    of_anchor = np.where(positions[:, 2] < 1.0, late + 0.2 * rng.standard_normal(len(positions)), 0.0)
    near = p[:, 2] < 0.12
    d = tdoa(p, positions[a], positions[b]) + 0.08 * rng.standard_normal(len(t)) + near * (of_anchor[b] - of_anchor[a])
    since = flight.imu.t - lift
    up = np.where((since >= 0.0) & (since < 1.0), 0.5, np.where((since >= 1.0) & (since < 2.0), -0.5, 0.0))
    accel = flight.imu.accel + np.stack([0.0 * up, 0.0 * up, up], axis=1) + shaking * rng.standard_normal((len(up), 3))
    truth = replace(flight.truth, p=at(flight.truth.t))
    return replace(flight, tdoa=replace(flight.tdoa, d=d), imu=Imu(flight.imu.t, flight.imu.gyro, accel), truth=truth)


def run(flight, **config):
    """(t, error (n, 3) m, NEES (n,)) of the odometry."""
    odometry = run_offline(flight, FilterConfig(**config)).odometry
    error = odometry.p - np.stack([np.interp(odometry.t, flight.truth.t, flight.truth.p[:, k]) for k in range(3)], axis=1)
    nees = np.einsum("ni,nij,nj->n", error, np.linalg.inv(odometry.covariance[:, :3, :3]), error)
    return odometry.t, error, nees


@pytest.mark.parametrize("shaking", [0.0, 0.6])
def test_on_a_floor_where_low_anchors_are_late_it_is_right_and_honest(shaking):
    for seed in range(4):
        t, error, nees = run(on_floor(seed, 6.0, shaking=shaking))
        assert t[0] < 0.7 and np.linalg.norm(error, axis=1).max() < 0.5
        assert nees.mean() < 9.0


@pytest.mark.parametrize("shaking", [0.0, 0.6])
def test_it_leaves_the_floor_with_the_tag(shaking):
    for seed in range(4):
        t, error, nees = run(on_floor(seed, 8.0, shaking=shaking, lift=3.0))
        step = np.linalg.norm(np.diff(error, axis=0), axis=1).max()
        assert np.linalg.norm(error, axis=1).max() < 0.5 and step < 0.3
        assert np.linalg.norm(error[t > 6.0], axis=1).max() < 0.25
        assert nees.mean() < 9.0


def test_a_tag_that_lies_still_stays_where_it_is_without_tdoas():
    """One second of TDOAs, then nothing for ten: the firmware's own test asks for 5 m."""
    for seed in range(4):
        flight = on_floor(seed, 11.0, late=0.0)
        heard = flight.tdoa.t < 1.0
        flight = replace(flight, tdoa=Tdoas(*(column[heard] for column in vars(flight.tdoa).values())))
        t, error, nees = run(flight)
        assert t[-1] > 10.9 and np.linalg.norm(error, axis=1).max() < 0.5 and nees.max() < 20.0


def test_without_an_imu_it_stands_too():
    for seed in range(4):
        flight = replace(on_floor(seed, 5.0), imu=None)
        _, error, nees = run(flight, use_imu=False)
        assert np.linalg.norm(error, axis=1).max() < 0.6 and nees.mean() < 9.0
