"""What the stream of inertial samples says of itself: how much it vibrates, whether the tag is quiet."""

import math

from uwb_tdoa_bias.foundation.compiled import inlined

from .memory import FORCE, FORCE_POWER, GYRO, GYRO_POWER, LAST_IMU, MEAN_FORCE, SLOW_FORCE, SLOW_GYRO
from .state import GRAVITY

CORNER, AVERAGE = 0.05, 0.3  # s: what is faster than the first is vibration; its power is averaged over the second
PERSISTENCE = 0.2  # s over which that error stays alike
QUIET_FORCE, QUIET_GYRO = 0.05, 0.02  # m/s^2 and rad/s, rms per axis: less is quiet; hovering has 0.1 and 0.03, idling motors more
RESTLESS = 0.01  # rad^2/s^2 that fades before a tag counts as quiet, about a second after the first sample
QUIET_TILT = 0.5  # m/s^2 by which the mean specific force may differ from gravity


@inlined
def observe(m, t, gyro, force, timeout):
    """Take one sample into the statistics; GYRO and FORCE become the mean of the last sample and this one."""
    imu = m.imu
    dt = t - m.clock[LAST_IMU]
    fresh = dt < timeout
    fast, slow = min(1.0, dt / CORNER), min(1.0, dt / AVERAGE)
    for k in range(3):
        if fresh:
            imu[SLOW_FORCE, k] += fast * (force[k] - imu[SLOW_FORCE, k])
            imu[SLOW_GYRO, k] += fast * (gyro[k] - imu[SLOW_GYRO, k])
            imu[MEAN_FORCE, k] += slow * (imu[SLOW_FORCE, k] - imu[MEAN_FORCE, k])
            imu[FORCE_POWER, k] += slow * ((force[k] - imu[SLOW_FORCE, k]) ** 2 - imu[FORCE_POWER, k])
            imu[GYRO_POWER, k] += slow * (gyro[k] ** 2 - imu[GYRO_POWER, k])
            imu[GYRO, k], imu[FORCE, k] = 0.5 * (imu[GYRO, k] + gyro[k]), 0.5 * (imu[FORCE, k] + force[k])
        else:
            imu[SLOW_FORCE, k] = imu[MEAN_FORCE, k] = imu[FORCE, k] = force[k]
            imu[SLOW_GYRO, k] = imu[GYRO, k] = gyro[k]
            imu[FORCE_POWER, k], imu[GYRO_POWER, k] = 0.0, RESTLESS
    return fresh


@inlined
def trust(m, k, plausible, gain):
    """Share of the measured specific force to believe along body axis k, 0 to 1, and the variance of its error, m^2/s^4.

    plausible : m/s^2, standard deviation of what else the axis could measure; gain : variance of the error of a vibrating
    axis, which rectifies, over that of its vibration. Linear least squares of the two.
    """
    doubt = gain * m.imu[FORCE_POWER, k]
    share = plausible * plausible / (plausible * plausible + doubt)
    return share, share * doubt


@inlined
def quiet(m):
    """True if the last AVERAGE seconds of samples show neither vibration nor rotation nor acceleration."""
    norm = 0.0
    for k in range(3):
        norm += m.imu[MEAN_FORCE, k] ** 2
        if m.imu[FORCE_POWER, k] > QUIET_FORCE**2 or m.imu[GYRO_POWER, k] > QUIET_GYRO**2:
            return False
    return abs(math.sqrt(norm) - GRAVITY) < QUIET_TILT
