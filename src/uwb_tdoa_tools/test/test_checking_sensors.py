# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Sensors that contradict everything else are named, by `check` and by `localize`."""

from dataclasses import replace

import numpy as np
import pytest

from uwb_tdoa_bias.common.flight import Tdoas
from uwb_tdoa_tools.checking.check import check
from uwb_tdoa_tools.checking.recording import of_flight
from uwb_tdoa_tools.checking.watch import OF_SENSORS, judge_sensors
from uwb_tdoa_tools.estimate import FlightEstimator
from uwb_tdoa_tools.localizing.localize import DOUBTFUL, GOOD, assess
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

ESTIMATOR = FlightEstimator()


@pytest.fixture(scope="module")
def healthy():
    """Return a simulated Flight with all sensors."""
    config = SimulationConfig(
        seed=5, duration=18.0, imu_rate=200.0, height_noise=0.01, velocity_noise=0.05
    )
    return simulate(config)


def judged(flight):
    return judge_sensors(flight, ESTIMATOR(flight), ESTIMATOR)


def scaled(flight, name, factor):
    stream = getattr(flight, name)
    return flight.replaced(**{name: stream.with_values(stream.values * factor)})


def covered(flight, distance):
    height = flight.height
    return flight.replaced(height=replace(height, range=np.full(len(height), distance)))


def test_sound_sensors_are_not_named(healthy):
    assert judged(healthy) == []


@pytest.mark.parametrize(
    ("break_it", "name"),
    [
        (lambda flight: covered(flight, 0.12), "heights"),
        (lambda flight: covered(flight, 4.0), "heights"),
        (lambda flight: scaled(flight, "height", 1000.0), "heights"),
        (lambda flight: scaled(flight, "velocity", 1000.0), "velocities"),
        (lambda flight: scaled(flight, "velocity", 0.0), "velocities"),
    ],
    ids=["covered", "saturated", "height in mm", "velocity in mm/s", "no twist"],
)
def test_a_sensor_that_contradicts_everything_is_the_only_one_named(healthy, break_it, name):
    (found,) = judged(break_it(healthy))
    assert found.rule in OF_SENSORS and f"the {name}" in found.cause


def test_a_gap_of_a_range_finder_is_no_contradiction(healthy):
    assert judged(covered(healthy, np.inf)) == []


def test_check_and_localize_say_the_same(healthy):
    broken = scaled(healthy, "height", 1000.0)
    found = [one for one in check(of_flight(broken)).findings if one.rule in OF_SENSORS]
    assessment = assess(broken, ESTIMATOR(broken))
    assert assessment.level == DOUBTFUL
    assert [found[0].cause in reason for reason in assessment.reasons] == [True]
    assert assess(healthy, ESTIMATOR(healthy)).level == GOOD


def test_an_anchor_with_rubbish_ranges_is_named():
    flight = simulate(SimulationConfig(seed=2, duration=18.0, imu_rate=200.0, range_noise=0.1))
    none = np.empty(0)
    flight = replace(flight, tdoa=Tdoas(none, none.astype(int), none.astype(int), none))
    assert judged(flight) == []
    ranges, rng = flight.range, np.random.default_rng(1)
    wrong = np.where(ranges.anchor == 2, rng.choice([45.12, 206.4, 254.88], len(ranges)), ranges.d)
    broken = flight.replaced(range=replace(ranges, d=wrong))
    found = [one for one in check(of_flight(broken)).findings if one.rule in OF_SENSORS]
    assert len(found) == 1 and "anchor 2 " in found[0].cause
