# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulated sensors besides TDOAs: the inertial sensor, and each of SENSORS."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.flight import Imu
from uwb_tdoa_bias.common.sensors import SENSORS, Stream, Velocity

from .config import WHEELS_RATE, ImuErrors, SimulationConfig
from .rooms import Room
from .vehicles import Flyable

YAW_RATE_STD = 0.02  # rad/s
SLIP_EVERY, SLIP_TIME = 10.0, 0.5  # s


def measure_imu(
    t: np.ndarray,
    trajectory: Flyable,
    errors: ImuErrors,
    random: Callable[[str], np.random.Generator],
) -> tuple[Imu, np.ndarray, np.ndarray]:
    """Simulate the inertial sensor at equally spaced stamps t, (n,) s.

    Samples are values at an instant, not means over the sample time. `random(part)` returns the
    numpy Generator of a part.

    Returns (Imu, gyro bias (n, 3) rad/s, accel bias (n, 3) m/s^2).
    """
    n, dt = len(t), t[1] - t[0]
    motion = trajectory.motion(t)

    def bias_of(part: str, initial: float, walk: float) -> np.ndarray:
        """Return a random walk (n, 3) from a random value.

        initial : standard deviation of that value; walk : that of the walk after one second
        """
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


def measure_sensors(config: SimulationConfig, room: Room, trajectory: Flyable) -> dict[str, Stream]:
    """Simulate each of SENSORS that has a noise in the complete SimulationConfig: {name: Stream}.

    Streams have white noise; the wheels of a rover also have scale and slip.
    """
    out = {}
    for name, sensor in SENSORS.items():
        if getattr(config, f"{name}_noise") is None:
            continue
        wheels = name == "velocity" and config.vehicle == "rover"
        rate = WHEELS_RATE if wheels else sensor.rate
        t = np.arange(1, int(config.duration * rate) + 1) / rate
        motion, random = trajectory.motion(t), config.random(f"{name} noise")
        columns = sensor.simulated(
            config,
            room,
            motion,
            Rotation.from_quat(motion.q),
            lambda *shape: random.standard_normal((len(t), *shape)),
        )
        stream: Stream = sensor.stream(t, *columns)
        out[name] = _of_wheels(stream, config, motion.body_rates[:, 2]) if wheels else stream
    return out


def _of_wheels(velocity: Stream, config: SimulationConfig, turning: np.ndarray) -> Velocity:
    """Apply the errors of two wheels to a Velocity and the true turning rate (n,) rad/s."""
    assert isinstance(velocity, Velocity)
    n, t = len(velocity), velocity.t
    too_fast = (1.0 + config.wheel_scale) * (
        1.0 + config.wheel_slip * slips(t, config.random("slip"))
    )
    ahead = np.zeros((n, 3))
    ahead[:, 0] = too_fast * velocity.v[:, 0]
    yaw_rate = too_fast * turning + YAW_RATE_STD * config.random("yaw rate noise").standard_normal(
        n
    )
    return replace(velocity, v=ahead, yaw_rate=yaw_rate, yaw_rate_std=np.full(n, YAW_RATE_STD))


def slips(t: np.ndarray, random: np.random.Generator) -> np.ndarray:
    """Return whether the wheels slip at stamps t (n,) s: (n,) bool."""
    begins = np.cumsum(random.exponential(SLIP_EVERY, int(2.0 * t[-1] / SLIP_EVERY) + 10))
    last = np.searchsorted(begins, t, "right") - 1
    slipping: np.ndarray = (last >= 0) & (t < begins[last] + SLIP_TIME)
    return slipping
