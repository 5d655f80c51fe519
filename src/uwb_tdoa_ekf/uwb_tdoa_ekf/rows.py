"""Measurements as the core takes them, and which of them can be measurements."""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.sensors import SENSORS, Stream

from .core.aids import STREAMS
from .core.memory import AID, IMU_SAMPLE, structured
from .core.validity import usable_all, usable_imu, usable_slopes
from .installed import Installed


def imu_rows(t: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n,) of IMU_SAMPLE, and (n,) bool: usable; of t (n,) s, gyro (n, 3) rad/s, accel (n, 3) m/s^2, body."""
    rows = structured(IMU_SAMPLE, t, gyro, accel)
    return rows, usable_imu(rows["t"], rows["gyro"], rows["accel"])


def usable_tdoas(rows: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """(n,) bool: which of (n,) of TDOA can be measurements among anchors at (N, 3) m."""
    usable = usable_all(rows["a"], rows["b"], rows["d"], rows["variance"], positions) & np.isfinite(rows["t"])
    return usable & usable_slopes(rows["slope"], rows["state"])


def aid_rows(name: str, stream: Stream, anchors: Anchors | Installed) -> tuple[np.ndarray, np.ndarray]:
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
