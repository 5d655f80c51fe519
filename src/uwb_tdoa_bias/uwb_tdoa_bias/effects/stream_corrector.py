"""Takes the effects out of the streams of a recording, of a whole one or part by part."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

from ..foundation.flight import AIDS
from .aid_corrector import AidCorrector
from .imu_corrector import ImuCorrector
from .label_error import LabelCorrector

if TYPE_CHECKING:
    from collections.abc import Collection

    from .base import Effect

STREAMS = ("tdoa", "imu", "truth", *AIDS)  # of a Flight


class StreamCorrector:
    """Undoes the effects of a set in ids, signs, stamps, inertial samples, heights and velocities.

    TDOA biases are the Corrector's.
    """

    def __init__(self, effects: Collection[Effect]) -> None:
        """effects : those that do not act on these are passed over."""
        self._late = {
            stream: sum(effect.stamp_offset(stream) for effect in effects)
            for stream in STREAMS
            if stream not in AIDS
        }
        self._labels, self._imu, self._aids = (
            LabelCorrector(effects),
            ImuCorrector(effects),
            AidCorrector(effects),
        )

    def correct(self, name: str, stream: Any) -> Any:
        """A stream of a Flight, by its name, or the part of it that follows the last one,
        corrected.
        """
        if name in AIDS:
            return self._aids.correct(name, stream)
        if self._late[name]:
            stream = replace(stream, t=stream.t - self._late[name])
        if name == "tdoa" and not self._labels.idle:
            a, b, d = self._labels.correct(stream.a, stream.b, stream.d)
            return replace(stream, a=a, b=b, d=d)
        if name == "imu" and not self._imu.idle:
            gyro, accel = self._imu.correct(stream.t, stream.gyro, stream.accel)
            return replace(stream, gyro=gyro, accel=accel)
        return stream
