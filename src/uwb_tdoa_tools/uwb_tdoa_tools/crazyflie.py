# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Convert log variables of a Crazyflie to TDOAs, samples of the IMU, heights and pressures.

    block = LogBlock(["tdoa2.d7-0", "tdoa2.d0-1", "acc.x", ...], PERIOD)
    tdoas, sample = block.take(timestamp, values)   # of a crazyflie_interfaces/LogDataGeneric
    stamp = clock.stamp(t, arrival)                 # one VehicleClock per vehicle

A variable holds its last value. It is sampled when the block is sent, and repeats until a new value
arrives. On average it is half a period old. Nothing here needs ROS.
"""

from __future__ import annotations

from collections.abc import Sequence
import re

import numpy as np

from .readers.streams import GRAVITY, NO_TARGET

PERIOD = 0.01  # s, the shortest of a log block
RATES, FORCES = [f"gyro.{axis}" for axis in "xyz"], [f"acc.{axis}" for axis in "xyz"]  # deg/s, g
DRIFT = 1e-3  # s/s by which the clock of a vehicle may run away from ours
WRAP = 2**24 * 1e-3  # s after which the time of a log block, 24 bits of ms, begins again
LATEST = 1.0  # s by which the time of a vehicle falls back only if it was started again
HEIGHT, PRESSURE = "range.zrange", "baro.pressure"  # mm, mbar
PAIRS = [f"tdoa2.d{(k + 7) % 8}-{k}" for k in range(8)]
# {stream: ({variable: type on the link}, period in s)}: one log block each, of 26 bytes at most.
# Half floats of TDOAs are exact to 4 mm. A sensor of 40 Hz loses nothing at 50 Hz.
BLOCKS: dict[str, tuple[dict[str, str], float]] = {
    "tdoa": (dict.fromkeys(PAIRS, "FP16"), PERIOD),
    "imu": (dict.fromkeys([*RATES, *FORCES], "float"), PERIOD),
    "height": ({HEIGHT: "uint16_t"}, 2 * PERIOD),
    "pressure": ({PRESSURE: "float"}, 2 * PERIOD),
}
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
        self._sensors = {
            stream: there.index(name)
            for stream, name in (("height", HEIGHT), ("pressure", PRESSURE))
            if name in there
        }
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
            if self._is_new(place, d):
                tdoas.append((t - self._age, a, b, d))
        if self._inertial is None:
            return tdoas, None
        sample = np.array([values[place] for place in self._inertial], dtype=float)
        return tdoas, (t, np.deg2rad(sample[:3]), GRAVITY * sample[3:])

    def take_sensors(
        self, timestamp: float, values: Sequence[float] | np.ndarray
    ) -> list[tuple[str, float, float]]:
        """Return [(stream, t, value)] of one message; arguments and t as of `take`.

        height : m, inf if the range finder saw nothing; pressure : Pa.
        """
        found = []
        for stream, place in self._sensors.items():
            value = float(values[place])
            if self._is_new(place, value):
                if stream == "height":
                    value = 1e-3 * value if 1e-3 * value < NO_TARGET else np.inf
                else:
                    value = 100.0 * value
                found.append((stream, 1e-3 * timestamp - self._age, value))
        return found

    def _is_new(self, place: int, value: float) -> bool:
        before, self._last[place] = self._last.get(place, 0.0), value
        return value != before and bool(np.isfinite(value))


class VehicleClock:
    """The vehicle's clock relative to ours.

    The smallest delay of a message determines the offset. If the time of the vehicle wraps, it
    continues; if the vehicle was started again, the offset is found again.
    """

    def __init__(self) -> None:
        self._offset, self._at, self._newest = np.inf, 0.0, -np.inf

    def stamp(self, t: float, arrival: float) -> float:
        """Return t, s of the vehicle's clock, in s of our clock.

        `arrival` is the arrival of the message, s of our clock.
        """
        self._offset += DRIFT * max(arrival - self._at, 0.0)
        self._at = arrival
        if np.isfinite(self._offset):
            t += WRAP * round((arrival - self._offset - t) / WRAP)
        if t < self._newest - LATEST:
            self._offset, self._newest = np.inf, -np.inf
        self._newest = max(self._newest, t)
        self._offset = min(self._offset, arrival - t)
        return t + self._offset
