"""Measurements as the core takes them, and which of them cannot be any."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.sensors import SENSORS

from .aids import STREAMS
from .memory import AID, IMU_SAMPLE, structured

if TYPE_CHECKING:
    from uwb_tdoa_bias.common.anchors import Anchors
    from uwb_tdoa_bias.common.sensors import Stream

    from ..anchor_table import AnchorTable

MAX_RATE, MAX_ACCEL = 100.0, 1000.0  # rad/s, m/s^2: beyond what any inertial sensor reads
STEEPEST, FARTHEST = 1e3, 1e6  # m per m or m/s, and m or m/s, of what a bias changes with
LARGEST_ERROR = 1.0  # m by which |d_ab| may exceed the distance between a and b


def imu_rows(t: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) of IMU_SAMPLE, and (n,) bool: usable; of t (n,) s, gyro (n, 3) rad/s, accel (n, 3)
    m/s^2, body.
    """
    rows = structured(IMU_SAMPLE, t, gyro, accel)
    return rows, usable_imu(rows["t"], rows["gyro"], rows["accel"])


def usable_tdoas(rows: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """(n,) bool: which of (n,) of TDOA can be measurements among anchors at (N, 3) m."""
    usable = usable_all(rows["a"], rows["b"], rows["d"], rows["variance"], positions) & np.isfinite(
        rows["t"]
    )
    return usable & usable_slopes(rows["slope"], rows["state"])


def aid_rows(
    name: str, stream: Stream, anchors: Anchors | AnchorTable
) -> tuple[np.ndarray, np.ndarray]:
    """(n,) of AID, and (n,) bool: usable; of the Stream of a sensor among Anchors."""
    columns, usable = SENSORS[name].measured(stream)
    rows = np.zeros(len(stream), AID)
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
    """False for an unknown anchor (row -1), a pair of one anchor, a value not finite or longer than
    the baseline, a variance that is none.

    a, b : anchor rows; d : m; variance : m^2; positions : (N, 3) m.
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
    """`usable` for (n,) arrays: (n,) bool."""
    out = np.empty(len(d), np.bool_)
    for i in range(len(d)):
        out[i] = usable(a[i], b[i], d[i], variance[i], positions)
    return out


@compiled
def usable_slopes(slope: np.ndarray, state: np.ndarray) -> np.ndarray:
    """(n,) bool: whether a bias can change with the state by a slope (n, 6), m per m or m/s, about
    a state (n, 6), m or m/s.
    """
    out = np.ones(len(slope), np.bool_)
    for i in range(len(slope)):
        for k in range(slope.shape[1]):  # NaN is not below anything
            out[i] = out[i] and abs(slope[i, k]) < STEEPEST and abs(state[i, k]) < FARTHEST
    return out


@compiled
def usable_imu(t: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> np.ndarray:
    """(n,) bool: finite and within the range of any sensor. t (n,) s; gyro (n, 3) rad/s, accel (n,
    3) m/s^2.
    """
    out = np.empty(len(t), np.bool_)
    for i in range(len(t)):
        out[i] = math.isfinite(t[i])
        for k in range(3):  # NaN is not below anything
            out[i] = out[i] and abs(gyro[i, k]) < MAX_RATE and abs(accel[i, k]) < MAX_ACCEL
    return out
