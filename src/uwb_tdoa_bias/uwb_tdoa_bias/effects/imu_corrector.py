"""Takes the inertial effects out of a stream of samples, at once or one by one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .affine import IDENTITY
from .covariates import OF_IMU, ImuFeatures
from .domain import share
from .fading import LITTLE, in_words

if TYPE_CHECKING:
    from collections.abc import Collection

    from .base import Effect

SENSORS = ("gyro", "accel")


class ImuCorrector:
    """Undoes the effects of a set in the order in which they are listed; what depends on features
    comes last.
    """

    def __init__(self, effects: Collection[Effect]) -> None:
        """effects : those that do not act on inertial samples are passed over."""
        self._undo = []
        for channel in SENSORS:
            undo = IDENTITY
            for effect in effects:
                undo = effect.sensor_model(channel).inverse().after(undo)
            self._undo.append(undo)
        still = np.zeros((1, len(OF_IMU)))
        self._additive = [
            e
            for e in effects
            if any(e.sensor_bias(channel, still) is not None for channel in SENSORS)
        ]
        self._features, self._latest = ImuFeatures(), still[:0]
        self.idle = not self._additive and all(
            effect.sensor_model(channel) is IDENTITY for effect in effects for channel in SENSORS
        )

    @property
    def outside(self) -> list[str]:
        """Phrases on those effects of which less than half was taken out of some of the latest
        samples, because they were not seen there.
        """
        return [
            in_words(effect)
            for effect in self._additive
            if any(self._is_beyond(*limits) for limits in effect.domain.items())
        ]

    def _is_beyond(self, covariate: str, limits: tuple[float, float]) -> bool:
        return (
            covariate in OF_IMU
            and np.min(share(self._latest[:, OF_IMU.index(covariate)], limits), initial=1.0)
            < LITTLE
        )

    def correct(
        self, t: np.ndarray, gyro: np.ndarray, accel: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """t (n,) s; gyro (n, 3) rad/s; accel (n, 3) m/s^2. Returns corrected (gyro, accel)."""
        sensed = [undo(samples) for undo, samples in zip(self._undo, (gyro, accel))]
        if self._additive:
            self._latest = features = self._features(t, *sensed)
            for effect in self._additive:
                for channel, samples in zip(SENSORS, sensed):
                    part = effect.sensor_bias(channel, features)
                    if part is not None:
                        samples -= np.where(np.isfinite(part), part, 0.0)
        return sensed[0], sensed[1]
