# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The simulated flights of the measurements: 1 kHz IMU and 400 Hz TDOA."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_ekf.results import rows_of
from uwb_tdoa_tools.calibrating import between
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.flight import Flight

SHORTEST = 16.0  # s that the simulation needs to take off and land
TDOA_RATE = 400.0  # Hz
FAR, SPACING, ROW = 1000.0, 8.0, 125  # m, m, anchors: positions of anchors out of radio range


def make_flight(
    seconds: float, anchors: int = 8, tdoa_rate: float = TDOA_RATE, **more: Any
) -> Flight:
    """A Flight of at least `seconds` among so many anchors; tdoa_rate : Hz; more : of
    SimulationConfig. Its first `seconds` count.
    """
    room = "corners" if anchors == 8 else f"random-1-{anchors}"
    flight = simulate(
        SimulationConfig(seed=1, constellation=room, duration=max(seconds, SHORTEST), **more)
    )
    return first(thinned(flight, tdoa_rate), seconds)


def among(flight: Flight, installed: int) -> Flight:
    """Return the flight with `installed` anchors. The added ones stand in rows of another hall, out
    of radio range.
    """
    beyond = np.arange(installed - len(flight.anchors))
    far = np.column_stack(
        [FAR + SPACING * (beyond % ROW), SPACING * (beyond // ROW), np.full(len(beyond), 4.0)]
    )
    own = flight.anchors
    ids = np.concatenate([own.ids, max(own.ids) + 1 + beyond])
    orientations = np.concatenate([own.orientations, np.full((len(beyond), 4), np.nan)])
    return replace(flight, anchors=Anchors(ids, np.concatenate([own.positions, far]), orientations))


def thinned(flight: Flight, rate: float) -> Flight:
    """The flight with `rate` of its TDOAs, Hz, evenly left out."""
    assert flight.imu is not None
    duration = flight.imu.t[-1] - flight.imu.t[0]
    kept = np.linspace(
        0, len(flight.tdoa) - 1, min(len(flight.tdoa), round(rate * duration))
    ).astype(int)
    return replace(flight, tdoa=rows_of(flight.tdoa, kept))


def first(flight: Flight, seconds: float) -> Flight:
    """Its first seconds."""
    assert flight.imu is not None
    return replace(between(flight, -np.inf, flight.imu.t[0] + seconds), extra=flight.extra)
