# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from known_effects import with_yaw_rate
import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.commands.inject import main
from uwb_tdoa_tools.readers import read_flight
from uwb_tdoa_tools.simulation import NO_IMU_ERRORS, SimulationConfig, simulate
from uwb_tdoa_tools.simulation.inject import parse_effect


@pytest.fixture(scope="module")
def flight():
    flown = simulate(
        SimulationConfig(
            duration=20.0,
            yaw="along_track",
            noise_std=0.0,
            bias=False,
            multipath=False,
            outlier_probability=0.0,
            imu_errors=NO_IMU_ERRORS,
            height_noise=0.0,
            pressure_noise=0.0,
            velocity_noise=0.0,
            range_noise=0.0,
        )
    )
    return with_yaw_rate(flown, 0.0)


def test_noise_has_the_size_asked_for(flight):
    rng = np.random.default_rng(3)
    noisy = parse_effect("noise_level", ["0-1=0.2"]).inject(flight, rng).tdoa.d - flight.tdoa.d
    pair = (flight.tdoa.a == 0) & (flight.tdoa.b == 1)
    assert np.std(noisy[pair]) == pytest.approx(0.2, rel=0.1) and (noisy[~pair] == 0.0).all()
    slow = (
        parse_effect("noise_correlation", ["std=0.1", "time=0.5"]).inject(flight, rng).tdoa.d
        - flight.tdoa.d
    )
    assert np.std(slow) == pytest.approx(0.1 * np.sqrt(2.0), rel=0.3)
    wrong = parse_effect("outlier_rate", ["0.1"]).inject(flight, rng).tdoa.d != flight.tdoa.d
    assert np.mean(wrong) == pytest.approx(0.1, rel=0.2)


@pytest.mark.slow
def test_executable_writes_the_bag(flight, tmp_path, capsys):
    write_bag(flight, tmp_path / "in")
    arguments = [
        str(tmp_path / "in"),
        "--effect",
        "anchor_delay",
        "--value",
        "3=0.3",
        "--out",
        str(tmp_path / "out"),
    ]
    assert main(arguments) == 0
    added = read_flight(tmp_path / "out").tdoa.d - flight.tdoa.d
    np.testing.assert_allclose(
        added, 0.3 * (flight.tdoa.b == 3) - 0.3 * (flight.tdoa.a == 3), atol=1e-6
    )
    assert main(arguments) == 2 and "exists" in capsys.readouterr().err


@pytest.mark.parametrize(
    "effect, values, said",
    [
        ("anchor_delay", ["north=0.3"], "not an anchor id"),
        ("tag_lever_arm", ["z=much"], "expected a number"),
        ("tag_lever_arm", ["z=0.1", "z=0.2"], "twice"),
        ("nlos", ["2.colour=0.1"], "one of delay"),
    ],
)
def test_wrong_values_are_told(effect, values, said):
    with pytest.raises(InputError, match=said):
        parse_effect(effect, values)


def test_without_truth_it_says_so(flight):
    from dataclasses import replace

    with pytest.raises(InputError, match="no ground truth"):
        parse_effect("anchor_delay", ["0.1"]).inject(replace(flight, truth=None))
