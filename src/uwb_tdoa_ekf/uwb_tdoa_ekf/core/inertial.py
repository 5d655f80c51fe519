# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Inertial samples: their known errors, vibration, rectification, and whether the tag is quiet.

Known errors that depend on the state are subtracted from each sample, evaluated at the state of the
best hypothesis.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.vibration import VIBRATION_AVERAGE, low_pass, track_vibration
from uwb_tdoa_bias.effects.base import TABLE_STEPS, SensorFunction
from uwb_tdoa_bias.effects.samples import OF_STATE

from .state import GRAVITY

PERSISTENCE = 0.2  # s, correlation time of the error of a vibrating accelerometer
# m/s^2 and rad/s, rms per axis, below which a tag is quiet. Hovering has 0.1 and 0.03, idling
# rotors have more.
QUIET_ACCEL, QUIET_GYRO = (0.05, 0.02)
# rad^2/s^2, initial power of the gyroscope. It must fade before a tag counts as quiet, which takes
# about half a second.
RESTLESS = 0.002
QUIET_TILT = 0.5  # m/s^2; the norm of the mean specific force may differ from gravity by this
# cosine of the tilt above which a tag does not hover, and the beam of a range finder may hit anything
UPRIGHT = 0.5
CARRIED_STD = 20.0  # m/s^2, of the specific force of a tag that does not hover, about hovering
# s over which the vibration of a vehicle, and how far an axis rectifies, are averaged: no vehicle
# accelerates one way for longer
SHAKING_MEMORY = 2.0
LEAST_RECTIFIED = 0.1  # least share of the vibration power that counts as rectified
QUIET_NOISE = 0.01  # m/s^2/sqrt(Hz), of the accelerometer of a quiet tag
PERIOD_SAMPLES = 10  # samples over which their period is averaged
# A rate above FAST that repeats the largest one so far is clipped. The true one is larger by about
# BEYOND of it, for about CLIPPED_FOR s at once.
FAST, BEYOND, CLIPPED_FOR = 2.0, 0.6, 0.1

SENSORS = ("gyro", "accel")
# covariates with a smaller index are the position
SPEED, CLIMB_RATE = (OF_STATE.index("speed"), OF_STATE.index("climb_rate"))

SENSOR_FUNCTION = np.dtype(  # A SensorFunction as a record with the same fields.
    [
        ("sensor", np.int64),
        ("axis", np.int64),
        ("covariate", np.int64),  # this and `sensor` are indices into OF_STATE and SENSORS
        ("low", float),
        ("high", float),
        ("values", float, TABLE_STEPS + 1),
        ("periodic", np.bool_),
    ],
    align=True,
)


@compiled
def observe(imu: Record, sample: Record, timeout: float) -> bool:
    """Update the statistics of an IMU_STATE with an IMU_SAMPLE.

    The input of the prediction becomes the mean of the last sample and this one.

    Parameters
    ----------
    imu : IMU_STATE
        Statistics of the inertial samples, updated in place.
    sample : IMU_SAMPLE
        Angular rate (rad/s) and specific force (m/s^2), body frame.
    timeout : float
        Longest gap, s. After a longer gap the statistics are reset.

    Returns
    -------
    bool
        Whether the last sample came less than `timeout` seconds ago.
    """
    dt = sample.t - imu.t
    if not dt < timeout:
        _restart(imu, sample)
        return False
    if dt > 0.0:
        imu.period += (dt - imu.period) / (PERIOD_SAMPLES if imu.period > 0.0 else 1)
    track_vibration(imu.slow_accel, imu.vibration, sample.accel, dt)
    for k in range(3):
        imu.mean_accel[k] = low_pass(imu.mean_accel[k], imu.slow_accel[k], dt, VIBRATION_AVERAGE)
        imu.gyro_power[k] = low_pass(imu.gyro_power[k], sample.gyro[k] ** 2, dt, VIBRATION_AVERAGE)
        power, shakes = _from_hovering(imu.mean_accel, k) ** 2, imu.vibration[k] > QUIET_ACCEL**2
        # without vibration the share is undefined: 1, the worst, until the axis has vibrated
        share = power / max(power, imu.vibration[k]) if shakes else 1.0
        imu.rectified[k] = low_pass(imu.rectified[k], share, dt, SHAKING_MEMORY)
        size, limit = abs(sample.gyro[k]), imu.gyro_limit[k]
        clipped = size > FAST and size == limit and abs(imu.gyro[k]) == limit
        imu.gyro_psd[k] = CLIPPED_FOR * (BEYOND * limit) ** 2 if clipped else 0.0
        imu.gyro_limit[k] = max(size, limit)
        imu.gyro[k], imu.accel[k] = (
            0.5 * (imu.gyro[k] + sample.gyro[k]),
            0.5 * (imu.accel[k] + sample.accel[k]),
        )
    return True


# Reset the statistics of an IMU_STATE to a single IMU_SAMPLE.
@compiled
def _restart(imu: Record, sample: Record) -> None:
    imu.period = 0.0
    for k in range(3):
        imu.slow_accel[k] = imu.mean_accel[k] = imu.accel[k] = sample.accel[k]
        imu.gyro[k] = sample.gyro[k]
        imu.vibration[k], imu.gyro_power[k], imu.rectified[k] = 0.0, RESTLESS, 1.0


@compiled
def store(imu: Record, sample: Record) -> None:
    """Store an IMU_SAMPLE as the input of the next prediction."""
    imu.t = sample.t
    for k in range(3):
        imu.gyro[k], imu.accel[k] = sample.gyro[k], sample.accel[k]


@compiled
def weigh(imu: Record, quiet: bool, parameters: Record) -> None:
    """Set the weight and the noise of each accelerometer axis: accel_weight and accel_psd.

    A vibrating axis may rectify: its mean is then off. The variance of this error is vibration_gain
    times that of the vibration, times imu.rectified, at least LEAST_RECTIFIED. imu.rectified, 0 to
    1, is the power of the mean beyond hovering over that of the vibration: over seconds, a vehicle
    that hovers and moves about measures gravity alone. The weight is the linear least squares combination of two specific
    forces. The first is the measurement with this error variance, the second is hovering with
    accel_prior_std. A carried tag that lies on its side or upside down does not hover. If a force
    is farther from hovering than both explain, the variance of hovering grows by the rest.

    Parameters
    ----------
    imu : IMU_STATE
        Statistics of the inertial samples; accel_weight and accel_psd are set.
    quiet : bool
        Whether the tag is quiet. Then the noise is QUIET_NOISE.
    parameters : PARAMETERS
        Tuning of the filter.
    """
    slow = imu.slow_accel
    hovers = slow[2] > UPRIGHT * math.sqrt(slow[0] ** 2 + slow[1] ** 2 + slow[2] ** 2)
    usual = parameters.accel_prior_std**2 if hovers else CARRIED_STD**2
    for k in range(3):
        error = (
            parameters.vibration_gain * max(imu.rectified[k], LEAST_RECTIFIED) * imu.vibration[k]
        )
        apart = _from_hovering(slow, k)
        prior = max(usual, apart**2 - error)  # then prior + error is at least apart**2
        weight = prior / (prior + error)  # of the measurement; the rest is of hovering
        # weight * error is the variance of the combination
        noise = parameters.accel_noise**2 + 2.0 * PERSISTENCE * (weight * error)
        imu.accel_weight[k], imu.accel_psd[k] = weight, QUIET_NOISE**2 if quiet else noise


@compiled
def _from_hovering(accel: np.ndarray, axis: int) -> float:
    """Return the specific force along an axis minus its value for a level hovering body, in m/s^2.

    accel is the specific force (3,) in m/s^2, body frame.
    """
    return accel[axis] - (GRAVITY if axis == 2 else 0.0)


@compiled
def is_quiet(imu: Record) -> bool:
    """Return True if the tag neither vibrates, nor rotates, nor accelerates.

    The statistics cover the last VIBRATION_AVERAGE seconds.
    """
    squared = 0.0
    for k in range(3):
        squared += imu.mean_accel[k] ** 2
        if imu.vibration[k] > QUIET_ACCEL**2 or imu.gyro_power[k] > QUIET_GYRO**2:
            return False
    return abs(math.sqrt(squared) - GRAVITY) < QUIET_TILT


def rows_of(functions: Sequence[SensorFunction]) -> np.ndarray:
    """Return SensorFunctions as (k,) SENSOR_FUNCTION."""
    out = np.zeros(len(functions), SENSOR_FUNCTION)
    for row, function in zip(out, functions):
        row["sensor"], row["covariate"] = (
            SENSORS.index(function.sensor),
            OF_STATE.index(function.covariate),
        )
        for name in ("axis", "low", "high", "values", "periodic"):
            row[name] = getattr(function, name)
    return out


@compiled
def subtract(functions: np.ndarray, x: np.ndarray, sample: Record) -> None:
    """Subtract (k,) SENSOR_FUNCTION, evaluated at a nominal state x (16,), from an IMU_SAMPLE."""
    for k in range(len(functions)):
        function = functions[k]
        if function.covariate == SPEED:
            at = math.sqrt(x[3] ** 2 + x[4] ** 2 + x[5] ** 2)
        elif function.covariate == CLIMB_RATE:
            at = x[5]
        else:
            at = x[function.covariate]
        reading = sample.gyro if function.sensor == 0 else sample.accel
        reading[function.axis] -= _value(function, at)


# Return a SENSOR_FUNCTION at a covariate, by linear interpolation, rad/s or m/s^2.
@compiled
def _value(function: Record, at: float) -> float:
    place = (at - function.low) / (function.high - function.low)
    place = place - math.floor(place) if function.periodic else min(max(place, 0.0), 1.0)
    first = min(int(place * TABLE_STEPS), TABLE_STEPS - 1)
    share = place * TABLE_STEPS - first
    return (1.0 - share) * function.values[first] + share * function.values[first + 1]
