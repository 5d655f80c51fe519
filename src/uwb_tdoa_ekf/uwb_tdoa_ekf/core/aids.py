"""Dispatch the measurements of all sensors except IMU and TDOA to their modules.

An AID is a single measurement by a sensor of `SENSORS`.
"""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.sensors import SENSORS

from . import barometer, height, velocity

STREAMS = tuple(SENSORS)  # names of the sensors; AID.kind is an index into them
HEIGHT, PRESSURE, VELOCITY, RANGE = map(STREAMS.index, ("height", "pressure", "velocity", "range"))


@compiled
def observe(
    ekf: Record, parameters: Record, aid: Record, residual: Record, records: np.ndarray
) -> None:
    """Update a running filter with a height, an altitude or a velocity.

    Ranges are handled in engine.py. The filter must have been predicted to the stamp of the
    measurement.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    parameters : PARAMETERS
        Tuning of the filter.
    aid : AID
        Measurement.
    residual : RESIDUAL
        Filled by this function.
    records : (n,) RECORD
        History for the smoother; empty for no recording.
    """
    if aid.kind == HEIGHT:
        height.observe(ekf, parameters, aid, residual, records)
    elif aid.kind == PRESSURE:
        barometer.observe(ekf, parameters, aid, residual, records)
    else:
        velocity.observe(ekf, parameters, aid, residual, records)


@compiled
def record(ekf: Record, aid: Record) -> None:
    """Store an AID that arrives while the filter does not run."""
    if aid.kind == HEIGHT:
        height.record(ekf, aid)
