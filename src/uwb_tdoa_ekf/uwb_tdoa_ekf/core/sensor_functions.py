# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""State-dependent errors of the inertial sensor.

They are subtracted from each sample, evaluated at the state of the best hypothesis.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.effects.base import TABLE_STEPS, SensorFunction
from uwb_tdoa_bias.effects.covariates import OF_STATE

SENSORS = ("gyro", "accel")
# covariates with a smaller index are the position
SPEED, CLIMB_RATE = (OF_STATE.index("speed"), OF_STATE.index("climb_rate"))

SENSOR_FUNCTION = np.dtype(  # A SensorFunction as a record with the same fields.
    [
        ("sensor", np.int64),
        ("axis", np.int64),
        ("covariate", np.int64),  # this and `sensor` are indices into OF_STATE and SENSORS
        ("low", float),
        ("high", float),
        ("values", float, TABLE_STEPS + 1),
        ("periodic", np.bool_),
    ],
    align=True,
)


def rows_of(functions: Sequence[SensorFunction]) -> np.ndarray:
    """Return SensorFunctions as (k,) SENSOR_FUNCTION."""
    out = np.zeros(len(functions), SENSOR_FUNCTION)
    for row, function in zip(out, functions):
        row["sensor"], row["covariate"] = (
            SENSORS.index(function.sensor),
            OF_STATE.index(function.covariate),
        )
        for name in ("axis", "low", "high", "values", "periodic"):
            row[name] = getattr(function, name)
    return out


@compiled
def subtract(functions: np.ndarray, x: np.ndarray, sample: Record) -> None:
    """Subtract (k,) SENSOR_FUNCTION, evaluated at a nominal state x (16,), from an IMU_SAMPLE."""
    for k in range(len(functions)):
        function = functions[k]
        if function.covariate == SPEED:
            at = math.sqrt(x[3] ** 2 + x[4] ** 2 + x[5] ** 2)
        elif function.covariate == CLIMB_RATE:
            at = x[5]
        else:
            at = x[function.covariate]
        reading = sample.gyro if function.sensor == 0 else sample.accel
        reading[function.axis] -= _value(function, at)


# Return a SENSOR_FUNCTION at a covariate, by linear interpolation, rad/s or m/s^2.
@compiled
def _value(function: Record, at: float) -> float:
    place = (at - function.low) / (function.high - function.low)
    place = place - math.floor(place) if function.periodic else min(max(place, 0.0), 1.0)
    first = min(int(place * TABLE_STEPS), TABLE_STEPS - 1)
    share = place * TABLE_STEPS - first
    return (1.0 - share) * function.values[first] + share * function.values[first + 1]
