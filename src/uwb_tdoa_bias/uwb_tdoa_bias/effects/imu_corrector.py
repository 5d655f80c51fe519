"""Takes the inertial effects out of a stream of samples, at once or one by one."""

import numpy as np

from .covariates import OF_IMU, ImuFeatures
from .imu_error import IDENTITY, ImuEffect
from .smooth_term import SmoothTerm


class ImuCorrector:
    """Undoes the effects of a set in the order in which they are listed; smooth terms come last."""

    def __init__(self, effects):
        """effects : iterable of Effect; those that do not act on inertial samples are passed over."""
        self._gyro = self._accel = IDENTITY
        for effect in effects:
            if isinstance(effect, ImuEffect):
                self._gyro = effect.gyro().inverse().after(self._gyro)
                self._accel = effect.accel().inverse().after(self._accel)
        self._terms = [e for e in effects if isinstance(e, SmoothTerm) and e.channel != "tdoa" and e.usable]
        self._features = ImuFeatures()
        self.idle = not self._terms and not any(isinstance(effect, ImuEffect) for effect in effects)

    def correct(self, t, gyro, accel):
        """t (n,) s; gyro (n, 3) rad/s; accel (n, 3) m/s^2. Returns corrected (gyro, accel)."""
        gyro, accel = self._gyro(gyro), self._accel(accel)
        if self._terms:
            features = self._features(t, gyro, accel)
            for term in self._terms:
                sensor, axis = term.channel.split(".")
                part = term.curve(features[:, OF_IMU.index(term.covariate)])
                (gyro if sensor == "gyro" else accel)[:, "xyz".index(axis)] -= np.where(np.isfinite(part), part, 0.0)
        return gyro, accel
