# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""History of the filter for the smoother: a record for each update of the best hypothesis."""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from . import yaw_check
from .state import ERROR_STATES, MOVING_STATES, NOMINAL_STATES, propagate

UPDATE, RESET = (0, 1)  # kinds of records: a Kalman update, or a replaced state

RECORD = np.dtype(
    [
        ("t", float),  # s
        ("kind", np.int64),
        # upper rows, since the previous record
        ("transition", float, (MOVING_STATES, ERROR_STATES)),
        ("jacobian", float, ERROR_STATES),  # Jacobian row h, zeros included
        ("gain", float, ERROR_STATES),  # Kalman gain K
        ("innovation", float),  # in the unit of the measurement
        ("variance", float),  # of the innovation, as the update used it
        ("x", float, NOMINAL_STATES),  # nominal state after the update
        ("P", float, (ERROR_STATES, ERROR_STATES)),
    ],
    align=True,
)

NOTHING = np.empty(0, RECORD)  # no recording


@compiled
def add_prediction(ekf: Record, history: np.ndarray) -> None:
    """Multiply the transition since the last record, after `state.predict` of the best one."""
    if len(history) > 0:
        propagate(ekf.since_record, ekf.transition)
        ekf.since_record[:MOVING_STATES] = ekf.transition.product


@compiled
def add_coasting(ekf: Record, dt: float, history: np.ndarray) -> None:
    """Multiply the transition since the last record, after `state.coast` of the best hypothesis.

    dt is the duration in s.
    """
    if len(history) > 0:
        ekf.since_record[:3] += dt * ekf.since_record[3:6]


@compiled
def replace_velocity(ekf: Record, history: np.ndarray) -> None:
    """Record that the velocity of the best hypothesis was replaced.

    The new velocity does not depend on the state before.
    """
    if len(history) > 0:
        ekf.since_record[3:6, :] = 0.0


@compiled
def add_update(ekf: Record, h: int, t: float, history: np.ndarray) -> None:
    """Record a Kalman update of hypothesis h with ekf.innovation at stamp t (s), if h is the best."""
    if h == ekf.best and len(history) > 0:
        record = _next(ekf, t, UPDATE, history)
        innovation = ekf.innovation
        record.innovation, record.variance = innovation.value, innovation.total_variance
        for n in range(innovation.entries):
            record.jacobian[innovation.states[n]] = innovation.row[n]
        record.gain[:] = innovation.cross_covariance / innovation.total_variance


@compiled
def add_reset(ekf: Record, t: float, history: np.ndarray) -> None:
    """Record at stamp t (s) that the state of the best hypothesis was replaced.

    The new state does not depend on the state before. Evidence against the yaw is cleared too.
    """
    yaw_check.clear(ekf.yaw_test)
    if len(history) > 0:
        record = _next(ekf, t, RESET, history)
        record.innovation, record.variance = 0.0, 1.0


@compiled
def _next(ekf: Record, t: float, kind: int, history: np.ndarray) -> Record:
    """Return the next record, with all fields that every kind of record has.

    Raises IndexError if there is no room.
    """
    if ekf.recorded == len(history):
        raise IndexError("the history is full: most_records is too small")
    best, record = ekf.hypotheses[ekf.best], history[ekf.recorded]
    record.t, record.kind = t, kind
    record.transition[:] = ekf.since_record[:MOVING_STATES]
    record.jacobian[:] = 0.0
    record.gain[:] = 0.0
    record.x[:] = best.x
    record.P[:] = best.P
    ekf.recorded += 1
    ekf.since_record[:] = np.eye(ERROR_STATES)
    return record
