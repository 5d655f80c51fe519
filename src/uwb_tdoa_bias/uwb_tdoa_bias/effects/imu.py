# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects of the inertial sensor, measured = (I + E) true + b, and their corrector."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np

from ..common.flight import Flight
from ..common.lazy import rotations
from .base import FADED_BELOW, IDENTITY, Affine, Effect, Row, SensorEffect, require, undoing
from .covariates import OF_IMU, ImuFeatures, fade_weight
from .samples import ImuSamples, Track

SENSORS = ("gyro", "accel")
# `penalty` of effects that look like a bias of the accelerometer without tilt and manoeuvres
BESIDE_BIAS = 2.0


class ImuEffect(SensorEffect):
    """An effect with a vector (x, y, z), body, on the gyroscope, the accelerometer or both."""

    parameters: ClassVar[tuple[str, ...] | None] = ("x", "y", "z")

    def vector(self) -> np.ndarray:
        """Return the values of x, y and z, (3,)."""
        return np.array([self.values.get(key, 0.0) for key in "xyz"])

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        imu = require(self, flight, "imu")
        sensed = {name: self.model()(getattr(imu, name)) for name in self.channels}
        return replace(flight, imu=replace(imu, **sensed))


class SensorBias(ImuEffect):
    """Measured = true + (x, y, z)."""

    def model(self) -> Affine:
        return Affine(np.eye(3), self.vector())


class SensorScale(ImuEffect):
    """Measured = (1 + (x, y, z)) true, axis by axis."""

    def model(self) -> Affine:
        return Affine(np.eye(3) + np.diag(self.vector()), np.zeros(3))


class GyroBias(SensorBias):
    """Measured rate = true rate + (x, y, z), body."""

    row = Row(
        name="gyro_bias",
        unit="rad/s",
        bound=1.0,
        negligible=0.002,
        prior_std=0.05,
        example="z",
        physics="zero-rate offset of a MEMS gyroscope, with temperature and age",
        reference="BMI088 data sheet: zero-rate offset 1 degree/s",
        remedy="Let the gyroscope find its zero at rest before take-off: it reads {found}.",
        phrase="{size} {way} about {key}",
        ways=("too much", "too little"),
    )
    channels = ("gyro",)


class GyroScale(SensorScale):
    """Measured rate = (1 + (x, y, z)) true rate, axis by axis."""

    row = Row(
        name="gyro_scale",
        unit="1",
        bound=0.5,
        negligible=0.01,
        prior_std=0.05,
        example="z",
        physics="sensitivity error of a MEMS gyroscope",
        reference="BMI088 data sheet: sensitivity tolerance 1 %",
        confounded_with=("truth_time_offset", "imu_misalignment"),
        remedy="Calibrate the gyroscope on a turntable: it reads {found}.",
        phrase="{size} {way} about {key}",
        ways=("too much", "too little"),
        shown=("%", 100.0),
    )
    channels = ("gyro",)


class AccelBias(SensorBias):
    """Measured force = true specific force + (x, y, z), body."""

    row = Row(
        name="accel_bias",
        unit="m/s^2",
        bound=10.0,
        negligible=0.03,
        prior_std=0.5,
        example="x",
        physics="zero-g offset of a MEMS accelerometer, and vibration that it rectifies",
        reference="BMI088 data sheet: zero-g offset 20 mg",
        confounded_with=("imu_misalignment", "imu_gravity", "accel_scale"),
        remedy=(
            "Calibrate the accelerometer at rest and damp the vibration of its mount: it "
            "reads {found}."
        ),
        phrase="{size} {way} along {key}",
        ways=("too much", "too little"),
    )
    channels = ("accel",)
    sizable_share = 0.3  # one axis suffices, else a scale replaces the bias of the others


class AccelScale(SensorScale):
    """Measured force = (1 + (x, y, z)) true specific force, axis by axis."""

    row = Row(
        name="accel_scale",
        unit="1",
        bound=0.5,
        negligible=0.004,
        prior_std=0.05,
        example="z",
        physics="sensitivity error of a MEMS accelerometer",
        reference="BMI088 data sheet: sensitivity tolerance 0.7 %",
        confounded_with=("accel_bias", "imu_gravity"),
        distinguished_by={
            "accel_bias": "hard manoeuvres: a scale grows with them, a bias does not"
        },
        remedy="Calibrate the accelerometer, each axis up and down: it reads {found}.",
        phrase="{size} {way} along {key}",
        ways=("too much", "too little"),
        shown=("%", 100.0),
    )
    channels = ("accel",)
    penalty = BESIDE_BIAS


class ImuMisalignment(ImuEffect):
    """Measured = R^T true, with R of the rotation vector (x, y, z) from body to IMU axes."""

    row = Row(
        name="imu_misalignment",
        unit="rad",
        bound=0.6,
        negligible=0.004,
        prior_std=0.05,
        example="x",
        physics="the sensor, or the frame of the ground truth, is turned against the body's axes",
        reference="strapdown navigation: mounting misalignment",
        confounded_with=("accel_bias", "gyro_scale"),
        distinguished_by={
            "accel_bias": "quick turns: a misalignment also shows on the gyroscope",
        },
        remedy=(
            "Turn the IMU by {found}: its axes are not those of the body as the ground truth "
            "has it."
        ),
        phrase="{value} about {key}",
        shown=("degrees", float(-np.degrees(1.0))),  # the turn back
    )
    channels = SENSORS

    def model(self) -> Affine:
        return Affine(rotations.Rotation.from_rotvec(self.vector()).as_matrix().T, np.zeros(3))


class ImuGravity(ImuEffect):
    """Gravity is 9.81 m/s^2 + `excess`, along the vertical of the world.

    It is corrected along the z axis of the body, without an attitude. At the tilt of a flight a few
    percent of the excess remain.
    """

    row = Row(
        name="imu_gravity",
        unit="m/s^2",
        bound=1.0,
        negligible=0.03,
        prior_std=0.1,
        example="excess",
        physics=(
            "local gravity, or the factor from g to m/s^2, differs from the 9.81 m/s^2 of the "
            "filter"
        ),
        reference="gravity is 9.780 to 9.832 m/s^2 between equator and pole",
        confounded_with=("accel_bias", "accel_scale"),
        distinguished_by={
            "accel_bias": "a flight that tilts, or the vehicle at rest on its sides",
            "accel_scale": "hard manoeuvres up and down: a scale grows with them, gravity does not",
        },
        remedy=(
            "Check the accelerometer's factor from g to m/s^2, and local gravity: it reads "
            "{found} upwards."
        ),
        ways=("too much", "too little"),
    )
    channels = ("accel",)
    parameters = ("excess",)
    penalty = BESIDE_BIAS

    def model(self) -> Affine:
        return Affine(np.eye(3), np.array([0.0, 0.0, self.values.get("excess", 0.0)]))

    def regressors(self, samples: ImuSamples, keys: Sequence[str]) -> np.ndarray:
        return np.repeat(samples.up[:, :, None], len(keys), axis=2)  # the true vertical

    def uncorrected(self, samples: ImuSamples) -> np.ndarray:
        return self.values.get("excess", 0.0) * (samples.up - [0.0, 0.0, 1.0])

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        truth, imu = require(self, flight, "truth"), require(self, flight, "imu")
        error, q = self.model().offset, Track(truth).attitudes(imu.t)
        if np.isfinite(q).all():
            error = rotations.Rotation.from_quat(q).inv().apply(error)
        return replace(flight, imu=replace(imu, accel=imu.accel + error))


class ImuCorrector:
    """Corrector of inertial samples, for whole streams or one sample after the other.

    It undoes the effects of a set in its order, those that depend on features last.
    """

    def __init__(self, effects: Collection[Effect]) -> None:
        """Select the effects on inertial samples among `effects`."""
        self._undo = [undoing(effects, channel) for channel in SENSORS]
        still = np.zeros((1, len(OF_IMU)))
        self._additive = [
            effect
            for effect in effects
            if any(effect.sensor_bias(channel, still) is not None for channel in SENSORS)
        ]
        self._features, self._latest = ImuFeatures(), still[:0]
        self.idle = not self._additive and all(undo is IDENTITY for undo in self._undo)

    @property
    def outside(self) -> list[str]:
        """Return phrases on the effects that faded below FADED_BELOW in the latest samples."""
        return [
            effect.domain_words
            for effect in self._additive
            if any(self._is_faded(*limits) for limits in effect.domain.items())
        ]

    def _is_faded(self, covariate: str, limits: tuple[float, float]) -> bool:
        if covariate not in OF_IMU:
            return False
        weights = fade_weight(self._latest[:, OF_IMU.index(covariate)], limits)
        return bool(np.min(weights, initial=1.0) < FADED_BELOW)

    def correct(
        self, t: np.ndarray, gyro: np.ndarray, accel: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return corrected (gyro (n, 3) rad/s, accel (n, 3) m/s^2) of samples at t (n,), s."""
        sensed = [undo(samples) for undo, samples in zip(self._undo, (gyro, accel))]
        if self._additive:
            self._latest = features = self._features(t, *sensed)
            for effect in self._additive:
                for channel, samples in zip(SENSORS, sensed):
                    part = effect.sensor_bias(channel, features)
                    if part is not None:
                        samples -= np.where(np.isfinite(part), part, 0.0)
        return sensed[0], sensed[1]
