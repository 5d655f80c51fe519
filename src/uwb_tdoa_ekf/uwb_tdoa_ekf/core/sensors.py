# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Dispatch the measurements of all sensors except IMU and TDOA to their modules.

The update of a sensor is `observe` in the module of its name, e.g. height.py. A SENSOR_ROW is a
single measurement by a sensor of `SENSORS`.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.util import find_spec
from inspect import signature

import numpy as np

from uwb_tdoa_bias.common.callees import OURS
from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.sensors import SENSORS

Update = Callable[[Record, Record, Record, Record, np.ndarray], None]  # `observe` of a sensor
ARGUMENTS = "ekf", "parameters", "sensor", "residual", "records"  # of `observe`

STREAMS = tuple(SENSORS)  # names of the sensors; SENSOR_ROW.kind is an index into them
# kinds that engine.py names
HEIGHT, VELOCITY, RANGE = map(STREAMS.index, ("height", "velocity", "range"))


def _update_of(name: str) -> Update:
    """Return `observe` of the module of a sensor."""
    place = f"{__package__}.{name}"
    if find_spec(place) is None or not hasattr(import_module(place), "observe"):
        raise NotImplementedError(
            f"the filter has no branch for {name} of SENSORS: write the compiled function `observe` "
            f"in the module {place}; docs/add_sensor.md describes it."
        )
    update: Update = import_module(place).observe
    _check(place, update)
    return update


def _check(place: str, update: Update) -> None:
    """Raise NotImplementedError if `observe` of a module cannot be called by compiled code."""
    arguments = signature(getattr(update, "py_func", update)).parameters
    if not getattr(update, OURS, False) or len(arguments) != len(ARGUMENTS):
        raise NotImplementedError(
            f"`observe` of {place} must be @compiled, with the arguments {', '.join(ARGUMENTS)}; "
            "docs/add_sensor.md describes it."
        )


def _with_branch(kind: int, update: Update, otherwise: Update) -> Update:
    """Return a dispatch that calls `update` for measurements of a kind, and `otherwise` for others.

    Compiled code calls no table of functions, but it calls functions of a closure.
    """

    @compiled
    def dispatch(
        ekf: Record, parameters: Record, sensor: Record, residual: Record, records: np.ndarray
    ) -> None:
        if sensor.kind == kind:
            update(ekf, parameters, sensor, residual, records)
        else:
            otherwise(ekf, parameters, sensor, residual, records)

    return dispatch


@compiled
def _refuse(
    ekf: Record, parameters: Record, sensor: Record, residual: Record, records: np.ndarray
) -> None:
    raise NotImplementedError("a kind of measurement without a branch in sensors.observe")


_dispatch: Update = _refuse
for _kind in reversed(range(len(STREAMS))):
    if _kind != RANGE:  # engine.py has the branch of ranges
        _dispatch = _with_branch(_kind, _update_of(STREAMS[_kind]), _dispatch)


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
    _dispatch(ekf, parameters, sensor, residual, records)
