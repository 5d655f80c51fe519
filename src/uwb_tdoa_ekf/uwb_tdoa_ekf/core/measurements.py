# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Conversion of measurements to rows of the core, and rejection of unusable ones."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_bias.effects.samples import N_STATES

from .memory import IMU_SAMPLE, SENSOR_ROW, structured
from .sensors import STREAMS

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.anchors import Anchors
    from uwb_tdoa_bias.common.sensors import Stream

    from ..anchor_table import AnchorTable

# Limits of what can be a measurement; nothing is tuned.
MAX_RATE, MAX_ACCEL = 100.0, 1000.0  # rad/s and m/s^2, beyond the range of any inertial sensor
# largest slope of a bias (m per m or m/s), and largest state (m or m/s) of its linearization
STEEPEST, FARTHEST = 1e3, 1e6
LARGEST_ERROR = 1.0  # m by which |d_ab| may exceed the distance between anchors a and b


def imu_rows(t: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return inertial samples as rows of IMU_SAMPLE, and which samples are usable.

    Parameters
    ----------
    t : (n,) array
        Stamps, s.
    gyro : (n, 3) array
        Angular rate, rad/s, body frame.
    accel : (n, 3) array
        Specific force, m/s^2, body frame.

    Returns
    -------
    tuple
        (n,) IMU_SAMPLE, and (n,) bool.
    """
    rows = structured(IMU_SAMPLE, t, gyro, accel)
    return rows, _usable_imu(rows)


@compiled
def usable_tdoas(rows: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return (n,) bool: which TDOAs can be measurements.

    Refused are an unknown anchor (row -1), a pair of equal anchors, a value that is not finite, an
    invalid variance, a value longer than the baseline plus LARGEST_ERROR, and an implausible slope
    of the bias.

    Parameters
    ----------
    rows : (n,) TDOA
        TDOAs.
    positions : (N, 3) array
        Positions of the anchors, m, world frame.
    """
    out = np.empty(len(rows), np.bool_)
    for i in range(len(rows)):
        tdoa = rows[i]
        a, b, d = tdoa.a, tdoa.b, tdoa.d
        usable = a >= 0 and b >= 0 and a != b and math.isfinite(tdoa.t) and math.isfinite(d)
        if usable:
            square = 0.0
            for k in range(3):
                square += (positions[a, k] - positions[b, k]) ** 2
            longest = math.sqrt(square) + LARGEST_ERROR
            usable = abs(d) <= longest and 0.0 <= tdoa.variance < math.inf
        for k in range(N_STATES):  # NaN compares false
            usable = usable and abs(tdoa.slope[k]) < STEEPEST and abs(tdoa.state[k]) < FARTHEST
        out[i] = usable
    return out


def sensor_rows(
    name: str, stream: Stream, anchors: Anchors | AnchorTable
) -> tuple[np.ndarray, np.ndarray]:
    """Return the measurements of a sensor as rows of SENSOR_ROW, and which are usable.

    Parameters
    ----------
    name : str
        Name of the sensor in SENSORS.
    stream : Stream
        Measurements of the sensor.
    anchors : Anchors or AnchorTable
        Gives the rows of anchor ids.

    Returns
    -------
    tuple
        (n,) SENSOR_ROW, and (n,) bool.
    """
    columns, usable = SENSORS[name].measured(stream)
    rows = np.zeros(len(stream), SENSOR_ROW)
    rows["t"], rows["kind"] = stream.t, STREAMS.index(name)
    if "anchor" in columns:
        columns["anchor"] = anchors.index(columns["anchor"])
        usable &= columns["anchor"] >= 0
    for field, values in columns.items():
        target = rows[field]
        target[(slice(None), *map(slice, values.shape[1:]))] = values
    return rows, usable & np.isfinite(stream.t)


@compiled
def _usable_imu(rows: np.ndarray) -> np.ndarray:
    """Return (n,) bool: which of (n,) IMU_SAMPLE are finite and within the range of any sensor."""
    out = np.empty(len(rows), np.bool_)
    for i in range(len(rows)):
        sample = rows[i]
        out[i] = math.isfinite(sample.t)
        for k in range(3):  # NaN compares false
            out[i] = out[i] and abs(sample.gyro[k]) < MAX_RATE and abs(sample.accel[k]) < MAX_ACCEL
    return out
