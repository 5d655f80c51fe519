"""Convert log variables of a Crazyflie, as crazyswarm2 passes them on, to TDOAs and IMU samples.

    block = LogBlock(["tdoa2.d7-0", "tdoa2.d0-1", "acc.x", ...], PERIOD)
    measured = block.take(message.timestamp, message.values)  # of a
    crazyflie_interfaces/LogDataGeneric
    stamp = clock.stamp(t, arrival)                           # one VehicleClock per vehicle

A variable holds its last value. It is sampled when the block is sent, and repeats until a new value
arrives. On average it is half a period old. Nothing here needs ROS.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import numpy as np

from .readers.streams import GRAVITY

if TYPE_CHECKING:
    from collections.abc import Sequence

PERIOD = 0.01  # s, the shortest of a log block
RATES, FORCES = [f"gyro.{axis}" for axis in "xyz"], [f"acc.{axis}" for axis in "xyz"]  # deg/s, g
DRIFT = 1e-3  # s/s by which the clock of a vehicle may run away from ours
_PAIR = re.compile(r"tdoa2\.d([0-7])-([0-7])")


class LogBlock:
    """One log block: its variables in their order."""

    def __init__(self, variables: Sequence[str], period: float = PERIOD) -> None:
        """Keep the names of the log variables; others than TDOAs, acc and gyro are ignored.

        Parameters
        ----------
        period : s, of the block.
        """
        found = [(place, _PAIR.fullmatch(name)) for place, name in enumerate(variables)]
        self._pairs = [(place, int(match[1]), int(match[2])) for place, match in found if match]
        there, needed = list(variables), [*RATES, *FORCES]
        self._inertial = (
            [there.index(name) for name in needed] if set(needed) <= set(there) else None
        )
        self._age = 0.5 * period
        self._last: dict[int, float] = {}

    def take(
        self, timestamp: float, values: Sequence[float] | np.ndarray
    ) -> tuple[list[tuple[float, int, int, float]], tuple[float, np.ndarray, np.ndarray] | None]:
        """Return ([(t, a, b, d)], (t, gyro (3,), accel (3,)) or None) of one message.

        A value that is 0 (not received yet), not finite, or unchanged is not a measurement.

        Parameters
        ----------
        timestamp : ms of the vehicle's clock.
        values : of the variables.

        Returns
        -------
        t in s of the vehicle's clock; d in m with the sign of uwb_tdoa_msgs/Tdoa (the firmware's
        distanceDiff of the pair A, B is |p - B| - |p - A|); gyro in rad/s, accel in m/s^2.
        """
        t, tdoas = 1e-3 * timestamp, []
        for place, a, b in self._pairs:
            d = float(values[place])
            if d != self._last.get(place, 0.0) and np.isfinite(d):
                tdoas.append((t - self._age, a, b, d))
            self._last[place] = d
        if self._inertial is None:
            return tdoas, None
        sample = np.array([values[place] for place in self._inertial], dtype=float)
        return tdoas, (t, np.deg2rad(sample[:3]), GRAVITY * sample[3:])


class VehicleClock:
    """The vehicle's clock relative to ours.

    The smallest delay of a message determines the offset.
    """

    def __init__(self) -> None:
        self._offset, self._at = np.inf, 0.0

    def stamp(self, t: float, arrival: float) -> float:
        """Return t, s of the vehicle's clock, in s of our clock.

        `arrival` is the arrival of the message, s of our clock.
        """
        self._offset = min(self._offset + DRIFT * max(arrival - self._at, 0.0), arrival - t)
        self._at = arrival
        return t + self._offset
