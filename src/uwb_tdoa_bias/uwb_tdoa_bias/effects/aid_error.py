"""What the effects on heights, pressures and velocities share."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..foundation.errors import InputError
from ..foundation.sensors import STREAM_OF, measured_on, with_measured
from .affine import IDENTITY, regressors
from .base import Effect

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np

    from ..foundation.flight import Flight
    from ..foundation.sensors.sensor import Stream
    from .affine import Affine
    from .samples import AidSamples


def need_stream(effect: Effect, flight: Flight, channel: str) -> Stream:
    """What a Flight holds of a channel of one of the SENSORS, or its "truth"; raises InputError if
    it has none.
    """
    part = measured_on(flight, channel) if channel in STREAM_OF else getattr(flight, channel)
    if part is None:
        name = channel.replace("_", " ")
        raise InputError(f"{flight.name}: holds no {name}, which {effect.name} needs.")
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
        (channel,) = self.channels
        part = need_stream(self, flight, channel)
        changed: Flight = with_measured(flight, channel, part.sensed(self.aid()(part.values)))
        return changed
