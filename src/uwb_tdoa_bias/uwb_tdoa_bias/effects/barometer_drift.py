"""The barometer drifts."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .aid_error import need_stream
from .base import Effect

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..foundation.flight import Flight
    from .samples import AidSamples


class BarometerDrift(Effect):
    """The altitude of the barometer grows by `rate` metres a second beyond the true one, counted
    from the first TDOA. The filter estimates offset and drift of a barometer itself.
    """

    name = "barometer_drift"
    unit = "m/s"
    bound = 10.0
    negligible = 0.002
    typical = 0.02
    example = "rate"
    physics = "the sensor warms up, the weather or the pressure in the hall changes"
    reference = (
        "BMP388 data sheet: 0.75 Pa/K, that is 6 cm per degree; 10 Pa, 0.8 m, a quarter of an "
        "hour of weather"
    )
    portable = False
    usable = False  # the filter estimates it while it flies
    channels = ("pressure",)

    def uncorrected(self, samples: AidSamples) -> np.ndarray:
        return self.values.get("rate", 0.0) * (samples.t - samples.start)[:, None]

    def regressors(self, samples: AidSamples, keys: Sequence[str]) -> np.ndarray:
        return np.repeat((samples.t - samples.start)[:, None, None], len(keys), axis=2)

    def inject(self, flight: Flight, rng: np.random.Generator | None = None) -> Flight:
        part = need_stream(self, flight, "pressure")
        extra = self.values.get("rate", 0.0) * (part.t - float(flight.tdoa.t[0]))
        return flight.replaced(pressure=part.sensed(part.values + extra[:, None]))

    def advice(self) -> tuple[str, ...]:
        if not self.significant():
            return ()
        way = "upwards" if self.values["rate"] > 0.0 else "downwards"
        return (
            f"Let the barometer warm up, and shield it from wind and light: it drifts {way} by "
            f"{self.size('rate', 'm a minute', 60.0)}.",
        )
