"""What the stream of inertial samples says of itself: how much it vibrates, whether the tag is
quiet.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.vibration import VIBRATION_AVERAGE, low_pass, track_vibration

from .state import GRAVITY

PERSISTENCE = 0.2  # s over which the error of a vibrating accelerometer stays alike
# m/s^2, rad/s, rms per axis: less is quiet; hovering has 0.1, 0.03, idling more
QUIET_ACCEL, QUIET_GYRO = (0.05, 0.02)
# rad^2/s^2 that fades before a tag counts as quiet, about half a second after the first sample
RESTLESS = 0.002
QUIET_TILT = 0.5  # m/s^2 by which the mean specific force may differ from gravity
# cosine of the angle between the specific force and the body's z axis, below which a tag does not
# hover
UPRIGHT = 0.5
CARRIED_STD = 20.0  # m/s^2, of the specific force of such a tag, about that of hovering
# s over which it is seen how far an axis rectifies: a vehicle does not accelerate one way for
# longer
RECTIFYING_MEMORY = 2.0
LEAST_RECTIFIED = 0.1  # share of the power of a vibration that counts as rectified at least
QUIET_NOISE = 0.01  # m/s^2/sqrt(Hz), of the accelerometer of a quiet tag


@compiled
def observe(imu: Record, sample: Record, timeout: float) -> bool:
    """Take an IMU_SAMPLE into the statistics of an IMU_STATE; its input becomes the mean of the
    last sample and this one. Returns whether the last one was less than `timeout` s ago.
    """
    dt = sample.t - imu.t
    if not dt < timeout:
        _restart(imu, sample)
        return False
    track_vibration(imu.slow_accel, imu.vibration, sample.accel, dt)
    for k in range(3):
        imu.mean_accel[k] = low_pass(imu.mean_accel[k], imu.slow_accel[k], dt, VIBRATION_AVERAGE)
        imu.gyro_power[k] = low_pass(imu.gyro_power[k], sample.gyro[k] ** 2, dt, VIBRATION_AVERAGE)
        power, shakes = _from_hovering(imu.mean_accel, k) ** 2, imu.vibration[k] > QUIET_ACCEL**2
        # what does not shake tells nothing
        share = power / max(power, imu.vibration[k]) if shakes else 1.0
        imu.rectified[k] = low_pass(imu.rectified[k], share, dt, RECTIFYING_MEMORY)
        imu.gyro[k], imu.accel[k] = (
            0.5 * (imu.gyro[k] + sample.gyro[k]),
            0.5 * (imu.accel[k] + sample.accel[k]),
        )
    return True


@compiled
def _restart(imu: Record, sample: Record) -> None:
    for k in range(3):
        imu.slow_accel[k] = imu.mean_accel[k] = imu.accel[k] = sample.accel[k]
        imu.gyro[k] = sample.gyro[k]
        imu.vibration[k], imu.gyro_power[k], imu.rectified[k] = 0.0, RESTLESS, 1.0


@compiled
def store(imu: Record, sample: Record) -> None:
    """Keep an IMU_SAMPLE as the input of what comes after it."""
    imu.t = sample.t
    for k in range(3):
        imu.gyro[k], imu.accel[k] = sample.gyro[k], sample.accel[k]


@compiled
def weigh(imu: Record, quiet: bool, parameters: Record) -> None:
    """Fill in accel_weight and accel_psd of an IMU_STATE: how far each axis of the accelerometer
    counts against hovering, and the noise that is left.

    A vibrating axis may rectify: its error then has vibration_gain times the variance of the
    vibration. Whether it does shows in its mean: a vehicle that hovers and moves about feels
    gravity alone in the mean. The weight is that of linear least squares of the measurement with
    this variance, and of hovering with accel_prior_std. What is carried, and lies on its side or
    upside down, does not hover; what is farther from hovering than both explain, hovers that much
    less.
    """
    slow = imu.slow_accel
    hovers = slow[2] > UPRIGHT * math.sqrt(slow[0] ** 2 + slow[1] ** 2 + slow[2] ** 2)
    usual = parameters.accel_prior_std**2 if hovers else CARRIED_STD**2
    for k in range(3):
        error = (
            parameters.vibration_gain * max(imu.rectified[k], LEAST_RECTIFIED) * imu.vibration[k]
        )
        apart = _from_hovering(slow, k)
        prior = max(usual, apart**2 - error)
        weight = prior / (prior + error)
        noise = parameters.accel_noise**2 + 2.0 * PERSISTENCE * (weight * error)
        imu.accel_weight[k], imu.accel_psd[k] = weight, QUIET_NOISE**2 if quiet else noise


@compiled
def _from_hovering(accel: np.ndarray, axis: int) -> float:
    """By how much a specific force accel (3,), m/s^2, differs along an axis from that of a body
    that hovers level.
    """
    return accel[axis] - (GRAVITY if axis == 2 else 0.0)


@compiled
def is_quiet(imu: Record) -> bool:
    """True if the last VIBRATION_AVERAGE seconds of samples show neither vibration nor rotation nor
    acceleration.
    """
    squared = 0.0
    for k in range(3):
        squared += imu.mean_accel[k] ** 2
        if imu.vibration[k] > QUIET_ACCEL**2 or imu.gyro_power[k] > QUIET_GYRO**2:
            return False
    return abs(math.sqrt(squared) - GRAVITY) < QUIET_TILT
