# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Vibration of a vehicle: first-order filters of the specific force, compiled."""

from __future__ import annotations

import numpy as np

from .compiled import compiled

VIBRATION_CORNER = 0.05  # s, time constant; faster motion counts as vibration
VIBRATION_AVERAGE = 0.3  # s, time constant of the mean power


@compiled
def low_pass(value: float, sample: float, dt: float, time_constant: float) -> float:
    """Return the output of a first-order low pass after a step of dt, s; compiled.

    Parameters
    ----------
    value : output before
    sample : input during the step
    time_constant : s
    """
    return value + min(1.0, dt / time_constant) * (sample - value)


@compiled
def track_vibration(slow: np.ndarray, power: np.ndarray, accel: np.ndarray, dt: float) -> None:
    """Update the vibration with one sample of specific force; compiled.

    Parameters
    ----------
    accel : (3,) m/s^2, body
    dt : s since the sample before
    slow : (3,) m/s^2, low pass of the specific force, updated
    power : (3,) m^2/s^4, mean square of the faster part per axis, updated
    """
    for k in range(3):
        slow[k] = low_pass(slow[k], accel[k], dt, VIBRATION_CORNER)
        power[k] = low_pass(power[k], (accel[k] - slow[k]) ** 2, dt, VIBRATION_AVERAGE)
