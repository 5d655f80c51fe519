"""Takes the effects out of what other sensors measure, and out of their stamps, at once or one by
one.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..foundation.flight import AIDS
from ..foundation.sensors import STREAM_OF
from ..foundation.sensors.sensor import UNKNOWN_STD, UNKNOWN_VARIANCE
from .affine import IDENTITY

if TYPE_CHECKING:
    from collections.abc import Collection

    from ..foundation.sensors.sensor import Stream
    from .affine import Affine
    from .base import Effect


class AidCorrector:
    """Undoes the effects of a set in the order in which they are listed."""

    def __init__(self, effects: Collection[Effect]) -> None:
        """effects : those that do not act on these streams are passed over."""
        self._late = {
            stream: sum(effect.stamp_offset(stream) for effect in effects) for stream in AIDS
        }
        self._undo = {channel: self._inverse(effects, channel) for channel in STREAM_OF}
        self.idle = not any(self._late.values()) and not any(self._undo.values())

    @staticmethod
    def _inverse(effects: Collection[Effect], channel: str) -> Affine | None:
        undo = None
        for effect in effects:
            model = effect.sensor_model(channel)
            if model is not IDENTITY:
                undo = model.inverse() if undo is None else model.inverse().after(undo)
        return undo

    def correct(self, name: str, stream: Stream) -> Stream:
        """The Stream of a sensor, corrected."""
        if self._late[name]:
            stream = replace(stream, t=stream.t - self._late[name])
        for channel, part in stream.parts.items():
            stream = stream.with_part(channel, self._undone(channel, part))
        return self._undone(name, stream)

    def _undone(self, channel: str, stream: Stream) -> Stream:
        undo = self._undo[channel]
        if undo is None:
            return stream
        std = getattr(stream, "std", None)
        if std is None:
            return stream.with_values(undo(stream.values))
        known = np.isfinite(std)  # what was not measured may be anything
        variance = np.where(known, std, UNKNOWN_STD) ** 2 @ undo.matrix.T**2
        std = np.where(variance < UNKNOWN_VARIANCE, np.sqrt(variance), np.inf)
        corrected: Any = stream.with_values(
            undo(np.where(known, stream.values, 0.0))
        )  # its class has a std, as `stream` has
        return replace(corrected, std=std)
