"""The inertial sensor: exact specific force and body rates, and the errors that are added to them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flight import Imu

if TYPE_CHECKING:
    from collections.abc import Callable

    from .motion import Flyable


@dataclass(frozen=True)
class ImuErrors:
    """White noise, a bias that starts somewhere and walks, vibration: the error model of the
    filter, and nothing else.

    Defaults are of the size of a small quadrotor's MEMS sensor (BMI088 data sheet, rounded up).

    Attributes
    ----------
    gyro_noise : white noise density, rad/s/sqrt(Hz) (default 3e-4)
    accel_noise : white noise density, m/s^2/sqrt(Hz) (default 2e-3)
    gyro_bias_walk : random walk density of the bias, rad/s^2/sqrt(Hz) (default 1e-5)
    accel_bias_walk : random walk density of the bias, m/s^3/sqrt(Hz) (default 2e-4)
    gyro_bias : standard deviation of each axis of the initial bias, rad/s (default 5e-3)
    accel_bias : standard deviation of each axis of the initial bias, m/s^2 (default 5e-2)
    vibration : standard deviation of a further white noise on the accelerometer while the motors
        turn, m/s^2
        (default 0: off)
    """

    gyro_noise: float = 3e-4
    accel_noise: float = 2e-3
    gyro_bias_walk: float = 1e-5
    accel_bias_walk: float = 2e-4
    gyro_bias: float = 5e-3
    accel_bias: float = 5e-2
    vibration: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(
                    f"imu_errors: {name}: {value!r} is not a finite number of at least 0."
                )


NO_IMU_ERRORS = ImuErrors(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def measure(
    t: np.ndarray,
    trajectory: Flyable,
    errors: ImuErrors,
    random: Callable[[str], np.random.Generator],
) -> tuple[Imu, np.ndarray, np.ndarray]:
    """What the sensor reports at the stamps t, (n,) s, equally spaced.

    random(part) gives the numpy Generator of a part. Returns (Imu, gyro bias (n, 3) rad/s, accel
    bias (n, 3) m/s^2). The samples are values at an instant, not means over the sample time.
    """
    n, dt = len(t), t[1] - t[0]
    motion = trajectory.motion(t)

    def bias_of(part: str, initial: float, walk: float) -> np.ndarray:
        rng = random(part)
        start = initial * rng.standard_normal(3)
        steps = walk * np.sqrt(dt) * rng.standard_normal((n, 3))
        steps[0] = 0.0
        return start + np.cumsum(steps, axis=0)

    gyro_bias = bias_of("gyro bias", errors.gyro_bias, errors.gyro_bias_walk)
    accel_bias = bias_of("accel bias", errors.accel_bias, errors.accel_bias_walk)
    gyro_noise = errors.gyro_noise / np.sqrt(dt) * random("gyro noise").standard_normal((n, 3))
    accel_noise = errors.accel_noise / np.sqrt(dt) * random("accel noise").standard_normal((n, 3))
    shaking = (
        errors.vibration
        * trajectory.motors(t)[:, None]
        * random("vibration").standard_normal((n, 3))
    )
    gyro = motion.body_rates + gyro_bias + gyro_noise
    accel = motion.specific_force + accel_bias + accel_noise + shaking
    return Imu(t, gyro, accel), gyro_bias, accel_bias
