# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Workspace: the surroundings of the anchors, where a tag is expected.

It is a box along the axes of the world. In a large hall it is not the hall but the surroundings of
the anchors heard.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from .config import SIDES
from .update import kalman_direct

# m, least distance from the middle of the anchors to each bound, however flat they lie
SMALLEST = 3.0
# m; if the anchors extend less along an axis, they lie in a plane across it. Then they do not
# determine the side of the tag.
FLAT = 0.6
BELOW, ABOVE = SIDES.index("below"), SIDES.index("above")
# sine of the slope of a line of anchors; on the circle about a steeper one the height is the same
STEEP = 0.7
ANY_YAW = math.pi / math.sqrt(3.0)  # rad, standard deviation of a yaw that is uniform on the circle
SMALLEST_VARIANCE = 1e-300  # m^2, replaces a variance of 0
STD = 1.0  # m, prior standard deviation about the bound for a tag just outside


@compiled
def set_bounds(extent: np.ndarray, margin: float, bounds: np.ndarray) -> None:
    """Compute the bounds of a box around the anchors.

    Parameters
    ----------
    extent : (2, 3) array
        Lower and upper bounds of all anchors, m, world frame.
    margin : float
        Distance from the anchors to the bounds, m.
    bounds : (2, 3) array
        Lower and upper bounds, m, world frame. Filled.
    """
    longest = max(extent[1, 0] - extent[0, 0], extent[1, 1] - extent[0, 1])
    for k in range(3):
        low, high = extent[0, k], extent[1, k]
        middle, half = 0.5 * (low + high), max(0.5 * (high - low) + margin, SMALLEST)
        # a tag may be away from a wall of anchors by half the length of the wall
        if k < 2 and high - low < FLAT:
            half = max(half, 0.5 * longest)
        bounds[0, k], bounds[1, k] = middle - half, middle + half


@compiled
def surround(ekf: Record, margin: float, bounds: np.ndarray) -> None:
    """Compute the bounds of the workspace from the anchors heard lately and the configured side.

    The bounds of `set_bounds` are limited to the radio reach of the heard anchors.

    Parameters
    ----------
    ekf : EKF
        State of the filter, after `listen`.
    margin : float
        Distance from the anchors to the bounds, m.
    bounds : (2, 3) array
        Lower and upper bounds, m, world frame. Filled.
    """
    set_bounds(ekf.extent, margin, bounds)
    bounds[0] = np.maximum(bounds[0], ekf.within[0])
    bounds[1] = np.minimum(bounds[1], ekf.within[1])
    axis, sign, plane = ekf.side
    if sign > 0.0:
        bounds[0, int(axis)] = plane
    elif sign < 0.0:
        bounds[1, int(axis)] = plane


@compiled
def _extent(rows: np.ndarray, anchors: np.ndarray, axis: int) -> tuple[float, float]:
    """Return the least and the largest coordinate of the anchors in rows (k,), in m."""
    low, high = np.inf, -np.inf
    for row in rows:
        at = anchors[row].position[axis]
        low, high = min(low, at), max(high, at)
    return low, high


@compiled
def configured_side(
    rows: np.ndarray, anchors: np.ndarray, tag_side: int
) -> tuple[float, float, float]:
    """Return the configured side of the tag relative to a plane of anchors.

    Parameters
    ----------
    rows : (k,) array
        Rows of the anchors heard.
    anchors : (N,) ANCHOR
        All anchors, by row.
    tag_side : int
        Index into config.SIDES.

    Returns
    -------
    tuple
        Axis across the plane, side (1.0 or -1.0 along the axis), coordinate of the plane (m). The
        side is 0.0 if none is configured or the anchors are not in such a plane.
    """
    if tag_side == 0 or len(rows) == 0:
        return 2.0, 0.0, 0.0
    axis, sign = 2, -1.0 if tag_side == BELOW else 1.0
    if tag_side > ABOVE:
        axis, sign = (tag_side - ABOVE - 1) // 2, -1.0 if (tag_side - ABOVE) % 2 else 1.0
    low, high = _extent(rows, anchors, axis)
    return float(axis), sign if high - low < FLAT else 0.0, 0.5 * (low + high)


@compiled
def reflect(x: np.ndarray, side: np.ndarray | tuple[float, float, float]) -> bool:
    """Mirror position and velocity x (6,) if they are on the wrong side, and return whether.

    side is the result of `configured_side`.
    """
    axis, sign, plane = int(side[0]), side[1], side[2]
    if (x[axis] - plane) * sign >= 0.0:
        return False
    x[axis], x[3 + axis] = 2.0 * plane - x[axis], -x[3 + axis]
    return True


@compiled
def stay_on_side(hypothesis: Record, side: np.ndarray) -> bool:
    """Mirror a HYPOTHESIS and its covariance if it is on the wrong side, and return whether.

    side is the result of `configured_side`.
    """
    if not reflect(hypothesis.x, side):
        return False
    axis, P = int(side[0]), hypothesis.P
    for state in (axis, 3 + axis):
        P[state, :] = -P[state, :]
        P[:, state] = -P[:, state]
        hypothesis.offset_cross[:, state] = -hypothesis.offset_cross[:, state]
    return True


@compiled
def listen(
    ekf: Record, window: np.ndarray, anchors: np.ndarray, reach: float, tag_side: int
) -> None:
    """Compute where a tag can be that has heard the anchors of a window.

    The tag is within `reach` of each anchor heard. If two heard anchors are farther apart, the
    radio reaches at least that far, and their distance replaces `reach`. The function sets side,
    middle, flat, line and within of the EKF.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    window : (n,) TDOA
        TDOAs of the tag.
    anchors : (N,) ANCHOR
        All anchors, by row.
    reach : float
        Radio reach, m.
    tag_side : int
        Index into config.SIDES.
    """
    rows = rows_heard(window)
    side = configured_side(rows, anchors, tag_side)
    ekf.side[0], ekf.side[1], ekf.side[2] = side
    for i in range(len(rows)):
        for j in range(i):
            apart = anchors[rows[i]].position - anchors[rows[j]].position
            reach = max(reach, math.sqrt(np.sum(apart**2)))
    for k in range(3):
        low, high = _extent(rows, anchors, k)
        ekf.middle[k] = 0.5 * (low + high)
        ekf.flat[k] = 1.0 if high - low < FLAT and not (side[1] != 0.0 and k == side[0]) else 0.0
        ekf.within[0, k], ekf.within[1, k] = high - reach, low + reach
    scatter, ekf.line[:] = np.zeros((3, 3)), 0.0
    for row in rows:
        away = anchors[row].position - ekf.middle
        scatter += np.outer(away, away)
    if side[1] == 0.0 and len(rows) > 2:  # any two anchors lie along a line
        variance = principal_axis(scatter, ekf.line)
        if np.trace(scatter) - variance > len(rows) * (0.5 * FLAT) ** 2:
            ekf.line[:] = 0.0


@compiled
def principal_axis(covariance: np.ndarray, axis: np.ndarray) -> float:
    """Compute the principal axis (3,) of a covariance (3, 3), and return its variance.

    The method is power iteration: at least one start is not normal to the axis.
    """
    variance = 0.0
    for start in range(3):
        trial, its = np.zeros(3), 0.0
        trial[start] = 1.0
        for _ in range(30):
            trial[:] = np.array([np.sum(covariance[i, :3] * trial) for i in range(3)])
            its = math.sqrt(np.sum(trial**2))
            trial /= max(its, SMALLEST_VARIANCE)
        if its > variance:
            axis[:], variance = trial, its
    return variance


@compiled
def add_circle(ekf: Record, height_known: bool, x: np.ndarray, covariance: np.ndarray) -> None:
    """Add the uncertainty on a circle around anchors that lie along a line.

    Such anchors leave the angle about their line open, so the tag may be anywhere on the circle. On the
    other side its yaw is another one.

    Parameters
    ----------
    ekf : EKF
        State of the filter, after `listen`.
    height_known : bool
        Whether another sensor determines z.
    x : (3,) array
        Position, m, world frame.
    covariance : (9, 9) array
        Covariance of position, velocity and attitude, updated in place.
    """
    line = ekf.line
    if line[0] == line[1] == line[2] == 0.0 or (height_known and abs(line[2]) < STEEP):
        return
    across = np.eye(3) - np.outer(line, line)
    away = np.sum(across * (x[:3] - ekf.middle), axis=1)
    covariance[:3, :3] += np.outer(away, away) + 0.5 * np.sum(away * away) * across
    covariance[8, 8] += ANY_YAW**2


@compiled
def rows_heard(window: np.ndarray) -> np.ndarray:
    """Return the rows of the anchors in a window (n,) of TDOA or PAIR, each once, as heard first."""
    rows, count = np.empty(2 * len(window), np.int64), 0
    for i in range(len(window)):
        for row in (window[i].a, window[i].b):
            if not np.any(rows[:count] == row):
                rows[count] = row
                count += 1
    return rows[:count]


@compiled
def admits(bounds: np.ndarray, x: np.ndarray, covariance: np.ndarray) -> bool:
    """Return whether a tag may be at a place that TDOAs give.

    It is in the workspace, or beside it and known to better than its distance from it. Late arrivals
    near the floor are often explained best by a place far above, so a place above or below needs
    another source.

    Parameters
    ----------
    bounds : (2, 3) array
        Bounds of the workspace, m, world frame.
    x : (k,) array
        Place, m, world frame, in its first three entries.
    covariance : (k, k) array
        Covariance of x.
    """
    outside = distance_outside(bounds, x)
    known = covariance[0, 0] + covariance[1, 1] < outside**2 < np.inf
    return outside <= 0.0 or (known and bounds[0, 2] <= x[2] <= bounds[1, 2])


@compiled
def distance_outside(bounds: np.ndarray, x: np.ndarray) -> float:
    """Return how far position x (3,), m, is outside of `bounds` (2, 3), m, along the worst axis, in m.

    The result is not positive inside, and inf if x is not a number.
    """
    beyond = np.maximum(bounds[0] - x[:3], x[:3] - bounds[1])
    return np.inf if np.isnan(beyond).any() else np.max(beyond)


@compiled
def is_filled(bounds: np.ndarray, P: np.ndarray) -> bool:
    """Return True if a tag with position covariance P may be anywhere in `bounds` (2, 3), m.

    The test is whether its 3D standard deviation exceeds the diagonal of the bounds.
    """
    return np.trace(P[:3, :3]) > np.sum((bounds[1] - bounds[0]) ** 2)


@compiled
def constrain(hypothesis: Record, innovation: Record, bounds: np.ndarray, axis: int) -> bool:
    """Apply the prior of the workspace to an axis: pull a tag outside towards it.

    The prior has heavy tails beside the anchors: its standard deviation is STD plus the distance of
    the tag from the workspace. Above and below them it is STD, because late arrivals near the floor
    are often explained best by a place far above. For a tag inside, it is the width of the workspace.
    TDOAs of anchors in a plane do not show how far a tag in this plane is from it. Without a bound
    this variance grows until no TDOA counts, because all are nonlinear over such a distance.

    The prior applies only while the standard deviation of the axis is larger. A prior that is
    given once must not shrink the covariance again and again. A tag that TDOAs place outside, by more
    than they leave open, is outside.

    Parameters
    ----------
    hypothesis : HYPOTHESIS
        Updated in place.
    innovation : INNOVATION
        Scratch.
    bounds : (2, 3) array
        Bounds of the workspace, m, world frame.
    axis : int
        Axis of the world, 0 to 2.

    Returns
    -------
    bool
        Whether the hypothesis was updated.
    """
    place, std = prior_of(bounds, hypothesis.x, axis)
    if hypothesis.P[axis, axis] <= std**2:
        return False
    kalman_direct(hypothesis, innovation, axis, place, std)
    return True


@compiled
def prior_of(bounds: np.ndarray, x: np.ndarray, axis: int) -> tuple[float, float]:
    """Return mean and standard deviation, m, of the prior that `constrain` applies at x (3,) or longer."""
    nearest = min(max(x[axis], bounds[0, axis]), bounds[1, axis])
    if x[axis] == nearest:
        return 0.5 * (bounds[0, axis] + bounds[1, axis]), bounds[1, axis] - bounds[0, axis]
    return nearest, STD + (abs(x[axis] - nearest) if axis < 2 else 0.0)
