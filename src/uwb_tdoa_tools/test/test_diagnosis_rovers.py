# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Findings of `diagnose` on a vehicle that stays on the floor. They equal the simulated values."""

import numpy as np
import pytest

from uwb_tdoa_bias.common.flight import Tdoas
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools.diagnosis.attribution import attribute
from uwb_tdoa_tools.diagnosis.channels.inertial import _turns
from uwb_tdoa_tools.diagnosis.references import GroundTruth
from uwb_tdoa_tools.diagnosis.refinement import effects_of, written
from uwb_tdoa_tools.diagnosis.regression.fit import refit
from uwb_tdoa_tools.diagnosis.regression.terms import columns_of
from uwb_tdoa_tools.simulation import ImuErrors, SimulationConfig, simulate

pytestmark = pytest.mark.slow

SCALE = 0.02
NO_TDOAS = Tdoas(*(np.empty(0, kind) for kind in (float, int, int, float)))
ERRORS = ImuErrors(gyro_bias=0.01)
WALK = 2e-3  # m/s^2, random walk of the accelerometer bias in 90 s


def rover(seed, **changes):
    settings = {"wheel_scale": SCALE, "imu_errors": ERRORS, "duration": 90.0, **changes}
    return simulate(SimulationConfig.of("rover", seed=seed, **settings))


def traced(flight, *streams):
    """Return the Attribution of a flight that keeps only some streams."""
    others = {"tdoa": NO_TDOAS, "imu": None, "velocity": None}
    kept = flight.replaced(
        **{name: nothing for name, nothing in others.items() if name not in streams}
    )
    reference = GroundTruth()
    return attribute([reference.settled(reference.prepare(kept), EffectSet())[0]], reference)


@pytest.fixture(scope="module")
def of_wheels():
    return traced(rover(1), "velocity")


@pytest.mark.quick
def test_a_rover_is_diagnosed_from_where_it_starts_to_where_it_stops():
    flight = rover(2)
    first, last = GroundTruth().span(flight, flight.truth)
    assert 2.0 < first < 6.0 and 80.0 < last < 88.0


def test_biases_of_a_gyroscope_that_turns_about_one_axis_have_their_signs():
    flight = rover(1)
    (found,) = [
        effect
        for effect in effects_of(traced(flight, "imu").selection)
        if effect.name == "gyro_bias"
    ]
    state = flight.extra["state_truth"]
    for axis in "xyz":
        true = np.mean(state[f"gyro_bias_{axis}"])
        assert abs(found.values[axis] - true) < 3.0 * np.hypot(found.std[axis], 2e-5), (
            axis
        )  # plus the random walk


@pytest.mark.parametrize(
    ("bias", "seed"),
    [({"z": 0.1}, 1), ({"x": -0.1, "z": -0.1}, 2), ({"x": 0.025, "y": -0.02, "z": -0.062}, 1)],
)
def test_an_accelerometer_on_a_level_floor_has_a_bias_and_what_it_could_be_is_listed(bias, seed):
    """On a level floor, z of the accelerometer is constant.

    Bias, scale and gravity are then indistinguishable.
    """
    still = rover(seed, imu_errors=ImuErrors(accel_bias=0.0))
    made = traced(EFFECTS["accel_bias"](bias).inject(still), "imu")
    findings = [one for one in made.findings() if one.channel == "accel"]
    assert {one.effect.name for one in findings} == {"accel_bias"}
    (found,) = findings
    for key, value in bias.items():
        assert abs(found.effect.values[key] - value) < 3.0 * np.hypot(found.effect.std[key], WALK)
    if bias.keys() == {"z"}:
        assert {"accel_scale", "imu_gravity"} <= {other.effect for other in found.alternatives}


@pytest.mark.quick
def test_a_rate_that_is_noise_explains_nothing():
    rng = np.random.default_rng(1)
    turning = np.column_stack([np.zeros(300), 0.3 * np.sin(np.linspace(0.0, 20.0, 300))])
    measured = turning + 0.01 + 1e-3 * rng.standard_normal(turning.shape)
    assert _turns(measured, turning).tolist() == [False, True]
    # the ground truth is noisier than the sensor
    noisy = turning + 0.02 * rng.standard_normal(turning.shape)
    assert _turns(measured, noisy).tolist() == [False, True]


def test_what_is_written_has_the_values_of_the_written_model(of_wheels):
    chosen = written(of_wheels.selection, of_wheels.candidates)
    effects = effects_of(chosen)
    assert all(effect.usable for effect in effects)
    again = refit(chosen.table, columns_of(chosen.chosen), chosen.fit)
    values = {
        (column.effect[0], column.key): value for column, value in zip(again.columns, again.beta)
    }
    for effect in effects:
        for key, value in effect.values.items():
            assert value == pytest.approx(values[effect.name, key], rel=1e-2)
    for name in ("velocity_scale", "yaw_rate_scale"):
        (scale,) = [effect for effect in effects if effect.name == name]
        assert abs(scale.values["scale"] - SCALE) < 3.0 * scale.std["scale"]


def test_the_scale_of_the_yaw_rate_of_wheels_is_found_beside_that_of_their_speed():
    made = traced(EFFECTS["yaw_rate_scale"]({"scale": 0.03}).inject(rover(2)), "velocity")
    found = {one.name: one for one in effects_of(written(made.selection, made.candidates))}
    true = {"velocity_scale": SCALE, "yaw_rate_scale": (1.0 + SCALE) * 1.03 - 1.0}
    for name, value in true.items():
        assert abs(found[name].values["scale"] - value) < 3.0 * found[name].std["scale"], name
    assert found["yaw_rate_scale"].std["scale"] < 0.005
