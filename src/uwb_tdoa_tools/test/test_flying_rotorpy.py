# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The vehicle against rotorpy's Crazyflie 2 as a reference (pip install rotorpy)."""

import numpy as np
import pytest

from uwb_tdoa_tools.flying.vehicle import (
    ATTITUDE,
    POSITION,
    RATE,
    SPEED,
    STEP,
    VELOCITY,
    Vehicle,
    step,
)

multirotor = pytest.importorskip("rotorpy.vehicles.multirotor")
from rotorpy.vehicles.crazyflie_params import quad_params  # noqa: E402

HELD, SECONDS = 0.02, 2.0  # s, duration of a command; s, duration of a flight
PRECISE = {"method": "RK45", "rtol": 1e-9, "atol": 1e-10}


def flights(seed):
    """Return the states (n, 17) of our vehicle and of rotorpy's vehicle.

    Both start in the same state, with the same random commands and wind.
    """
    rng = np.random.default_rng(seed)
    ours = Vehicle(radius=0.0)  # rotorpy has no ground effect
    state = ours.at_rest(0.0, 0.0, 0.5)
    hover = np.sqrt(ours.mass * 9.81 / (4.0 * ours.thrust))
    state[POSITION], state[VELOCITY], state[SPEED] = (
        (0.0, 0.0, 50.0),
        rng.normal(0.0, 1.0, 3),
        hover,
    )
    wind, record, scratch = rng.normal(0.0, 1.0, 3), ours.record(), np.empty((2, 17))
    theirs = {
        "x": state[POSITION],
        "v": state[VELOCITY],
        "q": state[ATTITUDE],
        "w": state[RATE],
        "wind": wind,
        "rotor_speeds": state[SPEED],
    }
    theirs = {name: np.array(value) for name, value in theirs.items()}
    oracle = multirotor.Multirotor(
        quad_params, theirs, "cmd_motor_speeds", integrator_kwargs=PRECISE
    )
    out = []
    for _ in range(round(SECONDS / HELD)):
        speeds = hover + rng.normal(0.0, 100.0) + rng.normal(0.0, 150.0, 4)
        for _ in range(round(HELD / STEP)):
            step(state, speeds, wind, STEP, record, scratch)
        theirs = oracle.step({**theirs, "wind": wind}, {"cmd_motor_speeds": speeds}, HELD)
        out.append(
            (
                state.copy(),
                np.concatenate([theirs[name] for name in ("x", "v", "q", "w", "rotor_speeds")]),
            )
        )
    return np.array(out).transpose(1, 0, 2)


def apart(seed):
    """Return the largest differences over a flight, and the largest rate, rad/s.

    Differences of positions m, velocities m/s, attitudes rad and rates rad/s.
    """
    ours, theirs = flights(seed)
    p, v, w = (
        np.linalg.norm(ours[:, part] - theirs[:, part], axis=1).max()
        for part in (POSITION, VELOCITY, RATE)
    )
    along = np.abs(np.sum(ours[:, ATTITUDE] * theirs[:, ATTITUDE], axis=1))
    return (
        p,
        v,
        2.0 * np.arccos(np.minimum(along, 1.0)).max(),
        w,
        np.linalg.norm(theirs[:, RATE], axis=1).max(),
    )


@pytest.mark.parametrize("seed", range(3))
def test_two_seconds_of_tumbling_agree_to_a_tenth_of_a_millimetre(seed):
    p, v, angle, w, fastest = apart(seed)
    assert fastest > 5.0
    assert p < 1e-4 and v < 1e-3 and angle < 1e-3 and w < 1e-2
