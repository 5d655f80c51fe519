"""What the inertial effects share: measured = (I + E) true + b, for gyroscope and accelerometer."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ..foundation.errors import InputError
from .affine import IDENTITY, regressors
from .base import Effect
from .wording import listed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..foundation.anchors import Anchors
    from ..foundation.flight import Flight, Imu
    from .affine import Affine
    from .samples import ImuSamples


BESIDE_BIAS = 2.0  # price of what is a bias of the accelerometer, where nothing tilts or manoeuvres


class ImuEffect(Effect):
    """An effect on inertial samples.

    Subclasses say what a sensor makes of the truth: `gyro()` and `accel()`.
    """

    def gyro(self) -> Affine:
        """Affine, from the true turning rate to the measured one, rad/s, body."""
        return IDENTITY

    def accel(self) -> Affine:
        """Affine, from the true specific force to the measured one, m/s^2, body."""
        return IDENTITY

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        return [("x", "y", "z"), ("x",), ("y",), ("z",)]

    def vector(self) -> np.ndarray:
        """(3,) values of x, y, z."""
        return np.array([self.values.get(key, 0.0) for key in "xyz"])

    def sensor_model(self, channel: str) -> Affine:
        return {"gyro": self.gyro, "accel": self.accel}.get(channel, lambda: IDENTITY)()

    def regressors(self, samples: ImuSamples, keys: Sequence[str]) -> np.ndarray:
        return regressors(
            lambda values: type(self)(values).sensor_model(samples.channel),
            self.values,
            samples.reading,
            keys,
        )

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        imu = need_imu(self, flight)
        return replace(
            flight, imu=replace(imu, gyro=self.gyro()(imu.gyro), accel=self.accel()(imu.accel))
        )


def readings(effect: ImuEffect, along: str, unit: str | None = None, factor: float = 1.0) -> str:
    """Significant values of an ImuEffect that adds to what a sensor reads: "0.20 ± 0.01 m/s^2 too
    much along x"; "" without any. along : "along" or "about" the axes.
    """
    parts = {
        key: (
            f"{effect.size(key, unit, factor)} too {'much' if value > 0.0 else 'little'} {along} "
            f"{key}"
        )
        for key, value in effect.significant().items()
    }
    return listed(parts[key] for key in sorted(parts)) if parts else ""


def need_imu(effect: ImuEffect, flight: Flight) -> Imu:
    """The inertial samples of a flight; raises InputError if it has none."""
    if flight.imu is None:
        raise InputError(f"{flight.name}: holds no inertial samples, which {effect.name} needs.")
    return flight.imu
