"""What the effects on heights, pressures and velocities share."""

from dataclasses import replace

import numpy as np

from ..foundation.errors import InputError
from ..foundation.flight import Height, Pressure, Velocity
from ..foundation.pressure import altitude_of, pressure_at
from .affine import IDENTITY, regressors
from .base import Effect


def values_of(part):
    """What a Height, Pressure or Velocity measured as effects see it, (n, k): ranges, altitudes of the standard atmosphere,
    m, or velocities, m/s."""
    if isinstance(part, Velocity):
        return part.v
    return (part.range if isinstance(part, Height) else altitude_of(part.pressure))[:, None]


def with_values(part, values):
    """A Height, Pressure or Velocity that measured other values (n, k)."""
    if isinstance(part, Velocity):
        return replace(part, v=values)
    if isinstance(part, Pressure):
        return replace(part, pressure=pressure_at(values[:, 0]))
    return replace(part, range=np.maximum(values[:, 0], 0.0))


def need_stream(effect, flight, stream):
    """The stream of a Flight; raises InputError if it has none."""
    part = getattr(flight, stream)
    if part is None:
        raise InputError(f"{flight.name}: holds no {stream}, which {effect.name} needs.")
    return part


class AidEffect(Effect):
    """An effect on one stream, its only channel, with a model of the sensor: `aid()`."""

    def aid(self):
        """Affine, from the true to the measured values of the stream."""
        return IDENTITY

    def sensor_model(self, channel):
        return self.aid() if channel in self.channels else IDENTITY

    def regressors(self, samples, keys):
        return regressors(self, samples, keys)

    def inject(self, flight, rng=None):
        (stream,) = self.channels
        part = need_stream(self, flight, stream)
        return replace(flight, **{stream: with_values(part, self.aid()(values_of(part)))})
