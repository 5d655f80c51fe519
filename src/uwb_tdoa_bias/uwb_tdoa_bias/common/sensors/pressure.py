# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A barometer, and altitudes of the international standard atmosphere.

Source: ICAO Doc 7488, troposphere.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from .sensor import Compared, Sensor, Stream, finite, parameter

SEA_LEVEL = 101325.0  # Pa
SCALE = 44330.77  # m, temperature at sea level over its lapse rate: 288.15 K / 6.5 K/km
EXPONENT = 5.25588  # g M / (R lapse rate)
LOWEST, HIGHEST = 3e4, 1.2e5  # Pa, air in which vehicles move
SITE = 200.0  # m, altitude of z = 0 in simulations


def pressure_at(altitude: np.ndarray) -> np.ndarray:
    """Return the pressure, Pa, at an altitude above the sea, m; numbers or arrays."""
    return SEA_LEVEL * (1.0 - altitude / SCALE) ** EXPONENT


def altitude_of(pressure: np.ndarray) -> np.ndarray:
    """Return the altitude above the sea, m, of a pressure, Pa; numbers or arrays."""
    return SCALE * (1.0 - (pressure / SEA_LEVEL) ** (1.0 / EXPONENT))


@dataclass(frozen=True)
class Pressure(Stream):
    """Static air pressure. t : (n,) s; pressure : (n,) Pa."""

    t: np.ndarray
    pressure: np.ndarray

    @property
    def values(self) -> np.ndarray:
        return altitude_of(self.pressure)[:, None]

    def with_values(self, values: np.ndarray) -> Pressure:
        return replace(self, pressure=pressure_at(values[:, 0]))


def _measured(of: Pressure) -> tuple[dict, np.ndarray]:
    usable = (of.pressure > LOWEST) & (of.pressure < HIGHEST)
    return {"value": altitude_of(np.where(usable, of.pressure, SEA_LEVEL))[:, None]}, usable


def _simulated(config: Any, room: Any, motion: Any, turn: Any, noise: Any) -> tuple:
    return (pressure_at(SITE + motion.p[:, 2] + config.pressure_noise * noise()),)


SENSOR = Sensor(
    name="pressure",
    plural="pressures",
    stream=Pressure,
    message="sensor_msgs/msg/FluidPressure",
    fields={"fluid_pressure": 1},
    columns=lambda fields: (fields["fluid_pressure"],),
    content=lambda of: {"fluid_pressure": of.pressure},
    sound=finite,
    measured=_measured,
    simulated=_simulated,
    noise=("M", "write pressures; in metres of altitude", 0.08),
    parameters={
        "use_pressure": parameter(
            True, "use pressures of a barometer, if there are any", fixed=True
        ),
        "pressure_std": parameter(0.1, "m; noise of one pressure, as altitude", high=100.0),
        "pressure_walk": parameter(
            0.1,
            (
                "m/sqrt(s); how fast the offset of the altitude wanders: weather, prop wash, "
                "warming up"
            ),
            high=100.0,
        ),
        "pressure_drift": parameter(
            0.02, "m/s; how fast it drifts, as is known before it is measured", high=100.0
        ),
    },
    invalid="give Pa, some 1e5 on the ground",
    remedy="and shield it from wind",
    compared=Compared(
        lambda track, t: track.positions(t)[:, 2:],
        "a barometer, and ground truth of the height",
        negligible=0.05,
        floating=True,
        of_attitude=False,
    ),
)
