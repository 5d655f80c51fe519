"""What the inertial effects share: measured = (I + E) true + b, for gyroscope and accelerometer."""

from dataclasses import replace

import numpy as np

from ..foundation.errors import InputError
from .affine import IDENTITY, regressors
from .base import Effect
from .wording import listed, significant, size


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

    def sensor_model(self, channel):
        return {"gyro": self.gyro, "accel": self.accel}.get(channel, lambda: IDENTITY)()

    def regressors(self, samples, keys):
        return regressors(self, samples, keys)

    def inject(self, flight, rng=None):
        need_imu(self, flight)
        imu = flight.imu
        return replace(flight, imu=replace(imu, gyro=self.gyro()(imu.gyro), accel=self.accel()(imu.accel)))


def readings(effect, along, unit=None, factor=1.0):
    """Significant values of an ImuEffect that adds to what a sensor reads: "0.20 ± 0.01 m/s^2 too much along x"; ""
    without any. along : "along" or "about" the axes."""
    parts = {
        key: f"{size(effect, key, unit, factor)} too {'much' if value > 0.0 else 'little'} {along} {key}"
        for key, value in significant(effect).items()
    }
    return listed(parts[key] for key in sorted(parts)) if parts else ""


def need_imu(effect, flight):
    """Raise InputError if the flight has no inertial samples."""
    if flight.imu is None:
        raise InputError(f"{flight.name}: holds no inertial samples, which {effect.name} needs.")
