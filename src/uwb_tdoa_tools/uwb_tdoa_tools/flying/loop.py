"""From one estimate to the next: gyroscope, rates, rotors, body, and what the sensors of the
vehicle felt meanwhile. Compiled.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.compiled import compiled

from .controller import inner
from .vehicle import IMU_RATE, STATE, STEP, specific_force, step

if TYPE_CHECKING:
    from .vehicle import Record

STEPS = round(1.0 / (IMU_RATE * STEP))  # of the integration, per sample
TURNING = 50.0  # rad/s of a rotor, above which it shakes the vehicle


@compiled
def interval(
    state: np.ndarray,
    gyro: np.ndarray,
    wanted: tuple[float, np.ndarray],
    controller: tuple[Record, Record],
    vehicle: Record,
    disturbances: tuple[np.ndarray, np.ndarray, np.ndarray],
    felt: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Fly n samples of the inertial sensor long.

    state (17,) and gyro (2, 3) rad/s, as felt last and before that, are updated; wanted : thrust,
    N, and rates (3,) rad/s;
    controller : its gains, and the vehicle that it knows; vehicle : NUMBERS, the true ones;
    disturbances : wind (n, 3) m/s; errors (n, 6), what the sensor adds to rates, rad/s, and
        specific force, m/s^2;
    shaking (n, 3) m/s^2, what rotors add that turn.
    felt, written to : truth (n, 17), the states at the samples; samples (n, 6), rates and specific
        force: means since the sample
    before; contact (n,): the number of feet on the ground.
    """
    thrust, rates = wanted[0], wanted[1]
    gains, known = controller[0], controller[1]
    wind, errors, shaking = disturbances[0], disturbances[1], disturbances[2]
    truth, samples, contact = felt[0], felt[1], felt[2]
    dt = STEP * STEPS
    speeds, scratch, force, earlier = (
        np.empty(4),
        np.empty((2, STATE)),
        np.empty(3),
        np.empty(STATE),
    )
    for i in range(len(truth)):
        inner(thrust, rates, gyro, dt, gains, known, speeds)
        earlier[:] = state
        feet = 0
        turn = np.zeros(3)
        for _ in range(STEPS):
            feet = max(feet, step(state, speeds, wind[i], STEP, vehicle, scratch))
            for k in range(3):
                turn[k] += state[10 + k] / STEPS
        specific_force(earlier, state, dt, force)
        turning = state[13] > TURNING
        for k in range(3):
            samples[i, k] = turn[k] + errors[i, k]
            samples[i, 3 + k] = force[k] + errors[i, 3 + k] + (shaking[i, k] if turning else 0.0)
        gyro[1] = gyro[0]
        gyro[0] = samples[i, :3]
        truth[i] = state
        contact[i] = feet


@compiled
def poses_at(
    t: np.ndarray, times: np.ndarray, states: np.ndarray, p: np.ndarray, q: np.ndarray
) -> None:
    """Positions p (n, 3) and attitudes q (n, 4) at t (n,) s, between states (m, 17) at times (m,)
    s; written to.
    """
    j = 0
    for i in range(len(t)):
        while j < len(times) - 2 and times[j + 1] < t[i]:
            j += 1
        share = (t[i] - times[j]) / (times[j + 1] - times[j])
        for k in range(3):
            p[i, k] = states[j, k] + share * (states[j + 1, k] - states[j, k])
        length = 0.0
        for k in range(4):
            q[i, k] = states[j, 6 + k] + share * (states[j + 1, 6 + k] - states[j, 6 + k])
            length += q[i, k] ** 2
        for k in range(4):
            q[i, k] /= math.sqrt(length)
