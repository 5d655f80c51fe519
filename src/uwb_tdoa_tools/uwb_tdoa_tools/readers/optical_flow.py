"""Velocity of the pixel counts of an optical flow sensor that looks down, with a range finder and a
gyroscope beside it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.sensors import Velocity

if TYPE_CHECKING:
    from uwb_tdoa_bias.foundation.flight import Imu
    from uwb_tdoa_bias.foundation.sensors.height import Height

# of one reading for 1 rad/s, median over 0425/TDOA2; 30 to 35 pixels in 41 degrees, given in
# tenths: 4.2 to 4.9
COUNTS = 4.7
READING_TIME = 0.01  # s that one reading counts over
WILD = 40.0  # counts, beyond which a reading is clipped
RATE = 25.0  # Hz of the velocities, each of the mean of some readings
STD = 0.1  # m/s; measured over 0.25 s: 0.05 to 0.11
NEAREST_RANGE = 0.2  # s to the next range, beyond which the height is not known
TURN_TIME = 0.02  # s before and after, over which the gyroscope is averaged


def velocity_of(t: np.ndarray, x: np.ndarray, y: np.ndarray, height: Height, imu: Imu) -> Velocity:
    """Velocity in the body frame, x and y, at up to 25 Hz, where a range is near and the gyroscope
    is there.

    t (n,) s, ascending; x, y (n,) counts of single readings; height : Height; imu : Imu. A sensor
    that looks down sees the ground turn and pass: with the range h along its axis, x = -COUNTS (v_y
    / h + omega_x) and y = -COUNTS (v_x / h - omega_y), the axes of the Crazyflie's flow deck
    (flowdeck_v1v2.c of its firmware).
    """
    cell = np.unique((t * RATE).astype(int), return_inverse=True)[1]
    columns = (t, *(np.clip(counts, -WILD, WILD) for counts in (x, y)))
    t, x, y = (np.bincount(cell, column) / np.bincount(cell) for column in columns)
    t = t - 0.5 * READING_TIME
    seen = np.isfinite(height.range)
    stamps, h = height.t[seen], np.interp(t, height.t[seen], height.range[seen])
    near = np.abs(
        t - stamps[np.clip(np.searchsorted(stamps, t), 1, len(stamps) - 1) - [[1], [0]]]
    ).min(axis=0)
    turns = np.cumsum(imu.gyro[:, :2] * np.gradient(imu.t)[:, None], axis=0)
    ends = [
        np.stack([np.interp(t + s, imu.t, turns[:, k]) for k in range(2)], axis=1)
        for s in (-TURN_TIME, TURN_TIME)
    ]
    rate = (ends[1] - ends[0]) / (2.0 * TURN_TIME)
    v = np.stack(
        [h * (rate[:, 1] - y / COUNTS), -h * (rate[:, 0] + x / COUNTS), np.zeros(len(t))], axis=1
    )
    known = (near < NEAREST_RANGE) & (t > imu.t[0] + TURN_TIME) & (t < imu.t[-1] - TURN_TIME)
    return Velocity(t[known], v[known], np.tile([STD, STD, np.inf], (np.count_nonzero(known), 1)))
