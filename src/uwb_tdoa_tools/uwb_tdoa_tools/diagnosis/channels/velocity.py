"""The velocity in the body frame."""

import numpy as np

from .aid import Aid


class Velocity(Aid):
    """Velocities in the body frame, minus the true ones."""

    name = "velocity"
    unit = "m/s"
    needs = "a velocity (wheels, optical flow, visual odometry), and ground truth of position and attitude"
    negligible = 0.003
    axes = (".x", ".y", ".z")
    positions = (0, 1, 2)

    def _values(self, part):
        return np.where(np.isfinite(part.std), super()._values(part), np.nan)
