"""Velocity of pixel counts."""

from dataclasses import replace

from known_effects import clean_flight
import numpy as np
import pytest

from uwb_tdoa_bias.effects import Track, aid_samples
from uwb_tdoa_bias.foundation.sensors import Height
from uwb_tdoa_tools.readers.streams import FLOW_COUNTS, FLOW_NEAREST_RANGE, flow_velocity
from uwb_tdoa_tools.scoring.metrics import judged_part


@pytest.fixture(scope="module")
def flight():
    return clean_flight(101, 40.0, aided=True)


def pixel_counts(flight):
    """Stamps and counts, x and y, of a sensor that looks down, by the geometry of a pinhole: a
    point of the ground at X in the body frame is seen at X / depth, and moves by -(v + omega x X).
    """
    t = np.arange(100, 3900) / 100.0 + flight.imu.t[0]
    track = Track(flight.truth)
    v, depth = (
        aid_samples("velocity", t - 0.005, track).reading,
        aid_samples("height", t - 0.005, track).reading[:, 0],
    )
    omega = np.stack(
        [np.interp(t - 0.005, flight.imu.t, flight.imu.gyro[:, k]) for k in range(3)], axis=1
    )
    below = np.stack([0.0 * t, 0.0 * t, -depth], axis=1)
    passing = -(v + np.cross(omega, below))[:, :2] / depth[:, None]  # rad/s, of the ground
    return t, FLOW_COUNTS * passing[:, 1], FLOW_COUNTS * passing[:, 0]


def test_pixel_counts_become_the_velocity_that_made_them(flight):
    made = flow_velocity(*pixel_counts(flight), flight.height, flight.imu)
    _, first, last = judged_part(flight.truth)
    air = (made.t > first + 0.5) & (made.t < last - 0.5)
    true = aid_samples("velocity", made.t[air], Track(flight.truth)).reading
    assert np.isinf(made.std[:, 2]).all() and np.isfinite(made.std[:, :2]).all()
    error = np.sqrt(
        np.mean((made.v[air, :2] - true[:, :2]) ** 2, axis=0)
    )  # of ranges with 1 cm of noise
    assert (np.std(true[:, :2], axis=0) > 0.2).all() and (error < 0.015).all()


def test_no_velocity_where_no_range_or_gyroscope_is_near(flight):
    t, x, y = pixel_counts(flight)
    begin = t[0] + 10.0
    blind = (flight.height.t > begin) & (flight.height.t < begin + 5.0)
    height = Height(flight.height.t, np.where(blind, np.inf, flight.height.range))
    cut = flight.imu.t < begin + 20.0
    imu = replace(
        flight.imu, t=flight.imu.t[cut], gyro=flight.imu.gyro[cut], accel=flight.imu.accel[cut]
    )
    made = flow_velocity(t, x, y, height, imu)
    missing = (made.t > begin + FLOW_NEAREST_RANGE + 0.05) & (
        made.t < begin + 5.0 - FLOW_NEAREST_RANGE - 0.05
    )
    assert not missing.any() and made.t[-1] < begin + 20.0
    assert ((made.t > begin + 5.0) & (made.t < begin + 10.0)).sum() == pytest.approx(125, abs=3)
