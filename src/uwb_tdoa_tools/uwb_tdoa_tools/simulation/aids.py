"""What the SENSORS beside inertia and TDOAs say: what is true, white noise, and what the wheels of
a rover do.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.sensors import SENSORS, Velocity

from .config import WHEELS_RATE

if TYPE_CHECKING:
    from uwb_tdoa_bias.foundation.sensors import Stream

    from .config import SimulationConfig
    from .motion import Flyable
    from .room import Room

YAW_RATE_STD = 0.02  # rad/s
SLIP_EVERY, SLIP_TIME = 10.0, 0.5  # s


def measure(config: SimulationConfig, room: Room, trajectory: Flyable) -> dict[str, Stream]:
    """{name: Stream} of those that the SimulationConfig, from complete(), has a noise for."""
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
        stream = sensor.stream(t, *columns)
        out[name] = _of_wheels(stream, config, motion.body_rates[:, 2]) if wheels else stream
    return out


def _of_wheels(velocity: Stream, config: SimulationConfig, turning: np.ndarray) -> Velocity:
    """What two wheels make of a Velocity, and of the true turning rate (n,) rad/s."""
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
    """Whether the wheels slip at the stamps t: (n,) bool."""
    begins = np.cumsum(random.exponential(SLIP_EVERY, int(2.0 * t[-1] / SLIP_EVERY) + 10))
    last = np.searchsorted(begins, t, "right") - 1
    slipping: np.ndarray = (last >= 0) & (t < begins[last] + SLIP_TIME)
    return slipping
