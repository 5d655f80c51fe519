"""Two-way ranging: the distance to an anchor.

Two distances, one after the other, are a TDOA: by such TDOAs the filter starts, and finds a tag
again that it has lost.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from .auxiliary import RANGE, add_offset_jacobian
from .update import project

APART = 0.2  # s; two ranges that are further apart are no TDOA


@compiled
def pair(ekf: Record, aid: Record) -> bool:
    """Make the TDOA of a range, one of AID, and the one before; returns whether they are one."""
    before, made = ekf.ranged[0], ekf.paired[0]
    apart = before.anchor != aid.anchor and aid.t - before.t < APART
    made.t, made.a, made.b, made.d = (
        aid.t,
        before.anchor,
        aid.anchor,
        aid.value[0] - before.value[0],
    )
    made.variance = aid.std[0] ** 2 + before.std[0] ** 2
    made.slope[:], made.state[:] = 0.0, 0.0
    ekf.ranged[0] = aid
    return apart


@compiled
def is_repeat(ekf: Record, aid: Record) -> bool:
    """Whether a range, one of AID, is the one before: somebody has sent it twice."""
    before = ekf.ranged[0]
    return before.t == aid.t and before.anchor == aid.anchor and before.value[0] == aid.value[0]


@compiled
def compare(
    hypothesis: Record, position: np.ndarray, aid: Record, parameters: Record, innovation: Record
) -> None:
    """Fill in what the distance to an anchor at `position` (3,) m says to a HYPOTHESIS."""
    x = hypothesis.x
    dx, dy, dz = x[0] - position[0], x[1] - position[1], x[2] - position[2]
    distance = max(math.sqrt(dx * dx + dy * dy + dz * dz), 1e-6)
    innovation.entries = 3
    for k, along in enumerate((dx, dy, dz)):
        innovation.states[k], innovation.row[k] = k, along / distance
    innovation.value = aid.value[0] - distance
    innovation.noise_variance = parameters.range_std**2 + aid.std[0] ** 2
    project(hypothesis.P, innovation)
    if parameters.range_offset_std > 0.0:
        P = hypothesis.offset_P
        if P[RANGE, RANGE] == 0.0:
            hypothesis.offset[RANGE], P[RANGE, RANGE] = 0.0, parameters.range_offset_std**2
        innovation.value -= hypothesis.offset[RANGE]
        add_offset_jacobian(hypothesis, innovation, RANGE)


@compiled
def keep_offset(ekf: Record, hypothesis: Record) -> None:
    """After the update of a HYPOTHESIS: its offset of all ranges, where it was never known better;
    later it may be forgotten.
    """
    variance = hypothesis.offset_P[RANGE, RANGE]
    if 0.0 < variance < ekf.range_offset[1]:
        ekf.range_offset[0], ekf.range_offset[1] = hypothesis.offset[RANGE], variance
