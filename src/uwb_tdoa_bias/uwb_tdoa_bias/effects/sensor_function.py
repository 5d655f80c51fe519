"""What an inertial sensor reads beside the truth, as a function of where the filter is: a table
that compiled code looks up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable

STEPS = 256  # of a table


@dataclass(frozen=True, eq=False)
class SensorFunction:
    """sensor : "gyro" or "accel"; axis : 0 to 2, of the body; covariate : one of OF_STATE; low,
    high : of it; values (STEPS + 1,) rad/s or m/s^2, evenly between them, held constant beyond;
    periodic : it goes on beyond them instead.
    """

    sensor: str
    axis: int
    covariate: str
    low: float
    high: float
    values: np.ndarray
    periodic: bool = False

    @classmethod
    def of(
        cls,
        function: Callable[[np.ndarray], np.ndarray],
        channel: str,
        covariate: str,
        low: float,
        high: float,
        periodic: bool = False,
    ) -> SensorFunction:
        """Of a function of the covariate, (n,) to (n,); channel : "gyro.x" ... "accel.z"."""
        sensor, _, axis = channel.partition(".")
        return cls(
            sensor,
            "xyz".index(axis),
            covariate,
            low,
            high,
            function(np.linspace(low, high, STEPS + 1)),
            periodic,
        )
