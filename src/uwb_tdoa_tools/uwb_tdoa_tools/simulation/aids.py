"""Height, pressure and velocity: what is true, and white noise."""

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.foundation.flight import Height, Pressure, Velocity
from uwb_tdoa_bias.foundation.pressure import pressure_at

RATE = 25.0  # Hz
SITE = 200.0  # m above the sea, of z = 0
LEAST_STD = 0.01  # m/s, that a velocity says of itself


def measure(config, room, trajectory):
    """{stream: Height, Pressure or Velocity} of those that the SimulationConfig, from complete(), has a noise for."""
    t = np.arange(1, int(config.duration * RATE) + 1) / RATE
    motion, out = trajectory.motion(t), {}
    turn = Rotation.from_quat(motion.q)

    def noise(stream, std, *shape):
        return std * config.random(f"{stream} noise").standard_normal((len(t), *shape))

    if config.height_noise is not None:
        true = (motion.p[:, 2] - room.lower[2]) / turn.apply([0.0, 0.0, 1.0])[:, 2]
        out["height"] = Height(t, np.maximum(true + noise("height", config.height_noise), 0.0))
    if config.pressure_noise is not None:
        altitude = SITE + motion.p[:, 2] + noise("pressure", config.pressure_noise)
        out["pressure"] = Pressure(t, pressure_at(altitude))
    if config.velocity_noise is not None:
        v = turn.inv().apply(motion.v) + noise("velocity", config.velocity_noise, 3)
        out["velocity"] = Velocity(t, v, np.full(v.shape, max(config.velocity_noise, LEAST_STD)))
    return out
