"""Inertial samples against turns and accelerations of the ground truth."""

from dataclasses import replace

from known_effects import CLEAN, clean_flight
import numpy as np
import pytest
from scipy.signal import lfilter

from uwb_tdoa_tools.checking import motion_rules
from uwb_tdoa_tools.checking.motion_rules import TrueMotion
from uwb_tdoa_tools.simulation import SimulationConfig, simulate


@pytest.fixture(scope="module")
def flight():
    return clean_flight(100, 30.0)


def with_imu(flight, **columns):
    return replace(flight, imu=replace(flight.imu, **columns))


def said(flight):
    motion = TrueMotion(flight)
    rules = motion_rules.wrong_axes, motion_rules.low_passes, motion_rules.wrong_stamps
    return {finding.rule: finding for rule in rules for finding in rule(motion)}


def test_what_is_measured_is_what_the_truth_does(flight):
    motion = TrueMotion(flight)
    for sensor, noise in (("gyro", 0.05), ("accel", 0.3)):
        left = motion.measured[sensor] - motion.at(motion.true[sensor])
        assert np.std(left, axis=0).max() < noise
    assert said(flight) == {}


@pytest.mark.slow
@pytest.mark.parametrize(
    "order, signs", [([1, 0, 2], (1, 1, 1)), ([0, 1, 2], (-1, 1, 1)), ([2, 0, 1], (1, -1, 1))]
)
def test_axes_of_either_sensor(flight, order, signs):
    for sensor in ("gyro", "accel"):
        values = getattr(flight.imu, sensor)[:, order] * signs
        assert f"{sensor}_axes" in said(with_imu(flight, **{sensor: values}))


@pytest.mark.slow
@pytest.mark.parametrize("scale", [180.0 / np.pi, np.pi / 180.0])
def test_unit_of_the_gyroscope(flight, scale):
    assert said(with_imu(flight, gyro=flight.imu.gyro * scale))[
        "imu_rate_unit"
    ].value == pytest.approx(1.0 / scale)


def test_a_sensor_that_has_nothing_to_measure_is_in_no_other_unit():
    hover = simulate(SimulationConfig(seed=6, duration=30.0, trajectory="hover", **CLEAN))
    assert "imu_rate_unit" not in said(hover)


@pytest.mark.slow
@pytest.mark.parametrize("name", motion_rules.ATTITUDES)
def test_another_attitude_of_the_truth_is_not_another_gyroscope(flight, name):
    order, signs = motion_rules.ATTITUDES[name]
    q = np.empty_like(flight.truth.q)
    q[:, order] = flight.truth.q * np.array(signs)[order]
    found = said(replace(flight, truth=replace(flight.truth, q=q)))
    assert "truth_attitude" in found and name in found["truth_attitude"].cause


@pytest.mark.parametrize("sensor", ["gyro", "accel"])
def test_a_low_pass_in_a_sensor(flight, sensor):
    values = getattr(flight.imu, sensor)
    share = 0.001 / (0.001 + 0.4)
    filtered = lfilter([share], [1.0, share - 1.0], values - values[0], axis=0) + values[0]
    found = said(with_imu(flight, **{sensor: filtered}))
    assert (
        found["imu_filtered"].value in motion_rules.SLOWNESS
        and motion_rules.SENSORS[sensor] in found["imu_filtered"].cause
    )


def test_stamps_that_jump_or_drift(flight):
    t = flight.imu.t
    assert "imu_jump" in said(with_imu(flight, t=t + 0.4 * (t > t.mean())))
    assert "imu_drift" in said(with_imu(flight, t=t + 0.8 * (t - t[0]) / np.ptp(t)))
