# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Conversion of measurements to rows of the core, and rejection of unusable ones."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.sensors import SENSORS

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
    return rows, usable_imu(rows["t"], rows["gyro"], rows["accel"])


def usable_tdoas(rows: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return (n,) bool: which TDOAs can be measurements.

    rows is (n,) TDOA, positions are the anchors (N, 3), m, world frame.
    """
    usable = usable_all(rows["a"], rows["b"], rows["d"], rows["variance"], positions) & np.isfinite(
        rows["t"]
    )
    return usable & usable_slopes(rows["slope"], rows["state"])


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
def usable(a: int, b: int, d: float, variance: float, positions: np.ndarray) -> bool:
    """Return whether a TDOA can be a measurement.

    An unknown anchor (row -1), a pair of equal anchors, and a value that is not finite are refused.
    A value longer than the baseline plus LARGEST_ERROR and an invalid variance are refused too.

    Parameters
    ----------
    a, b : int
        Rows of the anchors.
    d : float
        Difference of the distances to b and a, m.
    variance : float
        Variance beyond tdoa_std, m^2.
    positions : (N, 3) array
        Positions of the anchors, m, world frame.
    """
    if a < 0 or b < 0 or a == b or not (math.isfinite(d) and 0.0 <= variance < math.inf):
        return False
    baseline = 0.0
    for k in range(3):
        baseline += (positions[a, k] - positions[b, k]) ** 2
    return abs(d) <= math.sqrt(baseline) + LARGEST_ERROR


@compiled
def usable_all(
    a: np.ndarray, b: np.ndarray, d: np.ndarray, variance: np.ndarray, positions: np.ndarray
) -> np.ndarray:
    """Return `usable` for (n,) arrays, as (n,) bool."""
    out = np.empty(len(d), np.bool_)
    for i in range(len(d)):
        out[i] = usable(a[i], b[i], d[i], variance[i], positions)
    return out


@compiled
def usable_slopes(slope: np.ndarray, state: np.ndarray) -> np.ndarray:
    """Return (n,) bool: whether the state dependence of a bias is plausible.

    slope is (n, 6), in m per m or m per m/s. state is its linearization point (n, 6), m or m/s.
    """
    out = np.ones(len(slope), np.bool_)
    for i in range(len(slope)):
        for k in range(slope.shape[1]):  # NaN compares false
            out[i] = out[i] and abs(slope[i, k]) < STEEPEST and abs(state[i, k]) < FARTHEST
    return out


@compiled
def usable_imu(t: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> np.ndarray:
    """Return (n,) bool: which samples are finite and within the range of any inertial sensor.

    t is (n,) s, gyro (n, 3) rad/s, and accel (n, 3) m/s^2, both in the body frame.
    """
    out = np.empty(len(t), np.bool_)
    for i in range(len(t)):
        out[i] = math.isfinite(t[i])
        for k in range(3):  # NaN compares false
            out[i] = out[i] and abs(gyro[i, k]) < MAX_RATE and abs(accel[i, k]) < MAX_ACCEL
    return out
