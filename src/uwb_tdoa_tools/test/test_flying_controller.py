import math

import numpy as np
import pytest

from uwb_tdoa_tools.flying.controller import Controller
from uwb_tdoa_tools.flying.simulator import IMU_RATE, interval
from uwb_tdoa_tools.flying.vehicle import ATTITUDE, GRAVITY, POSITION, VELOCITY, Vehicle

TICK = 4


def flown(wanted, yaw, seconds, turn=0.0, nominal=None):
    """States (n, 17) of a vehicle whose controller knows the truth, from (0, 0, 2) m and a yaw
    `turn`, rad, on.
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
            (controller.record, controller.vehicle.record()),
            vehicle.record(),
            (still[rows, :3], still[rows], still[rows, :3]),
            (states[rows], samples[rows], contact[rows]),
        )
    return states


def at(p):
    return np.array([p, np.zeros(3), np.zeros(3)])


@pytest.mark.parametrize("turn", [0.0, 1.0, -2.5])
def test_it_goes_where_it_is_wanted_and_turns_there(turn):
    states = flown(at([1.0, -0.5, 2.5]), 0.3, 8.0, turn)
    np.testing.assert_allclose(states[-1, POSITION], [1.0, -0.5, 2.5], atol=0.02)
    assert 2.0 * math.atan2(states[-1, 8], states[-1, 9]) % (2.0 * math.pi) == pytest.approx(
        0.3, abs=0.02
    )
    assert np.linalg.norm(states[-1, VELOCITY]) < 0.02


def test_it_learns_a_mass_that_it_was_told_wrong():
    states = flown(at([0.0, 0.0, 2.0]), 0.0, 20.0, nominal=Vehicle(mass=0.9 * Vehicle().mass))
    assert abs(states[:, 2] - 2.0).max() > 0.03 and states[-1, 2] == pytest.approx(2.0, abs=0.02)


def test_where_no_position_is_wanted_the_velocity_counts():
    wanted = np.zeros((3, 3))
    wanted[0], wanted[1] = math.nan, [0.3, 0.0, -0.2]
    states = flown(wanted, 0.0, 5.0)
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
