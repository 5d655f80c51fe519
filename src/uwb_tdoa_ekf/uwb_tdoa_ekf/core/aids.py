"""What a tag feels beside inertia and TDOAs: one AID is one measurement of one of the SENSORS."""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.sensors import SENSORS

from . import barometer, height, velocity

STREAMS = tuple(SENSORS)  # by kind
HEIGHT, PRESSURE, VELOCITY, RANGE = map(STREAMS.index, ("height", "pressure", "velocity", "range"))


@compiled
def observe(
    ekf: Record, parameters: Record, aid: Record, residual: Record, records: np.ndarray
) -> None:
    """Take one of AID into a running filter that has been predicted to its stamp; fills one of
    RESIDUAL.
    """
    if aid.kind == HEIGHT:
        height.observe(ekf, parameters, aid, residual, records)
    elif aid.kind == PRESSURE:
        barometer.observe(ekf, parameters, aid, residual, records)
    else:
        velocity.observe(ekf, parameters, aid, residual, records)


@compiled
def record(ekf: Record, aid: Record) -> None:
    """Take one of AID while the filter does not run."""
    if aid.kind == HEIGHT:
        height.record(ekf, aid)
