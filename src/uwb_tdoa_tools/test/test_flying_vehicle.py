# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The vehicle of `fly`, its controller and its mission."""

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
from uwb_tdoa_tools.flying.simulator import IMU_RATE, Controller, interval
from uwb_tdoa_tools.flying.vehicle import (
    ATTITUDE,
    GRAVITY,
    POSITION,
    ROTORS,
    STEP,
    VELOCITY,
    Vehicle,
    step,
)

# --- flying vehicle ---


STILL = np.zeros(3)


def flown(vehicle, state, speeds, seconds, wind=STILL):
    """Fly with constant commands.

    Returns the final state, and the largest number of feet that touched the ground.
    """
    state, scratch, record = np.array(state), np.empty((2, 17)), vehicle.record()
    feet = max(
        step(state, np.asarray(speeds, float), wind, STEP, record, scratch)
        for _ in range(round(seconds / STEP))
    )
    return state, feet


def hovering(vehicle):
    return math.sqrt(vehicle.mass * GRAVITY / (ROTORS * vehicle.thrust))


def aloft(vehicle, height=50.0, speed=None):
    state = vehicle.at_rest(0.0, 0.0, 0.0)
    state[2], state[13:] = height, hovering(vehicle) if speed is None else speed
    return state


def test_it_stands_on_a_table_and_beside_it_on_the_floor():
    vehicle = Vehicle(table=0.7, table_radius=0.5)
    assert vehicle.at_rest(0.4, 0.0, 0.0)[2] == pytest.approx(0.7 + vehicle.leg, abs=2e-3)
    assert vehicle.at_rest(0.6, 0.0, 0.0)[2] == pytest.approx(vehicle.leg, abs=2e-3)


def test_a_fall_is_a_fall():
    vehicle = Vehicle()
    state, _ = flown(vehicle, aloft(vehicle, speed=0.0), np.zeros(4), 1.0)
    assert state[2] == pytest.approx(50.0 - 0.5 * GRAVITY, abs=1e-6)
    assert state[5] == pytest.approx(-GRAVITY, abs=1e-9)


def test_at_the_right_speed_it_hovers():
    vehicle = Vehicle()
    state, feet = flown(vehicle, aloft(vehicle), np.full(4, hovering(vehicle)), 2.0)
    # the ground effect is not exactly zero
    np.testing.assert_allclose(state, aloft(vehicle), atol=1e-3)
    assert feet == 0


def test_the_ground_carries_a_part_of_it_near_the_ground():
    vehicle = Vehicle()
    near, far = (
        flown(vehicle, aloft(vehicle, height), np.full(4, hovering(vehicle)), 0.05)[0]
        for height in (0.05, 5.0)
    )
    share = 1.0 / (1.0 - (vehicle.radius / (4.0 * 0.05)) ** 2)
    assert near[5] / 0.05 == pytest.approx(GRAVITY * (share - 1.0), rel=0.1)
    assert abs(far[5]) < 1e-3


def test_a_motor_takes_its_time():
    vehicle = Vehicle()
    state, _ = flown(vehicle, aloft(vehicle, speed=0.0), np.full(4, 1000.0), 0.1)
    assert state[13] == pytest.approx(
        1000.0 * (1.0 - math.exp(-0.1 / vehicle.motor_time)), rel=1e-4
    )


@pytest.mark.parametrize(
    ("faster", "axis", "sign"), [((0, 3), 0, 1), ((2, 3), 1, 1), ((0, 2), 2, 1), ((1, 2), 0, -1)]
)
def test_faster_rotors_turn_it_where_they_are(faster, axis, sign):
    """Faster rotors on the left roll it to the right, faster rear rotors pitch it down.

    Faster rotors with the same sense of rotation yaw it.
    """
    vehicle = Vehicle()
    speeds = np.full(4, hovering(vehicle))
    speeds[list(faster)] += 50.0
    state, _ = flown(vehicle, aloft(vehicle), speeds, 0.05)
    rates = state[10:13]
    assert sign * rates[axis] > 0.01 and np.argmax(np.abs(rates)) == axis


def test_angular_momentum_stays_without_moments():
    vehicle = Vehicle(rotor_drag=0.0, inflow=0.0)
    state = aloft(vehicle, speed=0.0)
    state[10:13] = 3.0, -2.0, 5.0
    inertia = np.array([vehicle.inertia_xy, vehicle.inertia_xy, vehicle.inertia_z])
    after, _ = flown(vehicle, state, np.zeros(4), 1.0)
    assert np.linalg.norm(inertia * after[10:13]) == pytest.approx(
        np.linalg.norm(inertia * state[10:13]), rel=1e-6
    )
    assert after[12] == pytest.approx(5.0, rel=1e-6) and abs(after[10] - 3.0) > 0.1


def test_the_wind_takes_it_along():
    vehicle = Vehicle()
    state, _ = flown(
        vehicle, aloft(vehicle), np.full(4, hovering(vehicle)), 0.1, np.array([1.0, 0.0, 0.0])
    )
    drag = 4.0 * vehicle.rotor_drag * hovering(vehicle) / vehicle.mass
    assert state[3] == pytest.approx(drag * 0.1, rel=0.05)


def test_a_drop_ends_on_its_feet_and_friction_stops_it():
    vehicle = Vehicle()
    state = aloft(vehicle, 0.1, 0.0)
    state[3] = 0.3
    after, feet = flown(vehicle, state, np.zeros(4), 3.0)
    assert feet == 4 and after[2] == pytest.approx(vehicle.leg, abs=2e-3)
    assert np.linalg.norm(after[3:6]) < 1e-3 and 0.0 < after[0] < 0.3


# --- flying controller ---


TICK = 4


def flown_of_controller(wanted, yaw, seconds, turn=0.0, nominal=None):
    """Return the states (n, 17) of a vehicle whose controller knows the truth.

    It starts at (0, 0, 2) m with the yaw `turn`, rad.
    """
    vehicle, n = Vehicle(), int(seconds * IMU_RATE)
    state = vehicle.at_rest(0.0, 0.0, turn)
    state[2], state[13:] = 2.0, math.sqrt(vehicle.mass * GRAVITY / (4.0 * vehicle.thrust))
    controller, gyro = Controller(vehicle=nominal), np.zeros((2, 3))
    states, samples, contact, still = (
        np.empty((n, 17)),
        np.empty((n, 6)),
        np.zeros(n),
        np.zeros((n, 6)),
    )
    for k in range(0, n, TICK):
        rows = slice(k, k + TICK)
        controller.fly(
            state[POSITION], state[VELOCITY], state[ATTITUDE], wanted, yaw, TICK / IMU_RATE
        )
        interval(
            state,
            gyro,
            (controller.thrust, controller.rates),
            controller.vehicle.record(),
            vehicle.record(),
            (still[rows, :3], still[rows], still[rows, :3]),
            (states[rows], samples[rows], contact[rows]),
        )
    return states


def at(p):
    return np.array([p, np.zeros(3), np.zeros(3)])


@pytest.mark.slow
@pytest.mark.parametrize("turn", [0.0, 1.0, -2.5])
def test_it_goes_where_it_is_wanted_and_turns_there(turn):
    states = flown_of_controller(at([1.0, -0.5, 2.5]), 0.3, 8.0, turn)
    np.testing.assert_allclose(states[-1, POSITION], [1.0, -0.5, 2.5], atol=0.02)
    assert 2.0 * math.atan2(states[-1, 8], states[-1, 9]) % (2.0 * math.pi) == pytest.approx(
        0.3, abs=0.02
    )
    assert np.linalg.norm(states[-1, VELOCITY]) < 0.02


def test_it_learns_a_mass_that_it_was_told_wrong():
    states = flown_of_controller(
        at([0.0, 0.0, 2.0]), 0.0, 20.0, nominal=Vehicle(mass=0.9 * Vehicle().mass)
    )
    assert abs(states[:, 2] - 2.0).max() > 0.03 and states[-1, 2] == pytest.approx(2.0, abs=0.02)


def test_where_no_position_is_wanted_the_velocity_counts():
    wanted = np.zeros((3, 3))
    wanted[0], wanted[1] = math.nan, [0.3, 0.0, -0.2]
    states = flown_of_controller(wanted, 0.0, 5.0)
    np.testing.assert_allclose(states[-1, VELOCITY], [0.3, 0.0, -0.2], atol=0.02)


def test_support_is_what_the_rotors_do_not_carry():
    controller = Controller()
    for _ in range(100):
        controller.fly(
            np.zeros(3), np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), at([0.0, 0.0, 0.0]), 0.0, 0.01
        )
    assert controller.support(GRAVITY) == pytest.approx(0.0, abs=1e-3)
    assert controller.support(1.5 * GRAVITY) == pytest.approx(0.5, abs=1e-3)
    controller.stop()
    assert controller.thrust == 0.0 and controller.support(GRAVITY) == pytest.approx(1.0)


# --- flying mission ---


GROUND = 0.03


def followed(path, place=(0.3, -0.2)):
    """Return (Reference, t (n,) s, commands (n, 3, 3)) up to the descent."""
    reference = path.starting_at(np.array(place), GROUND)
    t = np.arange(0.0, path.duration, 0.01)
    return reference, t, reference.at(t)


@pytest.mark.parametrize("path", [Circles(), Circles(radius=0.0)])
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
STEP_OF_MISSION = 0.01


class Said:
    """Feeds a mission with estimates that the test sets."""

    def __init__(self, mission):
        self.mission, self.t, self.sinks = mission, 0.0, 0.0

    def until(self, end, deviation=0.1, support=0.0, stale=False):
        """Return the command at `end`, s. The estimated height falls at `sinks`, m/s."""
        wanted = None
        while self.t < end - 1e-9:
            t = round(self.t, 9)
            pose = None if stale else (t, np.array([0.0, 0.0, -self.sinks * t]), np.zeros(3), LEVEL)
            wanted = self.mission.decide(t, pose, deviation, support)
            self.t += STEP_OF_MISSION
        return wanted


@pytest.fixture
def said():
    return Said(Mission(Circles().starting_at(np.array([1.0, 2.0]), 0.03), 0.03))


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
    other = Said(Mission(Circles().starting_at(np.zeros(2), 0.0), 0.0))
    other.until(14.02, stale=True)
    assert other.mission.state == REFUSED


def test_it_is_up_flies_its_circles_and_sinks(said):
    said.until(7.0)
    np.testing.assert_allclose(said.until(7.02)[0], [1.0, 2.0, 1.23], atol=1e-3)
    halfway = said.until(15.01)[0]
    # after the first of two circles
    np.testing.assert_allclose(halfway, [1.0, 2.0, 1.23], atol=0.02)
    np.testing.assert_allclose(said.until(11.0 + 16.0 + 0.01)[0, 2], 0.43, atol=5e-3)
    sinking = said.until(30.0)
    assert sinking[1, 2] < 0.0 and said.mission.state == FLYING  # until it reaches the ground


def test_an_estimate_that_does_not_come_down_is_pulled_down_and_another_is_not(said):
    high = said.until(30.0)[0, 2]
    assert (
        high == pytest.approx(-DESCENT_LEAD) and said.until(31.0)[0, 2] == high
    )  # the estimate is 0, so the command is not lower than this
    falling = Said(Mission(Circles().starting_at(np.array([1.0, 2.0]), 0.03), 0.03))
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
    assert np.isnan(said.until(14.0, deviation=1.2)[0]).all()  # not yet good enough to continue
    after = said.until(14.01)
    assert said.mission.state == FLYING and said.mission.lost == pytest.approx(12.0)
    np.testing.assert_allclose(after[0], before[0], atol=0.02)
    np.testing.assert_allclose(said.mission.wanted(np.array([13.5]))[0, 0], before[0], atol=0.02)


def test_lost_it_lands_where_it_is(said):
    said.until(12.0)
    said.until(13.0, stale=True)
    assert said.mission.state == LOST
    # braking, the thrust does not follow the command at once, as if the ground carried a part
    said.until(13.1, stale=True, support=0.5)
    assert said.mission.state == LOST
    said.until(13.2, stale=True)
    assert said.until(13.4, stale=True, support=0.5) is None and said.mission.state == DONE


def test_what_never_feels_the_ground_stops_its_rotors_in_the_end(said):
    said.until(4.0 + 23.0 + Rules().longest_descent - 0.1)
    assert said.mission.state == FLYING
    said.until(4.0 + 23.0 + Rules().longest_descent + 0.1)
    assert said.mission.state == DONE
