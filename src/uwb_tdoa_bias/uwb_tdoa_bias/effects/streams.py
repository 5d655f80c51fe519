# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Correctors of streams: they undo effects on ids, signs, stamps and values of sensors."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from typing import Any

import numpy as np

from ..common.flight import SENSOR_NAMES
from ..common.sensors import STREAM_OF
from ..common.sensors.sensor import UNKNOWN_STD, UNKNOWN_VARIANCE, Stream
from .base import FADED_BELOW, IDENTITY, Effect, LabelEffect, relabelled, undoing
from .covariates import OF_IMU, ImuFeatures, fade_weight
from .sensor import INERTIAL

STREAMS = ("tdoa", "imu", "truth", *SENSOR_NAMES)  # of a Flight


class ImuCorrector:
    """Corrector of inertial samples, for whole streams or one sample after the other.

    It undoes the effects of a set in its order, those that depend on features last.
    """

    def __init__(self, effects: Collection[Effect]) -> None:
        """Select the effects on inertial samples among `effects`."""
        self._undo = [undoing(effects, channel) for channel in INERTIAL]
        still = np.zeros((1, len(OF_IMU)))
        self._additive = [
            effect
            for effect in effects
            if any(effect.sensor_bias(channel, still) is not None for channel in INERTIAL)
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
                for channel, samples in zip(INERTIAL, sensed):
                    part = effect.sensor_bias(channel, features)
                    if part is not None:
                        samples -= np.where(np.isfinite(part), part, 0.0)
        return sensed[0], sensed[1]


class StreamCorrector:
    """Corrector of the streams of a recording, whole or one measurement after the other.

    It corrects ids, signs, stamps and values of all sensors. The biases of TDOAs and ranges are
    corrected by Corrector.
    """

    def __init__(self, effects: Collection[Effect]) -> None:
        """Select the effects on streams among `effects`; they are undone in their order."""
        self._late = {
            stream: sum(effect.stamp_offset(stream) for effect in effects) for stream in STREAMS
        }
        self._labels = [effect for effect in effects if isinstance(effect, LabelEffect)]
        self._imu = ImuCorrector(effects)
        self._undo = {channel: undoing(effects, channel) for channel in STREAM_OF}

    def correct(self, name: str, stream: Any) -> Any:
        """Return the corrected stream `name` of a Flight, or its next part."""
        if self._late[name]:
            stream = replace(stream, t=stream.t - self._late[name])
        if name == "tdoa" and self._labels:
            a, b, d = relabelled(self._labels, stream.a, stream.b, stream.d)
            return replace(stream, a=a, b=b, d=d)
        if name == "imu" and not self._imu.idle:
            gyro, accel = self._imu.correct(stream.t, stream.gyro, stream.accel)
            return replace(stream, gyro=gyro, accel=accel)
        if name not in SENSOR_NAMES:
            return stream
        for channel, part in stream.parts.items():
            stream = stream.with_part(channel, self._undone(channel, part))
        return self._undone(name, stream)

    def _undone(self, channel: str, stream: Stream) -> Stream:
        undo = self._undo[channel]
        if undo is IDENTITY:
            return stream
        std = getattr(stream, "std", None)
        if std is None:
            return stream.with_values(undo(stream.values))
        known = np.isfinite(std)  # an axis that was not measured may hold any value
        variance = np.where(known, std, UNKNOWN_STD) ** 2 @ undo.matrix.T**2
        std = np.where(variance < UNKNOWN_VARIANCE, np.sqrt(variance), np.inf)
        values = undo(np.where(known, stream.values, 0.0))
        corrected: Any = stream.with_values(values)  # has a std, as `stream` has
        return replace(corrected, std=std)
