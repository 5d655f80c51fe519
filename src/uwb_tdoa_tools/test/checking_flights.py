# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulated recordings for the tests of `check`: healthy, and quick to try."""

from functools import cache

from mistakes import arriving

from uwb_tdoa_tools.checking.recording import of_flight
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

# TDOA errors of a calibrated installation. The vehicle turns: each gyroscope axis measures
# something.
QUICK = dict(
    duration=18.0,
    imu_rate=400.0,
    truth_rate=50.0,
    yaw="rotating",
    yaw_rate=0.4,
    speed=1.2,
    floor_time=2.0,
)
RATE = 200.0  # TDOAs a second. A tag hears twice as many, and trials would take twice as long.


@cache
def recording(seed=0, live=False, **config):
    """Return the Recording of a simulated flight."""
    made = of_flight(simulate(SimulationConfig(seed=seed, **{**QUICK, **config})))
    return arriving(made, seed) if live else made


def sparse_recording(seed=0, **config):
    """Return the Recording of a simulated flight with RATE TDOAs a second."""
    return recording(seed, **{"tdoa_rate": RATE, **config})
