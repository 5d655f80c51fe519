# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Two-way ranging: the distance to an anchor.

The difference of two successive distances is a TDOA. The filter uses such TDOAs for initialization
and recovery.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from .auxiliary import RANGE, add_offset_jacobian
from .update import project

APART = 0.2  # s; ranges with a larger time difference give no TDOA


@compiled
def pair(ekf: Record, sensor: Record) -> bool:
    """Compute a TDOA from a range and the range before, in ekf.paired.

    Return whether the TDOA is valid: two anchors, within APART.
    """
    before, made = ekf.ranged[0], ekf.paired[0]
    valid = before.anchor != sensor.anchor and sensor.t - before.t < APART
    made.t, made.a, made.b = sensor.t, before.anchor, sensor.anchor
    made.d = sensor.value[0] - before.value[0]
    made.variance = sensor.std[0] ** 2 + before.std[0] ** 2
    made.slope[:], made.state[:] = 0.0, 0.0
    ekf.ranged[0] = sensor
    return valid


@compiled
def is_repeat(ekf: Record, sensor: Record) -> bool:
    """Return whether a range repeats the range before: a driver or network has sent it twice."""
    before = ekf.ranged[0]
    return (
        before.t == sensor.t
        and before.anchor == sensor.anchor
        and before.value[0] == sensor.value[0]
    )


@compiled
def compare(
    hypothesis: Record, position: np.ndarray, sensor: Record, parameters: Record, innovation: Record
) -> None:
    """Fill in the innovation of a distance to an anchor.

    Parameters
    ----------
    hypothesis : HYPOTHESIS
        Hypothesis, predicted to the stamp of the measurement.
    position : (3,) array
        Position of the anchor, m, world frame.
    sensor : SENSOR_ROW
        Measured distance, m.
    parameters : PARAMETERS
        Tuning of the filter.
    innovation : INNOVATION
        Filled by this function.
    """
    x = hypothesis.x
    dx, dy, dz = x[0] - position[0], x[1] - position[1], x[2] - position[2]
    distance = max(math.sqrt(dx * dx + dy * dy + dz * dz), 1e-6)
    innovation.entries = 3
    for k, along in enumerate((dx, dy, dz)):
        innovation.states[k], innovation.row[k] = k, along / distance
    innovation.value = sensor.value[0] - distance
    innovation.noise_variance = parameters.range_std**2 + sensor.std[0] ** 2
    project(hypothesis.P, innovation)
    if parameters.range_offset_std > 0.0:
        P = hypothesis.offset_P
        if P[RANGE, RANGE] == 0.0:
            hypothesis.offset[RANGE], P[RANGE, RANGE] = 0.0, parameters.range_offset_std**2
        innovation.value -= hypothesis.offset[RANGE]
        add_offset_jacobian(hypothesis, innovation, RANGE)


@compiled
def keep_offset(ekf: Record, hypothesis: Record) -> None:
    """Store the range offset of an updated HYPOTHESIS if its variance is the smallest so far.

    The offset state may be removed later; the stored value remains.
    """
    variance = hypothesis.offset_P[RANGE, RANGE]
    if 0.0 < variance < ekf.range_offset[1]:
        ekf.range_offset[0], ekf.range_offset[1] = hypothesis.offset[RANGE], variance
