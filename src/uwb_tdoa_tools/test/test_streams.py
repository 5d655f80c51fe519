# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Streams of readers: the TDOA protocol, and velocities from pixel counts."""

from dataclasses import replace
import tracemalloc

from known_effects import clean_flight
import numpy as np
import pytest

from uwb_tdoa_bias.common.flight import Tdoas
from uwb_tdoa_bias.common.sensors import Height
from uwb_tdoa_bias.effects import Track, sensor_samples
from uwb_tdoa_tools.readers.streams import FLOW_COUNTS, FLOW_NEAREST_RANGE, flow_velocity, protocol
from uwb_tdoa_tools.scoring.metrics import scored_phase


def tdoas(a, b):
    return Tdoas(np.arange(len(a)) * 1e-3, np.asarray(a), np.asarray(b), np.zeros(len(a)))


@pytest.mark.parametrize("ids", [np.arange(8), np.array([2, 3, 5, 11, 13])])
def test_ring_with_missed_slots_is_tdoa2(ids):
    a = np.arange(200) % len(ids)
    step = np.where(np.arange(200) % 10 == 0, 2, 1)
    assert protocol(tdoas(ids[a], ids[(a + step) % len(ids)])) == "tdoa2"


def test_any_pair_is_tdoa3():
    rng = np.random.default_rng(1)
    a = rng.integers(0, 8, 500)
    assert protocol(tdoas(a, (a + rng.integers(1, 8, 500)) % 8)) == "tdoa3"


RING = [4, 1, 7, 0, 3, 6]  # anchors need not send in the order of their ids


def test_a_ring_in_any_order_whichever_id_a_tool_writes_first():
    rng = np.random.default_rng(0)
    a = np.arange(300) % 6
    pair = (
        np.array([RING[k] for k in a]),
        np.array([RING[k] for k in (a + 1 + (rng.random(300) < 0.1)) % 6]),
    )
    assert protocol(tdoas(*pair)) == protocol(tdoas(*np.sort(pair, axis=0))) == "tdoa2"


@pytest.mark.parametrize("n", [4, 5, 6])
def test_any_pair_of_few_anchors_is_tdoa3(n):
    rng = np.random.default_rng(n)
    a = rng.integers(0, n, 500)
    assert protocol(tdoas(a, (a + rng.integers(1, n, 500)) % n)) == "tdoa3"


def test_two_rings_are_none():
    a = np.arange(300) % 6
    assert protocol(tdoas(a, np.where(a < 3, (a + 1) % 3, 3 + (a - 2) % 3))) == "tdoa3"


def test_three_anchors_in_turn_and_at_random():
    a, rng = np.arange(60) % 3, np.random.default_rng(0)
    assert protocol(tdoas(a, (a + 1) % 3)) == "tdoa2"
    assert protocol(tdoas(a, (a + rng.integers(1, 3, 60)) % 3)) == "tdoa3"


def test_many_ids_take_little_memory():
    """Each TDOA may name two new ids. A table of all pairs of 20 000 has 400 million cells."""
    a = np.arange(20_000)
    tracemalloc.start()
    for b in (np.roll(a, -1), np.random.default_rng(0).permutation(a)):
        protocol(tdoas(a, b))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50e6


def test_one_reference_is_said():
    others = 1 + np.arange(100) % 5
    assert protocol(tdoas(np.zeros(100, int), others)) == "tdoa, one reference"


@pytest.fixture(scope="module")
def flight():
    return clean_flight(101, 40.0, aided=True)


def pixel_counts(flight):
    """Return stamps and pixel counts, x and y, of a sensor that looks down.

    Pinhole geometry: a ground point at X in the body frame appears at X / depth. It moves by -(v +
    omega x X).
    """
    t = np.arange(100, 3900) / 100.0 + flight.imu.t[0]
    track = Track(flight.truth)
    v, depth = (
        sensor_samples("velocity", t - 0.005, track).reading,
        sensor_samples("height", t - 0.005, track).reading[:, 0],
    )
    omega = np.stack(
        [np.interp(t - 0.005, flight.imu.t, flight.imu.gyro[:, k]) for k in range(3)], axis=1
    )
    below = np.stack([0.0 * t, 0.0 * t, -depth], axis=1)
    passing = -(v + np.cross(omega, below))[:, :2] / depth[:, None]  # rad/s, of the ground
    return t, FLOW_COUNTS * passing[:, 1], FLOW_COUNTS * passing[:, 0]


def test_pixel_counts_become_the_velocity_that_made_them(flight):
    made = flow_velocity(*pixel_counts(flight), flight.height, flight.imu)
    _, first, last = scored_phase(flight.truth)
    air = (made.t > first + 0.5) & (made.t < last - 0.5)
    true = sensor_samples("velocity", made.t[air], Track(flight.truth)).reading
    assert np.isinf(made.std[:, 2]).all() and np.isfinite(made.std[:, :2]).all()
    # with ranges with 1 cm of noise
    error = np.sqrt(np.mean((made.v[air, :2] - true[:, :2]) ** 2, axis=0))
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
