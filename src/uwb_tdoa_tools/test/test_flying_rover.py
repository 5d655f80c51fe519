# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A rover that drives by the estimate."""

from dataclasses import replace

from hypothesis import given, strategies as st
import numpy as np
import pytest

from uwb_tdoa_bias.common.flight import Truth
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools.commands.fly import main
from uwb_tdoa_tools.flying import rover
from uwb_tdoa_tools.flying.mission import DONE, FLYING, LOST, PLACES, REFUSED, Rules, Waypoints
from uwb_tdoa_tools.flying.trial import Task
from uwb_tdoa_tools.flying.vehicle import HALL, WORLDS
from uwb_tdoa_tools.flying.verdict import summary, text, verdict_of
from uwb_tdoa_tools.scoring.metrics import position_at
from uwb_tdoa_tools.simulation.config import NO_IMU_ERRORS

SEEDS = 3, 4
WORLD = replace(HALL, sensors=rover.SENSOR_NAMES)
TASK = Task(WORLD, config=FilterConfig(**rover.FILTER), path=Waypoints())
WALLS = 0.5 * np.array(HALL.size[:2])


@pytest.fixture(scope="module")
def drives():
    return [rover.drive(replace(TASK, seed=seed)) for seed in SEEDS]


@pytest.mark.slow
def test_it_arrives_and_the_verdict_is_that_of_its_truth(drives):
    verdicts = [verdict_of(one) for one in drives]
    for one, verdict in zip(drives, verdicts):
        assert verdict["arrived"] and verdict["why"] == "" and one.missions[0].state == DONE
        last = WALLS * PLACES[-1]
        p = one.flight.truth.p
        assert verdict["place"] == pytest.approx(np.linalg.norm(p[-1, :2] - last)) and (
            verdict["place"] < 0.3
        )
        assert verdict["tracking"] < 0.2 and verdict["farthest"] < 0.4
        for place in WALLS * PLACES:
            assert np.linalg.norm(p[:, :2] - place, axis=1).min() < 0.5
        assert verdict["phases"]["drive"]["rmse"] < 0.2 and verdict["yaw"] < 5.0
        assert [*verdict["phases"]] == ["before", "drive", "after"]
    summed = summary(verdicts)
    assert summed["arrived"] == summed["safe"] == summed["flights"] == len(SEEDS)
    assert "2 of 2 arrived" in text(summed) and "largest distance to the path" in text(summed)


@pytest.mark.slow
def test_wheels_say_more_or_less_than_is_true_and_the_imu_what_is():
    """Between slips, the wheels are wrong by their scale.

    An IMU without errors measures the motion.
    """
    still = replace(WORLD, imu=NO_IMU_ERRORS, vibration=(0.0, 0.0, 0.0))
    one = rover.drive(replace(TASK, world=still, seed=6))
    truth, wheels, imu = one.flight.truth, one.flight.velocity, one.flight.imu
    speed = np.linalg.norm(one.states[:, 3:5], axis=1)
    true = np.interp(wheels.t, truth.t, speed)
    fast = true > 0.3
    share = np.median(wheels.v[fast, 0] / true[fast])
    assert 0.95 < share < 1.05 and np.all(wheels.v[true == 0.0] == 0.0)
    assert np.mean(np.abs(wheels.v[fast, 0] / true[fast] - share) > 0.07) < 0.3  # slips
    turned = np.cumsum(imu.gyro[:, 2]) / 400.0
    yaw = np.unwrap(2.0 * np.arctan2(truth.q[:, 2], truth.q[:, 3]))
    judge_truth = np.interp(imu.t, truth.t, yaw)
    np.testing.assert_allclose(turned - turned[0], judge_truth - judge_truth[0], atol=2e-3)
    ahead = np.cumsum(imu.accel[:, 0]) / 400.0
    np.testing.assert_allclose(ahead, np.interp(imu.t, truth.t, speed), atol=2e-2)


def test_it_stands_while_it_is_lost_and_goes_on():
    path = Waypoints().starting_at(np.zeros(2), 0.4)
    drive, steering = rover.Drive(path, Rules(rest=0.0)), rover.Steering()
    pose = (0.0, np.array([0.0, 0.0, 0.4]), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]))

    def decide(t, deviation, stamp=None):
        drive.decide(t, (t if stamp is None else stamp, *pose[1:]), deviation, steering)
        return steering.speed, steering.turning

    assert decide(0.0, 0.1) != (0.0, 0.0) and drive.state == FLYING
    assert decide(1.0, 5.0) == (0.0, 0.0) and drive.state == LOST and drive.lost == 1.0
    assert decide(1.5, 0.1, stamp=0.0) == (0.0, 0.0)  # no new estimate
    assert decide(2.0, 0.1) != (0.0, 0.0) and drive.state == FLYING and drive.lost == 1.0
    decide(3.0, 5.0)
    assert decide(2.0 + rover.LOST_TIMEOUT + 0.1, 5.0) == (0.0, 0.0) and drive.state == DONE


def test_it_refuses_to_start_where_it_does_not_know_where_it_is():
    one = rover.drive(replace(TASK, seed=7, rules=Rules(rest=1.0, patience=0.5, arm=1e-6)))
    verdict = verdict_of(one)
    assert one.missions[0].state == REFUSED and verdict["why"] == "refused to start"
    assert np.ptp(one.states[:, :2], axis=0).max() == 0.0 and not verdict["arrived"]


@pytest.mark.slow
def test_a_verdict_of_a_rover_that_stops_elsewhere(drives):
    truth = drives[0].flight.truth
    moved = Truth(truth.t, truth.p + [0.5, 0.0, 0.0], truth.q)
    elsewhere = replace(drives[0], flight=drives[0].flight.replaced(truth=moved))
    verdict = verdict_of(elsewhere)
    assert verdict["why"] == "arrived elsewhere" and not verdict["arrived"]
    assert verdict["estimation"] > 0.4 and verdict["phases"]["drive"]["nees"] > 1.0
    assert verdict_of(replace(drives[0], crash="drove into a wall"))["why"] == "drove into a wall"


@given(st.floats(0.0, 12.0), st.floats(-0.3, 0.3))
def test_the_nearest_point_of_a_polyline(along, off):
    path = Waypoints().starting_at(np.array([0.2, -0.1]), 0.4)
    p = path.at(np.array([along]))[:, :2] + off
    nearest = path.at(path.nearest(p))[:, :2]
    every = path.at(np.linspace(0.0, path.length, 20001))[:, :2]
    best = np.linalg.norm(every - p, axis=1).min()
    assert np.linalg.norm(nearest - p) <= best + 1e-9


@pytest.mark.slow
def test_it_drives_where_the_radio_is_silent_for_a_while():
    silent = replace(WORLDS["silence-3s"], sensors=rover.SENSOR_NAMES)
    one = rover.drive(replace(TASK, world=silent, seed=8))
    assert np.diff(one.flight.tdoa.t).max() > 2.9 and verdict_of(one)["arrived"]
    stamps = one.odometry.t[one.odometry.t > 5.0]
    assert (
        np.linalg.norm(rover_error(one, stamps)[:, :2], axis=1).max() < 0.5
    )  # wheels and gyroscope bridge the gap


def rover_error(one, stamps):
    """Return the position error of a TrialResult, (n, 3) m."""
    rows = np.searchsorted(one.odometry.t, stamps)
    return one.odometry.p[rows] - position_at(stamps, one.flight.truth)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--hover"], "--hover: is of the quadrotor"),
        (["--sensor", "height"], "--sensor: is of the quadrotor"),
        (["--world", "table"], "does not start from a table"),
    ],
)
def test_what_a_rover_has_nothing_to_do_with_is_refused(options, said, capsys):
    assert main(["--vehicle", "rover", *options, "--flights", "1"]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_counts_draws_and_records_drives(tmp_path, capsys):
    options = ["--vehicle", "rover", "--flights", "1", "--seed", "3", "--at-least", "1"]
    assert main([*options, "--plot", str(tmp_path / "x.png"), "--record", str(tmp_path / "r")]) == 0
    assert "1 of 1 arrived; 1 without a crash" in capsys.readouterr().out
    assert (tmp_path / "x.png").exists() and (tmp_path / "r" / "flown-3").exists()
