"""What the SENSORS beside inertia and TDOAs say: what is true, and white noise."""

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.sensors import SENSORS


def measure(config, room, trajectory):
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
