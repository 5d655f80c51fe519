from dataclasses import replace
import subprocess
import sys

import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.simulation import NO_IMU_ERRORS, ImuErrors, SimulationConfig, simulate

CONFIG = SimulationConfig(trajectory="hover", duration=30.0)


def errors_of(imu_errors, **change):
    """The errors of both sensors, (gyro (n, 3), accel (n, 3)), and the flight."""
    config = replace(CONFIG, imu_errors=imu_errors, **change)
    flight, exact = simulate(config), simulate(replace(config, imu_errors=NO_IMU_ERRORS))
    return flight.imu.gyro - exact.imu.gyro, flight.imu.accel - exact.imu.accel, flight


@pytest.mark.parametrize("rate", [1000.0, 250.0])
def test_white_noise_has_the_density_whatever_the_rate(rate):
    gyro, accel, _ = errors_of(
        replace(NO_IMU_ERRORS, gyro_noise=3e-4, accel_noise=2e-3), imu_rate=rate
    )
    assert gyro.std() == pytest.approx(3e-4 * np.sqrt(rate), rel=0.02)
    assert accel.std() == pytest.approx(2e-3 * np.sqrt(rate), rel=0.02)
    flat = (gyro / gyro.std()).ravel()
    assert abs(np.mean(flat[1:] * flat[:-1])) < 0.02


def test_bias_walks_as_configured():
    gyro, accel, flight = errors_of(
        replace(NO_IMU_ERRORS, gyro_bias_walk=1e-3, accel_bias_walk=1e-2)
    )
    assert np.diff(gyro, axis=0).std() == pytest.approx(1e-3 * np.sqrt(1e-3), rel=0.02)
    assert np.diff(accel, axis=0).std() == pytest.approx(1e-2 * np.sqrt(1e-3), rel=0.02)
    state = flight.extra["state_truth"]
    at = np.searchsorted(flight.imu.t, state["t"] + 1e-9) - 1
    np.testing.assert_allclose(state["gyro_bias_y"], gyro[at, 1], atol=1e-12)
    np.testing.assert_allclose(state["accel_bias_z"], accel[at, 2], atol=1e-12)


def test_initial_bias_has_the_configured_spread():
    only_bias = replace(NO_IMU_ERRORS, gyro_bias=0.01, accel_bias=0.1)
    start = [errors_of(only_bias, seed=k, duration=1.0, start_in_air=True)[:2] for k in range(20)]
    for values, spread in zip(zip(*start), (0.01, 0.1)):
        # constant over each flight
        np.testing.assert_allclose(np.ptp(values, axis=1), 0.0, atol=1e-12)
        assert np.std([v[0] for v in values]) == pytest.approx(spread, rel=0.3)


def test_vibration_only_while_the_motors_turn():
    gyro, accel, flight = errors_of(replace(NO_IMU_ERRORS, vibration=2.0))
    # half a second before take-off and after landing
    flying = (flight.imu.t >= 2.5) & (flight.imu.t <= 27.5)
    assert accel[flying].std() == pytest.approx(2.0, rel=0.02)
    np.testing.assert_array_equal(accel[~flying], 0.0)
    np.testing.assert_array_equal(gyro, 0.0)


def test_no_two_errors_draw_the_same_numbers():
    gyro, accel, flight = errors_of(replace(NO_IMU_ERRORS, gyro_noise=1.0, accel_noise=1.0))
    tdoa = flight.extra["tdoa_truth"]["noise"]
    n = len(tdoa)
    draws = [gyro.ravel()[:n], accel.ravel()[:n], tdoa]
    assert np.abs(np.corrcoef(draws) - np.eye(3)).max() < 0.05


def test_bad_values_are_refused():
    with pytest.raises(InputError, match="gyro_noise"):
        ImuErrors(gyro_noise=-1.0)
    with pytest.raises(InputError, match="vibration"):
        ImuErrors(vibration=np.nan)


REGISTERED = """
from dataclasses import fields, replace
from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_bias.common.sensors.sensor import parameter
use = {"use_sonar": parameter(True, "use it", fixed=True)}
SENSORS["sonar"] = replace(SENSORS["pressure"], name="sonar", parameters=use)
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools.bags.topics import topics_of
from uwb_tdoa_tools.simulation import SimulationConfig
names = [{each.name for each in fields(kind)} for kind in (Flight, FilterConfig, SimulationConfig)]
assert "sonar" in names[0] and "use_sonar" in names[1]
assert "sonar_noise" in names[2]
assert topics_of("sonar") == (("sonar", "sensor_msgs/msg/FluidPressure"),)
"""


def test_the_registry_alone_adds_a_sensor_to_recordings_parameters_simulation_and_bags():
    """In another process: whoever imports the registry makes its fields by it."""
    run = subprocess.run([sys.executable, "-c", REGISTERED], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
