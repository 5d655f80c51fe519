# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Position of a tag at rest: on the ground, with late anchors there, or somewhere else.

The explanations are weighed by their probability. The covariance of the best explanation includes
the spread of all explanations.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from . import ground
from .ground import Evidence, KnownHeight
from .history import add_reset, add_update
from .hypotheses import alive, set_states
from .memory import HYPOTHESES
from .startup import Places
from .update import GATE, kalman_direct
from .workspace import surround

# starts on the ground, in units of the size of the box around the anchors
QUARTERS = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
NEAR = 1.0  # m beyond the anchors that a tag is expected in
EXPLANATIONS = 4  # somewhere else, and on the ground with each lateness of ground.explain
# m/s, of a tag at rest, in addition to the uncertainty from its TDOAs; a quiet tag that is known to
# be slower is at rest, a faster one may glide
SPEED_STD = 0.05
# Minus the logarithm of the prior probability that a tag at rest is more than NEAR above or below
# the anchors,
ABSURD = 20.0
UNUSUAL = 3.0  # and that anchors are late by an unknown amount because they are near the ground.
REACH = 1.0  # m from the place where the lateness of anchors is known, over which echoes change
# log probability ratio by which the ground must exceed the state of the filter for a landing
DECISIVE = 6.0
LIKELY = 3.0  # the same, 20 to 1: a noisy start waits with the ground
HOVER_STD = 0.3  # m, of the position of a tag that seems to stand but may hover
# expected number of anchors that are late because the tag is low, if its TDOAs change
FEWEST_LATE = 1.5
# m, by which the filter may be wrong at a landing, in addition to its covariance: mostly in height
LANDING_STD = (0.2, 0.2, 0.5)


@compiled
def weigh_explanations(
    ekf: Record,
    pairs: np.ndarray,
    anchors: np.ndarray,
    parameters: Record,
    height: KnownHeight,
    x: np.ndarray,
    covariance: np.ndarray,
) -> float:
    """Weigh the explanations of TDOAs by a tag at rest anywhere in its workspace.

    The explanations are the given position, and the ground with each lateness of ground.explain.

    Parameters
    ----------
    ekf : EKF
        State of the filter; late_as_known is set.
    pairs : (k,) PAIR
        Pairs of anchors, from `ground.find_pairs`.
    anchors : (N,) ANCHOR
        All anchors, by row.
    parameters : PARAMETERS
        Tuning of the filter.
    height : KnownHeight
        Height by another sensor.
    x : (6,) array
        Position (m) and velocity (m/s), world frame. The best position is written to it.
    covariance : (6, 6) array
        Covariance of x; it becomes the covariance of the best explanation.

    Returns
    -------
    float
        Logarithm of the probability ratio of the ground to the given position.
    """
    prior, bounds = np.zeros((4, 3)), ekf.workspace
    prior[0] = 0.5 * (bounds[0] + bounds[1])
    prior[1:] = np.diag(1.0 / (0.5 * (bounds[1] - bounds[0])) ** 2)
    evidence = Evidence(pairs, anchors, bounds, prior, parameters)
    near = _near_anchors(ekf, parameters)
    starts = near[0, :2] + (near[1, :2] - near[0, :2]) * QUARTERS
    explained = _explanations(ekf, evidence, height, x[:3], starts)
    explained.cost[0] += _absurdity(near, x)
    explained.x[0], explained.covariance[0] = x[:3], covariance[:3, :3]
    best = _mix(explained)
    ekf.late_as_known = best == 1 + ground.KNOWN
    x[:3] = explained.x[best]
    covariance[:3, :3] = explained.covariance[best]
    covariance[:3, 3:] = 0.0
    covariance[3:, :3] = 0.0
    return explained.cost[0] - np.min(explained.cost[1:])


@compiled
def _near_anchors(ekf: Record, parameters: Record) -> np.ndarray:
    """Return the bounds (2, 3) of a box around the anchors and the ground, m, world frame."""
    near = np.empty((2, 3))
    surround(ekf, NEAR, near)
    near[0, 2] = min(near[0, 2], parameters.ground_height)
    return near


@compiled
def sort_places(places: Places, ekf: Record, parameters: Record) -> None:
    """Order two Places by probability, the most probable first.

    The costs become relative to the first. A place far above or below the anchors is improbable.
    """
    x, covariance, cost = places.x, places.covariance, places.cost
    near = _near_anchors(ekf, parameters)
    for place in range(2):
        cost[place] += _absurdity(near, x[place])
    if cost[1] < cost[0]:
        x[:], covariance[:], cost[:] = x[::-1].copy(), covariance[::-1].copy(), cost[::-1].copy()
    cost -= cost[0]


# Return the cost of a place x (3,), m, outside the heights `near` (2, 3), m.
@compiled
def _absurdity(near: np.ndarray, x: np.ndarray) -> float:
    return 0.0 if near[0, 2] <= x[2] <= near[1, 2] else ABSURD


@compiled
def _explanations(
    ekf: Record, evidence: Evidence, height: KnownHeight, x: np.ndarray, starts: np.ndarray
) -> Places:
    """Return EXPLANATIONS positions: near x (3,), then on the ground with each lateness.

    starts (k, 2) are the horizontal start positions of the search on the ground, m, world frame.
    """
    position, each = np.empty((EXPLANATIONS, 3)), np.empty((EXPLANATIONS, 3, 3))
    cost = np.empty(EXPLANATIONS)
    position[0] = x
    cost[0] = ground.explain(evidence, height, ground.IN_TIME, position[0], each[0])
    if math.isnan(height.z):
        height = KnownHeight(
            evidence.parameters.ground_height + ground.GROUND_HEIGHT, ground.GROUND_STD
        )
    trial, its = np.empty(3), np.empty((3, 3))
    known = False
    for row in ground.heard(evidence.pairs)[0]:
        known = known or not math.isnan(evidence.anchors[row].floor_delay)
    for lateness in range(EXPLANATIONS - 1):
        k = 1 + lateness
        cost[k] = np.inf
        for start in range(len(starts) if lateness != ground.KNOWN or known else 0):
            trial[0], trial[1], trial[2] = starts[start, 0], starts[start, 1], height.z
            c = ground.explain(evidence, height, lateness, trial, its)
            if c < cost[k]:
                cost[k], position[k], each[k] = c, trial, its
    cost[1 + ground.ALIKE] += UNUSUAL
    if known and not math.isnan(ekf.floor_place[0]):
        apart = (position[1 + ground.KNOWN, :2] - ekf.floor_place) / REACH
        cost[1 + ground.KNOWN] += 0.5 * np.sum(apart**2)
    return Places(position, each, cost)


@compiled
def _mix(explained: Places) -> int:
    """Return the index of the most probable explanation, and widen its covariance.

    The covariance about its position includes all explanations (spread of the means).
    """
    position, each, cost = explained.x, explained.covariance, explained.cost
    best = int(np.argmin(cost))
    weights = np.exp(cost[best] - cost)
    weights /= np.sum(weights)
    for k in range(len(cost)):
        if k != best and weights[k] > 0.0:
            apart = position[k] - position[best]
            each[best] += np.outer(weights[k] * apart, apart)
    return best


@compiled
def set_at_rest(x: np.ndarray, covariance: np.ndarray, of_velocity: np.ndarray) -> None:
    """Set the velocity of a state and its covariance to a tag at rest.

    Parameters
    ----------
    x : (6,) array
        Position and velocity; the velocity becomes 0.
    covariance : (6, 6) array
        Covariance of x, updated in place.
    of_velocity : (3, 3) array
        Covariance of the velocity that TDOAs allow, m^2/s^2.
    """
    x[3:] = 0.0
    covariance[:, 3:] = 0.0
    covariance[3:, :] = 0.0
    covariance[3:, 3:] = of_velocity + SPEED_STD**2 * np.eye(3)


@compiled
def is_near_ground(hypothesis: Record, parameters: Record) -> bool:
    """Return whether a tag may stand on the ground, by the height of a HYPOTHESIS."""
    lowest = hypothesis.x[2] - GATE * math.sqrt(hypothesis.P[2, 2])
    return lowest < parameters.ground_height + ground.GROUND_HEIGHT + ground.GROUND_STD


@compiled
def _expected_late(pairs: np.ndarray, anchors: np.ndarray) -> float:
    """Return the expected number of late anchors in (k,) PAIR, because the tag is low."""
    late = 0.0
    for row in ground.heard(pairs)[0]:
        late += anchors[row].late
    return late


@compiled
def find_landed(
    ekf: Record,
    pairs: np.ndarray,
    anchors: np.ndarray,
    parameters: Record,
    still: bool,
    place: np.ndarray,
    covariance: np.ndarray,
) -> int:
    """Return the lateness of the anchors if a tag is on the ground, and -1 if it is not.

    Parameters
    ----------
    ekf : EKF
        State of the filter.
    pairs : (k,) PAIR
        Pairs of anchors, from `ground.find_pairs`.
    anchors : (N,) ANCHOR
        All anchors, by row.
    parameters : PARAMETERS
        Tuning of the filter.
    still : bool
        Whether the TDOAs do not change.
    place : (3,) array
        Position on the ground, m, world frame. Filled.
    covariance : (3, 3) array
        Covariance of the place, m^2. Filled.

    Returns
    -------
    int
        Lateness as in ground.explain, or -1.
    """
    best = ekf.hypotheses[ekf.best]
    if not is_near_ground(best, parameters) or not (
        still or _expected_late(pairs, anchors) > FEWEST_LATE
    ):
        return -1
    prior, wide = np.empty((4, 3)), best.P[:3, :3] + np.diag(np.array(LANDING_STD) ** 2)
    prior[0], prior[1:] = best.x[:3], ground.inverse(wide)
    evidence = Evidence(pairs, anchors, ekf.workspace, prior, parameters)
    starts = best.x[:2].copy().reshape(1, 2)
    unknown = KnownHeight(np.nan, np.nan)
    explained = _explanations(ekf, evidence, unknown, best.x[:3], starts)
    k = 1 + int(np.argmin(explained.cost[1:]))
    if explained.cost[k] + DECISIVE > explained.cost[0]:
        return -1
    place[:], covariance[:, :] = explained.x[k], explained.covariance[k]
    return k - 1


@compiled
def set_hovering_position(
    ekf: Record, place: np.ndarray, still: bool, t: float, records: np.ndarray
) -> None:
    """Update every hypothesis with the place of a tag near the ground that may hover.

    The place counts with HOVER_STD. If the tag is not still, only the height counts.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    place : (3,) array
        Position on the ground, m, world frame.
    still : bool
        Whether the TDOAs do not change.
    t : float
        Stamp, s.
    records : (n,) RECORD
        History for the smoother; empty for no recording.
    """
    for h in range(HYPOTHESES):
        if not alive(ekf.hypotheses[h]):
            continue
        for state in range(0 if still else 2, 6 if still else 3):
            value, std = 0.0, HOVER_STD
            if state < 3:
                value, P = place[state], ekf.hypotheses[h].P
                # a repeated measurement of a place adds no information
                P[state, state] = max(P[state, state], HOVER_STD**2)
            else:
                std = math.sqrt(ekf.still_covariance[state - 3, state - 3] + SPEED_STD**2)
            kalman_direct(ekf.hypotheses[h], ekf.innovation, state, value, std)
            add_update(ekf, h, t, records)


@compiled
def set_position(
    ekf: Record, position: np.ndarray, covariance: np.ndarray, t: float, records: np.ndarray
) -> None:
    """Set every hypothesis to a position at rest; attitude and biases stay the same.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    position : (3,) array
        New position, m, world frame.
    covariance : (3, 3) array
        Its covariance, m^2.
    t : float
        Stamp, s.
    records : (n,) RECORD
        History for the smoother; empty for no recording.
    """
    x, of_x = np.zeros(6), np.zeros((6, 6))
    x[:3], of_x[:3, :3] = position, covariance
    set_at_rest(x, of_x, ekf.still_covariance)
    set_states(ekf, x, of_x)
    ekf.consistency = 1.0
    add_reset(ekf, t, records)
