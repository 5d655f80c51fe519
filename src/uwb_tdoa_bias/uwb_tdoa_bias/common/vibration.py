"""How much a vehicle vibrates: first-order filters over the specific force. Compiled."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .compiled import compiled

if TYPE_CHECKING:
    import numpy as np

VIBRATION_CORNER = 0.05  # s; what is faster is vibration
VIBRATION_AVERAGE = 0.3  # s over which its power is averaged


@compiled
def low_pass(value: float, sample: float, dt: float, time_constant: float) -> float:
    """Output of a first-order low pass, dt (s) after `value`, when the input was `sample`
    meanwhile.
    """
    return value + min(1.0, dt / time_constant) * (sample - value)


@compiled
def track_vibration(slow: np.ndarray, power: np.ndarray, accel: np.ndarray, dt: float) -> None:
    """Take one sample of specific force `accel` (3,) m/s^2, dt s after the one before it.

    slow (3,) m/s^2 : its low pass; power (3,) m^2/s^4 : mean square of what is faster, per axis.
    Both are updated.
    """
    for k in range(3):
        slow[k] = low_pass(slow[k], accel[k], dt, VIBRATION_CORNER)
        power[k] = low_pass(power[k], (accel[k] - slow[k]) ** 2, dt, VIBRATION_AVERAGE)
