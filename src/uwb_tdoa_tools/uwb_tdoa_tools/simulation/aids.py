"""What the SENSORS beside inertia and TDOAs say: what is true, and white noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.sensors import SENSORS

if TYPE_CHECKING:
    from uwb_tdoa_bias.foundation.sensors import Stream
    from .config import SimulationConfig
    from .room import Room
    from .motion import Flyable


def measure(config: SimulationConfig, room: Room, trajectory: Flyable) -> dict[str, Stream]:
    """{name: Stream} of those that the SimulationConfig, from complete(), has a noise for."""
    out = {}
    for name, sensor in SENSORS.items():
        if getattr(config, f"{name}_noise") is None:
            continue
        t = np.arange(1, int(config.duration * sensor.rate) + 1) / sensor.rate
        motion, random = trajectory.motion(t), config.random(f"{name} noise")
        columns = sensor.simulated(
            config, room, motion, Rotation.from_quat(motion.q), lambda *shape: random.standard_normal((len(t), *shape))
        )
        out[name] = sensor.stream(t, *columns)
    return out
