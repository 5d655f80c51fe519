# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Flights by commands, in lockstep and without ROS."""

from dataclasses import replace
import math

import numpy as np
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools.flying.mission import DONE, SETTLE, SINK
from uwb_tdoa_tools.flying.pilot import MAX_SPEED, CommandedPath, Pilot
from uwb_tdoa_tools.flying.trial import OwnFilter, Task, Trial
from uwb_tdoa_tools.flying.vehicle import HALL
from uwb_tdoa_tools.flying.verdict import verdict_of
from uwb_tdoa_tools.simulation.config import NO_IMU_ERRORS

SIZE = (6.0, 6.0, 3.0)


@pytest.fixture
def up():
    """Return a path that takes off at (1, -1, 0.03) with a yaw of 3 rad, to 1.2 m within 2.5 s."""
    made = CommandedPath(np.array([1.0, -1.0, 0.03]), 3.0, SIZE)
    made.take_off(1.2, 2.5)
    return made


def test_it_goes_up_and_stays(up):
    start, halfway, there, later = up.at(np.array([0.0, 1.25, 2.5, 60.0]))
    np.testing.assert_allclose(start, [[1.0, -1.0, 0.03], [0.0] * 3, [0.0] * 3], atol=1e-12)
    assert halfway[0, 2] == pytest.approx(0.615) and halfway[1, 2] == pytest.approx(
        15 / 8 * 1.17 / 2.5
    )
    for wanted in (there, later):
        np.testing.assert_allclose(wanted, [[1.0, -1.0, 1.2], [0.0] * 3, [0.0] * 3], atol=1e-9)
    assert up.duration == math.inf and up.yaw_offset(60.0) == pytest.approx(0.0)


def test_each_command_goes_on_from_where_the_last_one_has_it(up):
    before = up.at(np.array([1.3]))
    up.go_to(1.3, False, (0.0, 0.0, 1.5), -3.0, 3.0)
    np.testing.assert_allclose(up.at(np.array([1.3])), before, atol=1e-9)
    np.testing.assert_allclose(up.at(np.array([4.3]))[0, 0], [0.0, 0.0, 1.5], atol=1e-9)
    assert up.yaw_offset(4.3) == pytest.approx(2.0 * math.pi - 6.0)  # the shorter direction
    up.go_to(5.0, True, (0.5, 0.0, 0.0), 0.1, 2.0)
    np.testing.assert_allclose(up.at(np.array([7.0]))[0, 0], [0.5, 0.0, 1.5], atol=1e-9)
    assert up.yaw_offset(7.0) == pytest.approx(2.0 * math.pi - 5.9)
    # the past does not change
    np.testing.assert_allclose(up.at(np.array([1.25]))[0, 0, 2], 0.615)


def test_it_comes_down_and_sinks_to_wherever_the_ground_is(up):
    up.land(4.0, 0.1, 2.0)
    assert up.duration == 6.0
    np.testing.assert_allclose(up.at(np.array([6.0]))[0, 0], [1.0, -1.0, 0.1 + SETTLE], atol=1e-9)
    sinking = up.at(np.array([6.5]))[0]
    assert np.isnan(sinking[0, 2]) and sinking[1, 2] == -SINK
    np.testing.assert_allclose(up.end, [1.0, -1.0])
    with pytest.raises(InputError, match="it lands already"):
        up.go_to(5.0, False, (0.0, 0.0, 1.0), 0.0, 5.0)


@pytest.mark.parametrize(
    "goal, seconds, why",
    [
        ((0.0, math.nan, 1.0), 5.0, "goal: .* not finite"),
        ((4.0, 0.0, 1.0), 5.0, r"goal: \(4.00, 0.00, 1.00\) m is outside the hall, 6 x 6 x 3 m"),
        ((0.0, 0.0, 1.0), 0.0, "duration: 0 s must be above 0"),
        ((1.0, -1.0, 2.2), 0.5, "duration: 0.5 s is too short for 1.00 m; give at least 2.2 s"),
    ],
)
def test_what_it_cannot_do_is_refused_and_changes_nothing(up, goal, seconds, why):
    with pytest.raises(InputError, match=why):
        up.go_to(3.0, False, goal, 3.0, seconds)
    np.testing.assert_allclose(up.at(np.array([9.0]))[0, 0], [1.0, -1.0, 1.2], atol=1e-9)


@pytest.mark.parametrize("height", [math.nan, -0.1, 2.0])
def test_it_lands_on_no_such_height(up, height):
    with pytest.raises(InputError, match="height: .* must be from 0 to 1 m"):
        up.land(4.0, height, 2.0)
    assert up.duration == math.inf


def test_what_is_allowed_is_never_faster_than_it_says(up):
    up.go_to(3.0, False, (-2.0, 2.0, 1.2), 3.0, 5.4)
    speed = np.linalg.norm(up.at(np.arange(3.0, 8.4, 0.01))[:, 1], axis=1)
    assert 0.9 * MAX_SPEED < speed.max() <= MAX_SPEED


PERFECT = replace(
    HALL,
    floor_effect=False,
    noise=0.01,
    outlier_share=0.0,
    delay=0.0,
    bearing_bias=0.0,
    imu=NO_IMU_ERRORS,
)


class Said(OwnFilter):
    """An estimate whose reason and deviation the test sets."""

    why, unsure = "", False

    @property
    def deviation(self):
        return 2.0 if self.unsure else super().deviation


@pytest.fixture
def flight():
    """Return (Trial, Pilot) of a vehicle at rest."""
    trial = Trial(Task(PERFECT, 3, "place"), Said(PERFECT.anchors, FilterConfig()), duration=40.0)
    return trial, Pilot(trial)


def turn(trial, seconds):
    end = trial.simulator.now + seconds
    while trial.simulator.now < end:
        trial.turn()


def test_up_to_a_place_and_down_twice(flight):
    trial, pilot = flight
    turn(trial, 1.0)
    begin = trial.source.pose[1].copy()
    pilot.take_off(0, 1.0, 2.5)
    turn(trial, 3.5)
    np.testing.assert_allclose(trial.simulator.state[:3], [*begin[:2], 1.0], atol=0.15)
    pilot.go_to(0, True, (0.5, 0.0, 0.2), 0.5, 2.0)
    turn(trial, 3.0)
    np.testing.assert_allclose(
        trial.simulator.state[:3], [begin[0] + 0.5, begin[1], 1.2], atol=0.15
    )
    pilot.land(0, 0.0, 2.0)
    while not trial.over:
        trial.turn()
    verdict = verdict_of(trial.result)
    assert verdict["landed"] and verdict["place"] < 0.15 and trial.missions[0].state == DONE
    assert verdict["started"] == pytest.approx(1.0, abs=0.02)
    pilot.take_off(0, 0.5, 2.0)
    turn(trial, 3.0)
    assert trial.simulator.state[2] == pytest.approx(0.5, abs=0.15) and len(trial.missions) == 2


def test_it_does_not_start_unless_it_knows_where_it_is(flight):
    trial, pilot = flight
    with pytest.raises(InputError, match="there is no odometry to fly by: none came lately"):
        pilot.take_off(0, 1.0, 2.0)
    turn(trial, 1.0)
    trial.source.unsure = True
    with pytest.raises(
        InputError, match="it does not know where it is: to 2.0 m, where 1 m is wanted"
    ):
        pilot.take_off(0, 1.0, 2.0)
    trial.source.why = "the start position is looked for"
    with pytest.raises(InputError, match="it does not know where it is: the start position"):
        pilot.take_off(0, 1.0, 2.0)
    assert not trial.missions and not trial.simulator.state[13:].any()


def test_lost_it_sinks_and_takes_no_commands(flight):
    trial, pilot = flight
    turn(trial, 1.0)
    for refused, why in (
        (lambda: pilot.go_to(0, False, (0.0, 0.0, 1.0), 0.0, 9.0), "it does not fly"),
        (lambda: pilot.land(0, 0.0, 2.0), "it does not fly"),
        (lambda: pilot.take_off(3, 1.0, 2.0), "group_mask: 3"),
    ):
        with pytest.raises(InputError, match=why):
            refused()
    pilot.take_off(0, 0.8, 2.0)
    turn(trial, 2.0)
    with pytest.raises(InputError, match="it flies already"):
        pilot.take_off(0, 1.0, 2.0)
    trial.source.unsure = True
    turn(trial, 0.1)
    with pytest.raises(InputError, match="its estimate is lost"):
        pilot.land(0, 0.0, 2.0)
    while not trial.over:
        trial.turn()
    verdict = verdict_of(trial.result)
    assert verdict["reported_lost"] == pytest.approx(3.0, abs=0.05) and verdict["safe"]
