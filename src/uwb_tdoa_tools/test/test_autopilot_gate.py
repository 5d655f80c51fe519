# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The messages to an autopilot: frames and covariances of MAVLink, the gate, and jumps."""

from dataclasses import replace
import math

from hypothesis import given, strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.sensors.sensor import UNKNOWN_VARIANCE
from uwb_tdoa_tools.autopilot.estimate import (
    FRD,
    NED,
    NOT_HEARD,
    UPPER,
    WORLDS,
    Estimate,
    Gate,
    jumped,
)

NOW = 1_700_000_000 * 10**9  # ns
RUNNING, STARTING, LOST, FAULT = 2, 1, 3, 4
PERIOD = 5_000_000  # ns, of odometry at 200 Hz


def estimate(t=0.0, p=(0.0, 0.0, 0.0), v=(0.0, 0.0, 0.0), yaw=0.0, std=0.1):
    """Return an Estimate at t s that moves at v m/s in the world.

    std : standard deviations of position m, velocity m/s, attitude rad
    """
    turn = Rotation.from_euler("z", yaw)
    covariance = std**2 * np.eye(6)
    p, v = np.array(p, dtype=float), turn.inv().apply(v)
    w = np.zeros(3)
    return Estimate(NOW + round(1e9 * t), p, turn.as_quat(), v, w, covariance, covariance)


numbers = st.floats(-10.0, 10.0)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
turns = st.tuples(*[st.floats(-math.pi, math.pi)] * 3).map(
    lambda angles: Rotation.from_euler("ZYX", angles)
)


@st.composite
def estimates(draw):
    def covariance():
        root = np.array(draw(st.lists(st.floats(-1.0, 1.0), min_size=36, max_size=36)))
        return root.reshape(6, 6) @ root.reshape(6, 6).T + 0.01 * np.eye(6)

    p, v, w = draw(vectors), draw(vectors), draw(vectors)
    return Estimate(NOW, p, draw(turns).as_quat(), v, w, covariance(), covariance())


def test_two_publishers_hold_it_back():
    """Half of the messages would be 50 m off, and jumps would use up all numbers."""
    gate = Gate(50.0, 1.5)
    gate.set_status(RUNNING, True, "")
    assert gate.admit(estimate(0.0), NOW)
    gate.publishers = 2
    for k in range(1, 20):
        there = (50.0 * (k % 2), 0.0, 0.0)
        assert not gate.admit(estimate(0.1 * k, there), NOW + k * 10**8)
    assert "two or more nodes publish odometry" in gate.why and gate.resets == 0
    gate.publishers = 1
    assert gate.admit(estimate(2.0), NOW + 2 * 10**9) and gate.resets == 1


# --- frames ---


def to_ned(vector):
    """Convert east, north, up to north, east, down."""
    east, north, up = vector
    return np.array([north, east, -up])


def flipped(vector):
    """Convert forward, left, up to forward, right, down."""
    x, y, z = vector
    return np.array([x, -y, -z])


WORLD = {FRD: flipped, NED: to_ned}


@given(estimates(), vectors)
@pytest.mark.parametrize("world", WORLDS)
def test_each_arrow_is_the_same_arrow_in_the_frames_of_mavlink(world, ours, arrow):
    """Rotation and conversion of frames commute.

    An arrow on the vehicle is first rotated and then converted, or the other way round.
    """
    theirs, convert = ours.in_mavlink(world), WORLD[world]
    np.testing.assert_allclose(theirs.p, convert(ours.p))
    np.testing.assert_allclose(theirs.v, flipped(ours.v))
    np.testing.assert_allclose(theirs.w, flipped(ours.w))
    in_world = convert(Rotation.from_quat(ours.q).apply(arrow))
    np.testing.assert_allclose(
        Rotation.from_quat(theirs.q).apply(flipped(arrow)), in_world, atol=1e-9
    )
    assert theirs.q[3] >= 0.0 and np.linalg.norm(theirs.q) == pytest.approx(1.0)


@given(estimates(), vectors, vectors)
@pytest.mark.parametrize("world", WORLDS)
def test_an_error_is_as_unlikely_in_both_frames(world, ours, first, second):
    theirs, convert = ours.in_mavlink(world), WORLD[world]
    for name, way in (("pose_covariance", convert), ("twist_covariance", flipped)):
        here = np.concatenate([first, second])
        there = np.concatenate([way(first), way(second)])
        nees = [
            error @ np.linalg.solve(getattr(one, name), error)
            for one, error in ((ours, here), (theirs, there))
        ]
        assert nees[1] == pytest.approx(nees[0], rel=1e-6)
        upper = np.zeros((6, 6))  # as the receiver unpacks it
        upper[UPPER] = getattr(theirs, name)[UPPER]
        whole = upper + upper.T - np.diag(upper.diagonal())
        np.testing.assert_allclose(whole, getattr(theirs, name), atol=1e-12)


def test_a_vehicle_that_is_turned_to_the_left_and_climbs():
    """Yaw grows clockwise, a climb is a negative vz, and the nose is the x axis."""
    ours = estimate(p=(1.0, 2.0, 3.0), v=(0.0, 0.5, 0.3), yaw=math.radians(90.0))
    theirs = ours.in_mavlink(FRD)
    np.testing.assert_allclose(theirs.p, [1.0, -2.0, -3.0])
    np.testing.assert_allclose(theirs.v, [0.5, 0.0, -0.3], atol=1e-12)
    yaw = Rotation.from_quat(theirs.q).as_euler("ZYX", degrees=True)[0]
    assert yaw == pytest.approx(-90.0)
    theirs = ours.in_mavlink(NED)  # its nose points north: x of the anchors' frame is east
    np.testing.assert_allclose(theirs.p, [2.0, 1.0, -3.0])
    assert Rotation.from_quat(theirs.q).as_euler("ZYX")[0] == pytest.approx(0.0, abs=1e-9)


def test_numbers_of_a_message_become_an_estimate_or_none():
    pose = np.concatenate([[1, 2, 3, 0, 0, 0, 2], (0.04 * np.eye(6)).ravel()])
    twist = np.concatenate([np.arange(6.0), (0.01 * np.eye(6)).ravel()])
    good = Estimate.from_numbers(NOW, pose, twist)
    assert good.q.tolist() == [0, 0, 0, 1] and good.w.tolist() == [3, 4, 5]
    assert (good.deviation, good.quality) == (pytest.approx(0.2), 80)
    twist[6 + 7 * 5] = UNKNOWN_VARIANCE
    assert np.isnan(Estimate.from_numbers(NOW, pose, twist).w).tolist() == [False, False, True]
    for place, value in ((0, np.nan), (6, 0.0), (7, -1.0), (20, np.inf)):
        bad = pose.copy()
        bad[place] = value
        assert Estimate.from_numbers(NOW, bad, twist) is None
    assert replace(good, pose_covariance=9.0 * np.eye(6)).quality == 1


# --- the gate ---


def opened(rate=200.0, deviation=1.5, yaw=True):
    gate = Gate(rate, deviation, yaw)
    gate.set_status(RUNNING, True, "")
    return gate


def passed(gate, some):
    """Return the stamps, s, of the estimates that pass the gate. Each arrives on time."""
    return [1e-9 * (one.stamp - NOW) for one in some if gate.admit(one, one.stamp)]


def steady(count, start=0.0, **options):
    return [estimate(start + 1e-9 * PERIOD * k, **options) for k in range(count)]


@pytest.mark.parametrize("rate", [5.0, 30.0, 50.0, 100.0, 150.0, 200.0])
def test_no_more_come_than_the_rate_allows_and_none_less(rate):
    gate = opened(rate)
    stamps = passed(gate, steady(2000))
    assert len(stamps) == pytest.approx(10.0 * rate, abs=1) and gate.passed == len(stamps)
    assert min(np.diff(stamps)) >= min(1.0 / rate, 1e-9 * PERIOD) - 1e-9 * PERIOD
    assert gate.resets == 0


def test_nothing_passes_before_a_status_and_without_a_yaw():
    gate = Gate(200.0, 1.5)
    assert passed(gate, steady(3)) == [] and gate.why == NOT_HEARD
    gate.set_status(RUNNING, False, "the yaw is not known yet")
    assert passed(gate, steady(3, 0.1)) == [] and gate.why == "the yaw is not known yet"
    gate.set_status(RUNNING, True, "")
    assert len(passed(gate, steady(3, 0.2))) == 3 and gate.why == ""
    assert gate.resets == 0  # for the receiver, the first messages are no jump
    position = Gate(200.0, 1.5, needs_yaw=False)
    position.set_status(RUNNING, False, "the yaw is not known yet")
    assert len(passed(position, steady(3))) == 3


@pytest.mark.parametrize("status", [0, STARTING, LOST, FAULT])
def test_it_is_silent_while_the_filter_does_not_run_and_says_that_it_was(status):
    gate = opened()
    assert len(passed(gate, steady(10))) == 10
    gate.set_status(status, True, "the tag is lost")
    assert passed(gate, steady(10, 0.05)) == [] and gate.why == "the tag is lost"
    assert gate.resets == 0  # only jumps of sent messages count
    gate.set_status(RUNNING, True, "")
    assert len(passed(gate, steady(10, 0.1))) == 10 and gate.resets == 1


def test_what_is_late_or_vague_is_not_sent():
    gate = opened()
    for age, word in ((0.6, "0.6 s before the clock"), (-0.2, "0.2 s after the clock")):
        one = estimate(1.0)
        assert not gate.admit(one, one.stamp + round(1e9 * age)) and word in gate.why
    assert passed(gate, [estimate(1.1, std=2.0)]) == [] and "deviation of 2.0 m" in gate.why
    assert len(passed(gate, [estimate(1.2, std=1.4)])) == 1


# --- jumps ---


@pytest.mark.parametrize(
    "change",
    [dict(p=(1.0, 0.0, 0.0)), dict(v=(0.0, 0.0, 1.5)), dict(yaw=1.0), dict(t=0.6), dict(t=-0.6)],
)
def test_a_jump_counts_once(change):
    """A jump of position, velocity or yaw, a gap, and a stamp of the past count once."""
    gate, start = opened(), steady(10)
    after = [
        estimate(**{"t": 0.05, **change}),
        *(
            estimate(**{**change, "t": change.get("t", 0.05) + 1e-9 * PERIOD * k})
            for k in range(1, 4)
        ),
    ]
    if "v" in change:
        after = after[:1]
    assert len(passed(gate, [*start, *after])) == len(start) + len(after)
    assert gate.resets == 1


@given(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-15.0, 15.0), st.integers(1, 4))
def test_motion_and_measurements_are_no_jump(speed, turn, acceleration, step):
    """The motion is as fast as of a quadrotor. Updates move the estimate by decimetres at most."""
    dt, update = 1e-9 * PERIOD * step, 0.2
    before = estimate(0.0, v=(speed, 0.0, 0.0), yaw=0.3, std=0.05)
    faster = speed + acceleration * dt
    place = speed * dt + 0.5 * acceleration * dt**2 + update
    after = estimate(dt, (place, 0.0, 0.0), (faster, 0.0, 0.0), 0.3 + turn * dt, std=0.05)
    assert not jumped(before, after)
