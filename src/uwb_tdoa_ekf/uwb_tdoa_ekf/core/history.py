"""A recording of the filter's run, for the smoother: one record per update of the best hypothesis."""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from . import yaw_test
from .state import ERROR_STATES, MOVING_STATES, NOMINAL_STATES, propagate

# kinds of records: a Kalman update, or another state was put in place of the one before
UPDATE, RESET = (0, 1)

RECORD = np.dtype(
    [
        ("t", float),  # s
        ("kind", np.int64),
        ("transition", float, (MOVING_STATES, ERROR_STATES)),  # upper rows, since the record before
        ("row", float, ERROR_STATES),  # Jacobian h
        ("gain", float, ERROR_STATES),  # K
        ("innovation", float),  # in the measurement's unit
        ("variance", float),  # of the innovation, as used
        ("x", float, NOMINAL_STATES),  # after the update
        ("P", float, (ERROR_STATES, ERROR_STATES)),
    ],
    align=True,
)

NOTHING = np.empty(0, RECORD)  # no recording


@compiled
def add_prediction(ekf: Record, history: np.ndarray) -> None:
    """After `state.predict` of the best hypothesis."""
    if len(history) > 0:
        propagate(ekf.since_record, ekf.transition)
        ekf.since_record[:MOVING_STATES] = ekf.transition.product


@compiled
def add_coasting(ekf: Record, dt: float, history: np.ndarray) -> None:
    """After `state.coast` of the best hypothesis."""
    if len(history) > 0:
        for r in range(3):
            for j in range(ERROR_STATES):
                ekf.since_record[r, j] += dt * ekf.since_record[3 + r, j]


@compiled
def replace_velocity(ekf: Record, history: np.ndarray) -> None:
    """Record that the velocity of the best hypothesis was replaced.

    The new one does not depend on what came before.
    """
    if len(history) > 0:
        ekf.since_record[3:6, :] = 0.0


@compiled
def add_update(ekf: Record, t: float, history: np.ndarray) -> None:
    """After a Kalman update of the best hypothesis with ekf.innovation."""
    if len(history) > 0:
        record = _next(ekf, t, UPDATE, history)
        innovation = ekf.innovation
        record.innovation, record.variance = innovation.value, innovation.total_variance
        for n in range(innovation.entries):
            record.row[innovation.states[n]] = innovation.row[n]
        for j in range(ERROR_STATES):
            record.gain[j] = innovation.cross_covariance[j] / innovation.total_variance


@compiled
def add_reset(ekf: Record, t: float, history: np.ndarray) -> None:
    """After the state of the best hypothesis was replaced: nothing carries over, and no evidence
    against its yaw.
    """
    yaw_test.clear(ekf.yaw_test)
    if len(history) > 0:
        record = _next(ekf, t, RESET, history)
        record.innovation, record.variance = 0.0, 1.0


@compiled
def _next(ekf: Record, t: float, kind: int, history: np.ndarray) -> Record:
    """The next record, with all but what is particular to its kind.

    Raises IndexError if there is no room.
    """
    if ekf.recorded == len(history):
        raise IndexError("the history is full: most_records is too small")
    best, record = ekf.hypotheses[ekf.best], history[ekf.recorded]
    record.t, record.kind = t, kind
    record.transition[:] = ekf.since_record[:MOVING_STATES]
    record.row[:] = 0.0
    record.gain[:] = 0.0
    record.x[:] = best.x
    record.P[:] = best.P
    ekf.recorded += 1
    for i in range(ERROR_STATES):
        for j in range(ERROR_STATES):
            ekf.since_record[i, j] = 1.0 if i == j else 0.0
    return record
