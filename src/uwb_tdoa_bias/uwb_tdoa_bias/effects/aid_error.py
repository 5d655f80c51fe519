"""What the effects on heights, pressures and velocities share."""

from dataclasses import replace

from ..foundation.errors import InputError
from .affine import IDENTITY, regressors
from .base import Effect


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
        return replace(flight, **{stream: part.sensed(self.aid()(part.values))})
