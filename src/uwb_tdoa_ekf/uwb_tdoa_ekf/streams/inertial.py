"""Counters of the values of an inertial stream, and what they amount to over a window."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.vibration import VIBRATION_CORNER, low_pass

from .stamps import (
    LAST,
    StampWindow,
    complete,
    count_stamp,
    new_stamps,
    restart_stamps,
    stamp_window,
)

ABSURD = 1e9  # in any unit: no number that a sensor gives

# places in the counters of one channel; the first two outlive a window
VALUE, SLOW, SUM, SQUARES, FAST, SAME, LOW, LOW_HITS, HIGH, HIGH_HITS = range(10)
# places in the counters of all six together
TAKEN, REPEATED, INVALID = range(3)


class ImuCounters(NamedTuple):
    """stamps : see stamps.py; channels (6, 10) : gyroscope x y z, accelerometer x y z; whole (3,)."""

    stamps: np.ndarray
    channels: np.ndarray
    whole: np.ndarray


class ImuWindow(NamedTuple):
    """One window of inertial samples. Rates in rad/s and specific force in m/s^2 if the driver is
    right.

    mean, deviation, vibration (6,) : of gyroscope x y z and accelerometer x y z; vibration is the
    rms of what is faster than VIBRATION_CORNER; still (6,) : share of samples that equal the one
    before, per channel;
    repeated : share of samples in which all six do; clipped (6,) : samples at the same far end of
        what the channel
    showed, and limit (6,) that end; invalid : share of samples that are no numbers.
    """

    stamps: StampWindow
    mean: np.ndarray
    deviation: np.ndarray
    vibration: np.ndarray
    still: np.ndarray
    repeated: float
    clipped: np.ndarray
    limit: np.ndarray
    invalid: float


def new_imu() -> ImuCounters:
    """ImuCounters of a stream of which nothing was received."""
    counters = ImuCounters(new_stamps(), np.zeros((6, 10)), np.zeros(3))
    counters.channels[:, :2] = np.nan
    restart_imu(counters)
    return counters


@compiled
def restart_imu(counters: ImuCounters) -> None:
    """Begin a new window."""
    restart_stamps(counters.stamps)
    counters.channels[:, SUM:] = 0.0
    counters.channels[:, LOW], counters.channels[:, HIGH] = np.inf, -np.inf
    counters.whole[:] = 0.0


@compiled
def count_imu(
    counters: ImuCounters, t: float, arrival: float, gyro: np.ndarray, force: np.ndarray
) -> bool:
    """Take one sample: stamp and arrival, s (NaN: not known); rates and specific force as the
    message has them. Returns whether the window is complete.
    """
    s, whole = counters.stamps, counters.whole
    dt = t - s[LAST]
    count_stamp(s, t, arrival)
    sample = (gyro[0], gyro[1], gyro[2], force[0], force[1], force[2])
    for k in range(6):
        if not abs(sample[k]) < ABSURD:
            whole[INVALID] += 1.0
            return complete(s)
    whole[TAKEN] += 1.0
    same = 0
    for k in range(6):
        c, value = counters.channels[k], sample[k]
        if math.isnan(c[SLOW]):
            c[SLOW] = value
        c[SLOW] = low_pass(c[SLOW], value, max(dt, 0.0), VIBRATION_CORNER)
        c[SUM] += value
        c[SQUARES] += value * value
        c[FAST] += (value - c[SLOW]) ** 2
        if value == c[VALUE]:
            c[SAME] += 1.0
            same += 1
        c[VALUE] = value
        if value < c[LOW]:
            c[LOW], c[LOW_HITS] = value, 1.0
        elif value == c[LOW]:
            c[LOW_HITS] += 1.0
        if value > c[HIGH]:
            c[HIGH], c[HIGH_HITS] = value, 1.0
        elif value == c[HIGH]:
            c[HIGH_HITS] += 1.0
    if same == 6:
        whole[REPEATED] += 1.0
    return complete(s)


@compiled
def feed_imu(
    counters: ImuCounters,
    t: np.ndarray,
    arrival: np.ndarray,
    gyro: np.ndarray,
    force: np.ndarray,
    first: int,
) -> tuple[int, bool]:
    """`count_imu` for the rows of arrays from `first` on, until a window is complete: (row after
    the last, whether it is).
    """
    for i in range(first, len(t)):
        if count_imu(counters, t[i], arrival[i], gyro[i], force[i]):
            return i + 1, True
    return len(t), False


def imu_window(counters: ImuCounters) -> ImuWindow:
    """ImuWindow of what was counted since the window began."""
    c, whole = counters.channels, counters.whole
    n = max(whole[TAKEN], 1.0)
    mean = c[:, SUM] / n
    at_low = mean - c[:, LOW] > c[:, HIGH] - mean
    return ImuWindow(
        stamps=stamp_window(counters.stamps),
        mean=mean,
        deviation=np.sqrt(np.maximum(c[:, SQUARES] / n - mean**2, 0.0)),
        vibration=np.sqrt(c[:, FAST] / n),
        still=c[:, SAME] / n,
        repeated=float(whole[REPEATED] / n),
        clipped=np.where(at_low, c[:, LOW_HITS], c[:, HIGH_HITS]),
        limit=np.where(at_low, c[:, LOW], c[:, HIGH]),
        invalid=float(whole[INVALID] / max(whole[INVALID] + whole[TAKEN], 1.0)),
    )
