"""What the inertial effects share: measured = (I + E) true + b, for gyroscope and accelerometer."""

from dataclasses import dataclass, replace

import numpy as np

from ..foundation.errors import InputError
from .base import Effect


@dataclass(frozen=True)
class Affine:
    """x -> matrix x + offset, for (n, 3) rows."""

    matrix: np.ndarray
    offset: np.ndarray

    def __call__(self, x):
        return x @ self.matrix.T + self.offset

    def after(self, first):
        """The map that applies `first`, then this one."""
        return Affine(self.matrix @ first.matrix, self.matrix @ first.offset + self.offset)

    def inverse(self):
        """The map that undoes this one."""
        back = np.linalg.inv(self.matrix)
        return Affine(back, -back @ self.offset)


IDENTITY = Affine(np.eye(3), np.zeros(3))


class ImuEffect(Effect):
    """An effect on inertial samples. Subclasses say what a sensor makes of the truth: `gyro()` and `accel()`."""

    def gyro(self):
        """Affine, from the true turning rate to the measured one, rad/s, body."""
        return IDENTITY

    def accel(self):
        """Affine, from the true specific force to the measured one, m/s^2, body."""
        return IDENTITY

    @classmethod
    def groups(cls, anchors, pairs):
        return [("x", "y", "z"), ("x",), ("y",), ("z",)]

    def vector(self):
        """(3,) values of x, y, z."""
        return np.array([self.values.get(key, 0.0) for key in "xyz"])

    def imu_regressors(self, channel, true, keys):
        """Derivative of what `channel` ("gyro" or "accel") measures by the parameters `keys`, at the true values
        (n, 3): (n, 3, len(keys))."""
        step, out = 1e-6, np.empty((*true.shape, len(keys)))
        for column, key in enumerate(keys):
            here = self.values.get(key, 0.0)
            ends = [getattr(type(self)({**self.values, key: here + s}), channel)()(true) for s in (-step, step)]
            out[:, :, column] = (ends[1] - ends[0]) / (2.0 * step)
        return out

    def inject(self, flight, rng=None):
        need_imu(self, flight)
        imu = flight.imu
        return replace(flight, imu=replace(imu, gyro=self.gyro()(imu.gyro), accel=self.accel()(imu.accel)))


def need_imu(effect, flight):
    """Raise InputError if the flight has no inertial samples."""
    if flight.imu is None:
        raise InputError(f"{flight.name}: holds no inertial samples, which {effect.name} needs.")
