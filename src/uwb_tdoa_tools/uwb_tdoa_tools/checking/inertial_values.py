"""What the values of inertial samples tell by themselves, over a whole flight."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_ekf.streams import WARNING, Finding
from uwb_tdoa_ekf.streams.inertial_rules import AXES

if TYPE_CHECKING:
    from collections.abc import Iterator

    from uwb_tdoa_bias.foundation.flight import Flight

HITS, MORE, NEXT = (
    20,
    5.0,
    5,
)  # samples at one end, and times as many as have each of the values next to it; healthy 1
# s, and times the least that the square of a step can be over that of the change in that time.
# Healthy 2.9 at least, but for a
# log of 0607, which is smooth, and fits its ground truth; behind a low pass of 50 ms 2.4.
FAR, EVEN = 0.02, 2.6
FEWEST = 10  # samples within FAR, without which nothing is said


def saturated(flight: Flight) -> Iterator[Finding]:
    """An axis with many samples at its largest or smallest value, far more than next to it.

    Takes a Flight, yields Findings.
    """
    assert flight.imu is not None
    for name, column in zip(AXES, np.column_stack([flight.imu.gyro, flight.imu.accel]).T):
        values, counts = np.unique(column, return_counts=True)
        for ends, hits in ((values, counts), (values[::-1], counts[::-1])):
            if len(ends) > NEXT and hits[0] >= HITS and hits[0] > MORE * hits[1 : 1 + NEXT].mean():
                evidence = (
                    f"{hits[0]} samples of {ends[0]:.2f}, {hits[1 : 1 + NEXT].mean():.0f} of each "
                    "of the next values"
                )
                remedy = "set the sensor to a larger range"
                yield Finding(
                    "imu_clipped", WARNING, f"{name} is clipped", evidence, remedy, float(ends[0])
                )
                return


def smooth(t: np.ndarray, values: np.ndarray) -> bool:
    """Whether what a sensor reads, (n, 3) at t (n,) s, changes so evenly, on all axes, as only
    behind a low pass: the square of a step over that of the change in FAR is 1/k^2 at least, k
    steps being that long. False of a slow sensor, of which nobody can tell.
    """
    steps = round(FAR / max(np.median(np.diff(t)), 1e-6))
    if steps < FEWEST or len(t) <= steps:
        return False
    one, far = (
        np.mean(np.diff(values, axis=0) ** 2, axis=0),
        np.mean((values[steps:] - values[:-steps]) ** 2, axis=0),
    )
    return bool((one * steps**2 < EVEN * far).all())
