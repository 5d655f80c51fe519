"""A flight by commands, in lockstep and without ROS."""

from dataclasses import replace

import numpy as np
import pytest

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_tools.flying.estimates import OwnFilter
from uwb_tdoa_tools.flying.mission import DONE
from uwb_tdoa_tools.flying.pilot import Pilot
from uwb_tdoa_tools.flying.trial import Task, Trial
from uwb_tdoa_tools.flying.verdict import verdict_of
from uwb_tdoa_tools.flying.world import HALL
from uwb_tdoa_tools.simulation.config import NO_IMU_ERRORS

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
    """Says why, and whether it is sure, as the test wants."""

    why, unsure = "", False

    @property
    def deviation(self):
        return 2.0 if self.unsure else super().deviation


@pytest.fixture
def flight():
    """(Trial, Pilot) of a vehicle that stands."""
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
