"""The flights that are measured with: simulated, 1 kHz IMU and 400 Hz TDOA."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TYPE_CHECKING

import numpy as np

from uwb_tdoa_ekf.results import rows_of

from ..calibrating.parts import between
from ..simulation import SimulationConfig, simulate

if TYPE_CHECKING:
    from uwb_tdoa_bias.foundation.flight import Flight

SHORTEST = 16.0  # s that the simulation needs to take off and land
TDOA_RATE = 400.0  # Hz


def make_flight(seconds: float, anchors: int = 8, tdoa_rate: float = TDOA_RATE, **more: Any) -> Flight:
    """A Flight of at least `seconds` among so many anchors; tdoa_rate : Hz; more : of SimulationConfig. Its first `seconds`
    count."""
    room = "corners" if anchors == 8 else f"random-1-{anchors}"
    flight = simulate(SimulationConfig(seed=1, constellation=room, duration=max(seconds, SHORTEST), **more))
    return first(thinned(flight, tdoa_rate), seconds)


def thinned(flight: Flight, rate: float) -> Flight:
    """The flight with `rate` of its TDOAs, Hz, evenly left out."""
    assert flight.imu is not None
    duration = flight.imu.t[-1] - flight.imu.t[0]
    kept = np.linspace(0, len(flight.tdoa) - 1, min(len(flight.tdoa), round(rate * duration))).astype(int)
    return replace(flight, tdoa=rows_of(flight.tdoa, kept))


def first(flight: Flight, seconds: float) -> Flight:
    """Its first seconds."""
    assert flight.imu is not None
    return replace(between(flight, -np.inf, flight.imu.t[0] + seconds), extra=flight.extra)
