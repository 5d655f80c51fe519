# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Barometer: its altitude is the height of the body plus an offset that wanders and drifts.

Offset and drift are auxiliary states, see auxiliary.py.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from .auxiliary import PRESSURE, PRESSURE_DRIFT, RANGE, add_offset_jacobian
from .height import GATE, MEMORY
from .hypotheses import alive
from .memory import REJECTED, fill_residual
from .update import kalman_robust, project

# Set on the six flights of 0425/TDOA2, see docs/notebook/auxiliary_sensors.md.
AVERAGE = 3.0  # s over which innovations are averaged to inflate the random walk of the offset
UNTRIED, WORST = 10.0, 100.0  # standard deviations: initial and largest inflation


@compiled
def observe(
    ekf: Record, parameters: Record, sensor: Record, residual: Record, records: np.ndarray
) -> None:
    """Update a running filter with the altitude of a barometer.

    The altitude is computed from the pressure in the standard atmosphere, in m.

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
    """
    barometer, innovation, altitude = ekf.barometer, ekf.innovation, sensor.value[0]
    dt = min(max(sensor.t - barometer.heard, 0.0), AVERAGE)
    barometer.heard = sensor.t
    excess = max(1.0, barometer.nis)
    anew = sensor.t - barometer.agreed > MEMORY
    for h in range(len(ekf.hypotheses)):
        hypothesis = ekf.hypotheses[h]
        if not alive(hypothesis):
            continue
        if anew or hypothesis.offset_P[PRESSURE, PRESSURE] == 0.0:
            _take_anew(hypothesis, altitude, parameters)
            continue
        hypothesis.offset_P[PRESSURE, PRESSURE] += dt * excess * parameters.pressure_walk**2
        _compare(hypothesis, altitude, parameters, innovation)
        total = innovation.prior_variance + innovation.noise_variance
        normalized = innovation.value / math.sqrt(total)
        w = 0.0
        if abs(normalized) < GATE:
            w = kalman_robust(hypothesis, innovation, 1.0, GATE)
        if h == ekf.best:
            step = min(1.0, dt / AVERAGE)
            barometer.nis += step * (min(normalized**2, GATE**2) * excess - barometer.nis)
            barometer.nis = min(barometer.nis, WORST**2)
            fill_residual(residual, innovation, w)
            if w > 0.0:
                barometer.agreed = sensor.t
    if anew:
        barometer.agreed, barometer.nis = sensor.t, UNTRIED**2
        residual.weight, residual.verdict = 0.0, REJECTED


@compiled
def _compare(hypothesis: Record, altitude: float, parameters: Record, innovation: Record) -> None:
    """Fill in the innovation of an altitude (m) for a HYPOTHESIS with its offset."""
    innovation.entries, innovation.states[0], innovation.row[0] = 1, 2, 1.0
    innovation.value = altitude - hypothesis.x[2] - hypothesis.offset[PRESSURE]
    innovation.noise_variance = parameters.pressure_std**2
    project(hypothesis.P, innovation)
    add_offset_jacobian(hypothesis, innovation, PRESSURE)


@compiled
def _take_anew(hypothesis: Record, altitude: float, parameters: Record) -> None:
    """Initialize the offset and drift of a HYPOTHESIS from an altitude, in m."""
    hypothesis.offset[PRESSURE], hypothesis.offset[PRESSURE_DRIFT] = altitude - hypothesis.x[2], 0.0
    cross, P = hypothesis.offset_cross, hypothesis.offset_P
    cross[PRESSURE], cross[PRESSURE_DRIFT] = -hypothesis.P[2], 0.0
    P[:RANGE, :] = 0.0
    P[:, :RANGE] = 0.0
    P[PRESSURE, PRESSURE] = hypothesis.P[2, 2] + parameters.pressure_std**2
    P[PRESSURE_DRIFT, PRESSURE_DRIFT] = parameters.pressure_drift**2
    P[PRESSURE, RANGE] = P[RANGE, PRESSURE] = -cross[RANGE, 2]
