# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Dispatch the measurements of all sensors except IMU and TDOA to their modules.

A SENSOR_ROW is a single measurement by a sensor of `SENSORS`.
"""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.sensors import SENSORS

from . import barometer, height, velocity

STREAMS = tuple(SENSORS)  # names of the sensors; SENSOR_ROW.kind is an index into them
# sensors with a branch in `observe`; engine.py has the branch of ranges
BRANCHES = "height", "pressure", "velocity", "range"
_missing = set(STREAMS) - set(BRANCHES)
if _missing:
    raise NotImplementedError(
        f"the filter has no branch for {', '.join(sorted(_missing))} of SENSORS: add the name to "
        f"BRANCHES in {__name__}, and a branch to `observe` there."
    )
HEIGHT, PRESSURE, VELOCITY, RANGE = map(STREAMS.index, BRANCHES)


@compiled
def observe(
    ekf: Record, parameters: Record, sensor: Record, residual: Record, records: np.ndarray
) -> None:
    """Update a running filter with a measurement of a sensor.

    Ranges are handled in engine.py. The filter must have been predicted to the stamp of the
    measurement.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    parameters : PARAMETERS
        Tuning of the filter.
    sensor : SENSOR_ROW
        Measurement.
    residual : RESIDUAL
        Filled by this function.
    records : (n,) RECORD
        History for the smoother; empty for no recording.

    Raises
    ------
    NotImplementedError
        If no branch is for the kind of the measurement.
    """
    if sensor.kind == HEIGHT:
        height.observe(ekf, parameters, sensor, residual, records)
    elif sensor.kind == PRESSURE:
        barometer.observe(ekf, parameters, sensor, residual, records)
    elif sensor.kind == VELOCITY:
        velocity.observe(ekf, parameters, sensor, residual, records)
    else:
        raise NotImplementedError("a kind of measurement without a branch in sensors.observe")
