"""What the effects on heights, pressures and velocities share."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..foundation.errors import InputError
from .affine import IDENTITY, regressors
from .base import Effect

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from ..foundation.flight import Flight
    from ..foundation.sensors.sensor import Stream
    from .affine import Affine
    from .samples import AidSamples


def need_stream(effect: Effect, flight: Flight, stream: str) -> Stream:
    """The stream of a Flight; raises InputError if it has none."""
    part = getattr(flight, stream)
    if part is None:
        raise InputError(f"{flight.name}: holds no {stream}, which {effect.name} needs.")
    return part


class AidEffect(Effect):
    """An effect on one stream, its only channel, with a model of the sensor: `aid()`."""

    def aid(self) -> Affine:
        """Affine, from the true to the measured values of the stream."""
        return IDENTITY

    def sensor_model(self, channel: str) -> Affine:
        return self.aid() if channel in self.channels else IDENTITY

    def regressors(self, samples: AidSamples, keys: Sequence[str]) -> np.ndarray:
        return regressors(
            lambda values: type(self)(values).sensor_model(samples.channel),
            self.values,
            samples.reading,
            keys,
        )

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        (stream,) = self.channels
        part = need_stream(self, flight, stream)
        return flight.replaced(**{stream: part.sensed(self.aid()(part.values))})
