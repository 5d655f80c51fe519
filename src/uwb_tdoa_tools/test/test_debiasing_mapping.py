"""Positions from flights and from places at rest."""

import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.debiasing.mapping import part_of, static_parts
from uwb_tdoa_tools.scoring.evaluation import evaluate
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

CONFIG = SimulationConfig(
    seed=2,
    duration=6.0,
    imu_rate=100.0,
    truth_rate=50.0,
    start_in_air=True,
    place=(0.5, 0.3),
    height=1.5,
)


def config(**fields):
    return SimulationConfig(**{**vars(CONFIG), **fields})


def test_part_of_a_flight_is_its_airborne_odometry_beside_the_truth():
    flight = simulate(config(trajectory="circle"))
    score, run = evaluate(flight)
    part = part_of(score, run.odometry)
    assert len(part) == len(score.t)
    np.testing.assert_allclose(part.measured - part.true, score.error, atol=1e-12)
    np.testing.assert_array_equal(part.covariance, score.covariance)


def test_a_recording_at_rest_is_one_place(tmp_path):
    write_bag(simulate(config(trajectory="hover")), tmp_path / "still.bag")
    (part,) = static_parts(tmp_path / "still.bag")
    assert len(part) > 500 and np.ptp(part.true, axis=0).max() < 1e-6
    assert np.linalg.norm((part.measured - part.true).mean(axis=0)) < 0.5


def test_a_recording_that_moves_holds_no_place(tmp_path):
    write_bag(simulate(config(trajectory="circle")), tmp_path / "round.bag")
    with pytest.raises(InputError, match="never stands still"):
        static_parts(tmp_path / "round.bag")


def test_rows_of_one_place_are_one_part(tmp_path):
    file = tmp_path / "points.csv"
    file.write_text(
        "true_x, true_y, true_z, x, y, z, note\n0,0,1,0.1,0,1,a\n1,0,1,1.1,0,1,b\n0,0,1,0.3,0,1,c\n"
    )
    one, two = static_parts(file)
    np.testing.assert_allclose(one.measured, [[0.1, 0.0, 1.0], [0.3, 0.0, 1.0]])
    np.testing.assert_allclose(two.true, [[1.0, 0.0, 1.0]])
    assert one.covariance is None
