# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""IMU fault detector: gravity is 9.81 m/s^2 long and turns as the gyroscope measures.

A sensor in a wrong unit, or turned, is left out within tenths of a second. It is used again after
CLEARED seconds without evidence against it. Samples and their stamps alone decide, except where the
filter finds that TDOAs contradict the motion by the IMU (`leave_out`). The limits are
beyond all values of 22 measured flights, including a crash, and of a simulated drone that races
at 8 m/s. A multirotor that flips is taken for a
fault.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.vibration import low_pass

from .state import GRAVITY

# m/s^2, mean specific force over VIBRATION_CORNER: least upward component, largest norm. A
# multirotor descends with 3 and turns with 30.
LIGHTEST, HEAVIEST = 2.5, 50.0
TOO_LONG = 0.25  # s for which the force may be outside these limits: falling, or landing
DOWNWARDS = -2.0  # m/s^2, upward specific force that no vehicle flies with
FASTEST, TOO_FAR = 10.0, 4.0  # rad/s that a tag may turn, and rad beyond that for a moment
# s after which the accelerometer, not the gyroscope, determines the vertical: a drone that turns at
# 8 m/s leans for seconds. Then the sine of the largest error of this vertical.
MEMORY, UNSURE = (10.0, 0.3)
# cosines: of the largest tilt of a tag that stands; of the angle within which a body axis counts as
# vertical
UPRIGHT, AXIS = (math.cos(math.radians(35.0)), math.cos(math.radians(25.0)))
LYING = 3.0  # s for which a tag may lie on its side or its back
CLEARED = 1.5  # s without evidence after which the samples are used again

LEFT_OUT = 10.0  # s for which samples are not used after the filter has contradicted them

WEIGHT, TURN, RATE, TILT, MOTION = range(1, 6)  # reason of a fault


@compiled
def update(
    detector: Record, imu: Record, sample: Record, continuous: bool, imu_faulty: bool
) -> bool:
    """Update the fault detector with an IMU_SAMPLE and return whether the IMU is faulty.

    Parameters
    ----------
    detector : IMU_FAULT_DETECTOR
        State of the detector, updated in place.
    imu : IMU_STATE
        Statistics after `inertial.observe` of the sample, before `inertial.store`.
    sample : IMU_SAMPLE
        The new sample, in the body frame.
    continuous : bool
        Result of `inertial.observe`: the sample follows the last one without a gap.
    imu_faulty : bool
        The last result of this function.

    Returns
    -------
    bool
        Whether the filter must leave out inertial samples from this one on.
    """
    t, force, up = sample.t, imu.slow_accel, detector.up
    if not continuous:
        detector.supported = detector.upright = t
        up[:] = force
    dt = t - imu.t if continuous else 0.0
    _turn(up, imu.gyro, dt)
    along_up = squared_force = squared_up = squared_rate = 0.0
    longest_axis = 0  # body axis with the largest force
    for k in range(3):
        up[k] = low_pass(up[k], force[k], dt, MEMORY)
        along_up += up[k] * force[k]
        squared_force += force[k] ** 2
        squared_up += up[k] ** 2
        squared_rate += imu.gyro[k] ** 2
        if abs(force[k]) > abs(force[longest_axis]):
            longest_axis = k
    force_norm, rate = math.sqrt(squared_force), math.sqrt(squared_rate)
    upward_force = along_up / max(math.sqrt(squared_up), 1e-9)
    upward_force += UNSURE * max(0.0, force_norm - GRAVITY)
    if upward_force > LIGHTEST and force_norm < HEAVIEST:
        detector.supported = t
    detector.excess_turn = min(max(detector.excess_turn + (rate - FASTEST) * dt, 0.0), TOO_FAR)
    lies = force[2] < UPRIGHT * force_norm and abs(force[longest_axis]) > AXIS * force_norm
    if not lies:
        detector.upright = t
    unsupported = t - detector.supported > TOO_LONG
    if unsupported and not LIGHTEST < force_norm < HEAVIEST:
        _contradict(detector, force, t, WEIGHT, force_norm)
    elif unsupported or upward_force < DOWNWARDS:
        _contradict(detector, force, t, TURN, upward_force)
    elif detector.excess_turn == TOO_FAR:
        _contradict(detector, force, t, RATE, rate)
    elif lies and (imu_faulty or t - detector.upright > LYING):
        _contradict(detector, force, t, TILT, force[2])
    return t - detector.contradicted < CLEARED


@compiled
def _contradict(detector: Record, force: np.ndarray, t: float, reason: int, size: float) -> None:
    """Note an impossible sample, and reset the vertical to the measured force.

    force is the specific force (3,), m/s^2, body frame. size is the impossible value in its own
    unit.
    """
    if t >= detector.contradicted:
        detector.contradicted, detector.reason, detector.size = t, reason, size
    detector.up[:] = force


@compiled
def leave_out(detector: Record, t: float, away: float) -> None:
    """Leave the IMU out for LEFT_OUT s from stamp t (s), because TDOAs contradict its motion.

    away is the distance, m, from the filter to the place on which TDOAs agree.
    """
    detector.contradicted, detector.reason, detector.size = t + LEFT_OUT, MOTION, away


@compiled
def _turn(vector: np.ndarray, rate: np.ndarray, dt: float) -> None:
    """Update a vector in the body frame so that it stays constant in the world.

    It turns by -rate * dt (Rodrigues). vector (3,) is updated in place. rate (3,) is the angular rate of the body in rad/s, dt is in s.
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
