"""Paths, and what a mission decides along them."""

import math

import numpy as np
import pytest

from uwb_tdoa_tools.flying.mission import (
    DESCENT_LEAD,
    DONE,
    FLYING,
    LOST,
    REFUSED,
    SINK,
    WAITING,
    Circles,
    Mission,
    Rules,
)

GROUND = 0.03


def followed(path, place=(0.3, -0.2)):
    """(Reference, t (n,) s, wanted (n, 3, 3)) up to where it sinks."""
    reference = path.starting_at(np.array(place), GROUND)
    t = np.arange(0.0, path.duration, 0.01)
    return reference, t, reference.at(t)


@pytest.mark.parametrize("path", [Circles(), Circles(swing=0.4), Circles(radius=0.0)])
def test_it_begins_and_ends_at_rest_in_one_place_and_then_sinks(path):
    reference, t, wanted = followed(path)
    for k, height in ((0, GROUND), (-1, GROUND + 0.4)):
        np.testing.assert_allclose(wanted[k, 0], [0.3, -0.2, height], atol=0.01)
        np.testing.assert_allclose(wanted[k, 1], 0.0, atol=0.02)
    np.testing.assert_allclose(
        np.gradient(wanted[:, 0], t, axis=0)[1:-1], wanted[1:-1, 1], atol=0.02
    )
    after = reference.at(np.array([path.duration + 1.0]))[0]
    assert np.isnan(after[0, 2]) and after[1, 2] == -SINK


LEVEL = np.array([0.0, 0.0, math.sin(0.2), math.cos(0.2)])  # yaw 0.4
STEP = 0.01


class Said:
    """An estimate that says what it is told to."""

    def __init__(self, mission):
        self.mission, self.t, self.sinks = mission, 0.0, 0.0

    def until(self, end, deviation=0.1, support=0.0, stale=False):
        """What was wanted at `end`, s. Its height falls at `sinks`, m/s."""
        wanted = None
        while self.t < end - 1e-9:
            t = round(self.t, 9)
            pose = None if stale else (t, np.array([0.0, 0.0, -self.sinks * t]), np.zeros(3), LEVEL)
            wanted = self.mission.decide(t, pose, deviation, support)
            self.t += STEP
        return wanted


@pytest.fixture
def said():
    return Said(Mission(Circles(), (1.0, 2.0), 0.03))


def test_it_rests_and_takes_off_with_the_yaw_that_it_has(said):
    assert said.until(3.99) is None and said.mission.state == WAITING
    wanted = said.until(4.02)
    assert said.mission.state == FLYING and said.mission.started == pytest.approx(4.0)
    np.testing.assert_allclose(wanted[0], [1.0, 2.0, 0.03], atol=1e-3)
    assert said.mission.yaw == pytest.approx(0.4)


def test_it_waits_for_an_estimate_that_knows_where_it_is_and_refuses_at_last(said):
    assert said.until(6.0, deviation=1.01) is None and said.mission.state == WAITING
    said.until(6.02, deviation=0.99)
    assert said.mission.state == FLYING and said.mission.started == pytest.approx(6.0)
    other = Said(Mission(Circles(), (0.0, 0.0), 0.0))
    other.until(14.02, stale=True)
    assert other.mission.state == REFUSED


def test_it_is_up_flies_its_circles_and_sinks(said):
    said.until(7.0)
    np.testing.assert_allclose(said.until(7.02)[0], [1.0, 2.0, 1.23], atol=1e-3)
    halfway = said.until(15.01)[0]
    np.testing.assert_allclose(halfway, [1.0, 2.0, 1.23], atol=0.02)  # one of two circles
    np.testing.assert_allclose(said.until(11.0 + 16.0 + 0.01)[0, 2], 0.43, atol=5e-3)
    sinking = said.until(30.0)
    assert sinking[1, 2] < 0.0 and said.mission.state == FLYING  # to wherever the ground is


def test_an_estimate_that_does_not_come_down_is_pulled_down_and_another_is_not(said):
    high = said.until(30.0)[0, 2]
    assert (
        high == pytest.approx(-DESCENT_LEAD) and said.until(31.0)[0, 2] == high
    )  # of an estimate of 0: no lower than that
    falling = Said(Mission(Circles(), (1.0, 2.0), 0.03))
    falling.sinks = 0.15
    assert falling.until(30.0)[0, 2] == pytest.approx(-0.15 * 29.99, abs=1e-6)


def test_what_it_stands_on_ends_it_near_the_end_alone(said):
    said.until(15.0, support=0.9)
    assert said.mission.state == FLYING
    said.until(26.0)
    assert said.until(26.1, support=0.31) is None
    assert said.mission.state == DONE and said.mission.ended == pytest.approx(26.0)


def test_lost_it_stops_and_sinks_and_goes_on_where_it_was(said):
    before = said.until(12.0)
    wanted = said.until(13.0, deviation=1.6)
    assert said.mission.state == LOST and said.mission.lost == pytest.approx(12.0)
    assert np.isnan(wanted[0]).all() and wanted[1, 2] == -Rules().descent_speed
    assert np.isnan(said.until(14.0, deviation=1.2)[0]).all()  # not yet good enough to go on
    after = said.until(14.01)
    assert said.mission.state == FLYING and said.mission.lost == pytest.approx(12.0)
    np.testing.assert_allclose(after[0], before[0], atol=0.02)
    np.testing.assert_allclose(said.mission.wanted(np.array([13.5]))[0, 0], before[0], atol=0.02)


def test_lost_it_lands_where_it_is(said):
    said.until(12.0)
    said.until(13.0, stale=True)
    assert said.mission.state == LOST
    assert said.until(13.1, stale=True, support=0.5) is None and said.mission.state == DONE


def test_what_never_feels_the_ground_stops_its_rotors_in_the_end(said):
    said.until(4.0 + 23.0 + Rules().longest_descent - 0.1)
    assert said.mission.state == FLYING
    said.until(4.0 + 23.0 + Rules().longest_descent + 0.1)
    assert said.mission.state == DONE
