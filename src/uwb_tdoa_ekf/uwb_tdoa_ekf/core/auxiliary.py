# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Auxiliary states beyond the 15 error states: offsets common to all measurements of a sensor.

The filter estimates them together with the position. `offset` holds them. `offset_cross` is their
covariance with the error state. `offset_P` is their own covariance. A variance of 0 means that the state does not
exist. Without auxiliary states nothing is computed. `pressure` and `ranges` define their meaning
and initialization.
"""

from __future__ import annotations

from typing import Any

from uwb_tdoa_bias.common.compiled import Record, compiled

from .state import ERROR_STATES, propagate_vector

# offset of the barometer (m), its drift (m/s), offset of all ranges (m)
PRESSURE, PRESSURE_DRIFT, RANGE = 0, 1, 2
OFFSET_STATES = 3
# Parameters of a filter without the states of the barometer.
NO_PRESSURE: dict[str, Any] = {"use_pressure": False}
# Parameters of a filter without auxiliary states: a history has none.
NONE: dict[str, Any] = {**NO_PRESSURE, "range_offset_std": 0.0}


@compiled
def present(hypothesis: Record) -> bool:
    """Return whether a HYPOTHESIS has any auxiliary state."""
    return hypothesis.offset_P[PRESSURE, PRESSURE] > 0.0 or hypothesis.offset_P[RANGE, RANGE] > 0.0


@compiled
def forget(hypothesis: Record) -> None:
    """Remove all auxiliary states, because the state of the HYPOTHESIS was replaced.

    The filter estimates them again from the next measurements.
    """
    hypothesis.offset[:] = 0.0
    hypothesis.offset_cross[:] = 0.0
    hypothesis.offset_P[:] = 0.0


@compiled
def add_offset_jacobian(hypothesis: Record, innovation: Record, state: int) -> None:
    """Add an auxiliary state b to an innovation of z = h(x) + b.

    With the Jacobian H of h, the covariance C of b with the error state, and the variance P of b,
    the prior variance of z grows by 2 H C + P, and its covariance with the error state by C. The
    measurement noise is not in them.

    Call after `update.project`, at most once for an innovation: a second state would miss its
    covariance with the first.

    Parameters
    ----------
    hypothesis : HYPOTHESIS
        Hypothesis that has the state.
    innovation : INNOVATION
        Its prior_variance, cross_covariance and offset_jacobian are updated.
    state : int
        PRESSURE, PRESSURE_DRIFT or RANGE.
    """
    cross, P = hypothesis.offset_cross, hypothesis.offset_P
    cross_variance = 0.0  # H C
    for n in range(innovation.entries):
        cross_variance += innovation.row[n] * cross[state, innovation.states[n]]
    innovation.cross_covariance[:] += cross[state]
    innovation.prior_variance += 2.0 * cross_variance + P[state, state]
    innovation.offset_jacobian[state] = 1.0


@compiled
def correct(hypothesis: Record, innovation: Record) -> None:
    """Update the auxiliary states of a HYPOTHESIS: their part of `update.kalman`."""
    cross, P, total = hypothesis.offset_cross, hypothesis.offset_P, innovation.total_variance
    # of the auxiliary states with the predicted measurement
    covariance = innovation.offset_covariance
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
    """Predict the auxiliary states and their covariance with the error state.

    Call after `state.predict` of a HYPOTHESIS that has auxiliary states, with the same TRANSITION.
    """
    for k in range(OFFSET_STATES):
        propagate_vector(hypothesis.offset_cross[k], transition)
    _drift(hypothesis, transition.dt)


@compiled
def coast(hypothesis: Record, dt: float) -> None:
    """Predict the auxiliary states over dt (s), after `state.coast` of the same HYPOTHESIS."""
    hypothesis.offset_cross[:, :3] += dt * hypothesis.offset_cross[:, 3:6]
    _drift(hypothesis, dt)


@compiled
def _drift(hypothesis: Record, dt: float) -> None:
    """Predict the offset of the barometer by its drift over dt (s); no other state changes."""
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
