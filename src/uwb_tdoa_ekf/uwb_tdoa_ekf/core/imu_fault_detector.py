"""Can it be what an inertial sensor says? Gravity is 9.81 m/s^2 long and turns as the gyroscope
says it does.

A sensor in another unit, or turned, is left out within tenths of a second, and used again after
some time without evidence against it. Samples and their stamps alone decide. The limits are beyond
what 22 measured flights show, a crash among them; a multirotor that flips is taken for a fault.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.vibration import low_pass

# m/s^2, mean specific force over VIBRATION_CORNER: upwards, and in all; a multirotor comes down
# with 3, turns with 30
LIGHTEST, HEAVIEST = 2.5, 50.0
TOO_LONG = 0.25  # s for which it may be beyond: falling, or landing
DOWNWARDS = -2.0  # m/s^2, upwards, that nothing flies with
FASTEST, TOO_FAR = 10.0, 4.0  # rad/s that a tag may turn, and rad beyond that for a moment
# s after which upwards is what the accelerometer says, not what the gyroscope has made of it
MEMORY = 2.0
# tilt, and of an axis that points up instead
UPRIGHT, AXIS = (math.cos(math.radians(35.0)), math.cos(math.radians(25.0)))
LYING = 3.0  # s for which a tag may lie on its side or its back
CLEARED = 1.5  # s without evidence after which the samples are used again

WEIGHT, TURN, RATE, TILT = range(1, 5)  # what is impossible


@compiled
def update(check: Record, imu: Record, sample: Record, continuous: bool, imu_faulty: bool) -> bool:
    """Whether to go without inertial samples from this IMU_SAMPLE on. check : PLAUSIBILITY, which
    is updated; imu : IMU_STATE after `observe` of the sample and before `store`; continuous : what
    that returned; distrusted : what this returned before.
    """
    t, force, up = sample.t, imu.slow_accel, check.up
    if not continuous:
        check.weighed = check.upright = t
        up[:] = force
    dt = t - imu.t if continuous else 0.0
    _turn(up, imu.gyro, dt)
    upwards = weight = length = rate = 0.0
    tallest = 0
    for k in range(3):
        up[k] = low_pass(up[k], force[k], dt, MEMORY)
        upwards += up[k] * force[k]
        weight += force[k] ** 2
        length += up[k] ** 2
        rate += imu.gyro[k] ** 2
        if abs(force[k]) > abs(force[tallest]):
            tallest = k
    weight, upwards, rate = (
        math.sqrt(weight),
        upwards / max(math.sqrt(length), 1e-9),
        math.sqrt(rate),
    )
    if upwards > LIGHTEST and weight < HEAVIEST:
        check.weighed = t
    check.spun = min(max(check.spun + (rate - FASTEST) * dt, 0.0), TOO_FAR)
    lies = force[2] < UPRIGHT * weight and abs(force[tallest]) > AXIS * weight
    if not lies:
        check.upright = t
    if t - check.weighed > TOO_LONG and not LIGHTEST < weight < HEAVIEST:
        _contradict(check, force, t, WEIGHT, weight)
    elif t - check.weighed > TOO_LONG or upwards < DOWNWARDS:
        _contradict(check, force, t, TURN, upwards)
    elif check.spun == TOO_FAR:
        _contradict(check, force, t, RATE, rate)
    elif lies and (imu_faulty or t - check.upright > LYING):
        _contradict(check, force, t, TILT, force[2])
    return t - check.contradicted < CLEARED


@compiled
def _contradict(check: Record, force: np.ndarray, t: float, reason: int, size: float) -> None:
    """Something is impossible; where upwards is, the accelerometer may say anew."""
    check.contradicted, check.reason, check.size = t, reason, size
    check.up[:] = force


@compiled
def _turn(vector: np.ndarray, rate: np.ndarray, dt: float) -> None:
    """Turn a constant vector of the world, given in the body frame, (3,), by -rate (3,) rad/s for
    dt s (Rodrigues).
    """
    angle = dt * math.sqrt(rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2)
    if angle < 1e-12:
        return
    axis = rate * (-dt / angle)
    s, c = math.sin(angle), math.cos(angle)
    along = (1.0 - c) * (axis[0] * vector[0] + axis[1] * vector[1] + axis[2] * vector[2])
    x, y, z = vector[0], vector[1], vector[2]
    vector[0] = c * x + s * (axis[1] * z - axis[2] * y) + along * axis[0]
    vector[1] = c * y + s * (axis[2] * x - axis[0] * z) + along * axis[1]
    vector[2] = c * z + s * (axis[0] * y - axis[1] * x) + along * axis[2]
