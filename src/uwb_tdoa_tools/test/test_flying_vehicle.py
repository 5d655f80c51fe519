import math

import numpy as np
import pytest

from uwb_tdoa_tools.flying.vehicle import GRAVITY, ROTORS, STEP, Vehicle, step

STILL = np.zeros(3)


def flown(vehicle, state, speeds, seconds, wind=STILL):
    """The state after so many seconds with constant commands, and the largest number of feet that
    touched the ground.
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


def test_a_vehicle_that_stands_stays():
    vehicle = Vehicle()
    state, feet = flown(vehicle, vehicle.at_rest(1.0, -2.0, 0.7), np.zeros(4), 5.0)
    np.testing.assert_allclose(state, vehicle.at_rest(1.0, -2.0, 0.7), atol=1e-6)
    assert feet == 4


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
    # the ground effect is not quite nothing
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
    """Those on the left roll it to the right, those behind pitch it down, those of one sense of
    turning yaw it.
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
