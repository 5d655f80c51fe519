"""States beside the 15 of the error state: what is common to all measurements of one sensor, and is
found with the position.

Each has its own covariance with the error state, and all of them one of their own. A variance of 0:
there is no such state, and while there is none nothing is computed. What they are, and where they
begin, `barometer` and `ranges` say.
"""

from __future__ import annotations

from typing import Any

from uwb_tdoa_bias.common.compiled import Record, compiled

from .state import ERROR_STATES

PRESSURE, PRESSURE_DRIFT, RANGE = 0, 1, 2  # m and m/s, of the barometer; m, of all ranges
OFFSET_STATES = 3
# parameters of a filter without those of the barometer,
NO_PRESSURE: dict[str, Any] = {"use_pressure": False}
# and of one without any: a history has none
NONE: dict[str, Any] = {**NO_PRESSURE, "range_offset_std": 0.0}


@compiled
def present(hypothesis: Record) -> bool:
    """Whether a HYPOTHESIS has any of them."""
    return hypothesis.offset_P[PRESSURE, PRESSURE] > 0.0 or hypothesis.offset_P[RANGE, RANGE] > 0.0


@compiled
def forget(hypothesis: Record) -> None:
    """The state was replaced: all of them are to be found anew."""
    hypothesis.offset[:] = 0.0
    hypothesis.offset_cross[:] = 0.0
    hypothesis.offset_P[:] = 0.0


@compiled
def add_offset_jacobian(hypothesis: Record, innovation: Record, state: int) -> None:
    """After `update.project`: the measurement has one of them in it, whole."""
    cross, P = hypothesis.offset_cross, hypothesis.offset_P
    own = 0.0
    for n in range(innovation.entries):
        own += innovation.row[n] * cross[state, innovation.states[n]]
    for j in range(ERROR_STATES):
        innovation.cross_covariance[j] += cross[state, j]
    innovation.prior_variance += 2.0 * own + P[state, state]
    innovation.offset_jacobian[state] = 1.0


@compiled
def correct(hypothesis: Record, innovation: Record) -> None:
    """The part of `update.kalman` for them."""
    cross, P, total = hypothesis.offset_cross, hypothesis.offset_P, innovation.total_variance
    covariance = innovation.offset_covariance  # with the prediction
    for k in range(OFFSET_STATES):
        covariance[k] = 0.0
        for m in range(OFFSET_STATES):
            covariance[k] += innovation.offset_jacobian[m] * P[k, m]
        for n in range(innovation.entries):
            covariance[k] += innovation.row[n] * cross[k, innovation.states[n]]
    for k in range(OFFSET_STATES):
        gain = covariance[k] / total
        hypothesis.offset[k] += gain * innovation.value
        for j in range(ERROR_STATES):
            cross[k, j] -= gain * innovation.cross_covariance[j]
        for m in range(k, OFFSET_STATES):
            P[k, m] -= gain * covariance[m]
            P[m, k] = P[k, m]


@compiled
def predict(hypothesis: Record, transition: Record) -> None:
    """After `state.predict` of a HYPOTHESIS that has any: their covariance with the state, by the
    same TRANSITION.
    """
    dt, cross = transition.dt, hypothesis.offset_cross
    A, B, E = (
        transition.velocity_attitude,
        transition.velocity_accel_bias,
        transition.attitude_attitude,
    )
    for k in range(OFFSET_STATES):
        t0, t1, t2 = cross[k, 6], cross[k, 7], cross[k, 8]
        for r in range(3):
            cross[k, r] += dt * cross[k, 3 + r]
            by_attitude = A[r, 0] * t0 + A[r, 1] * t1 + A[r, 2] * t2
            by_bias = B[r, 0] * cross[k, 9] + B[r, 1] * cross[k, 10] + B[r, 2] * cross[k, 11]
            cross[k, 3 + r] += by_attitude + by_bias
            cross[k, 6 + r] = E[r, 0] * t0 + E[r, 1] * t1 + E[r, 2] * t2 - dt * cross[k, 12 + r]
    _drift(hypothesis, dt)


@compiled
def coast(hypothesis: Record, dt: float) -> None:
    """The same after `state.coast`."""
    cross = hypothesis.offset_cross
    for k in range(OFFSET_STATES):
        for r in range(3):
            cross[k, r] += dt * cross[k, 3 + r]
    _drift(hypothesis, dt)


@compiled
def _drift(hypothesis: Record, dt: float) -> None:
    """The barometer's offset moves by its drift; no other moves."""
    cross, P = hypothesis.offset_cross, hypothesis.offset_P
    hypothesis.offset[PRESSURE] += dt * hypothesis.offset[PRESSURE_DRIFT]
    for j in range(ERROR_STATES):
        cross[PRESSURE, j] += dt * cross[PRESSURE_DRIFT, j]
    P[PRESSURE, PRESSURE] += dt * (
        2.0 * P[PRESSURE, PRESSURE_DRIFT] + dt * P[PRESSURE_DRIFT, PRESSURE_DRIFT]
    )
    for k in (PRESSURE_DRIFT, RANGE):
        P[PRESSURE, k] += dt * P[PRESSURE_DRIFT, k]
        P[k, PRESSURE] = P[PRESSURE, k]
