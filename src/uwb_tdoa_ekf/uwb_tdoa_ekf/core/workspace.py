"""The surroundings of the anchors, where a tag is expected: a box along the axes of the world.

In a large hall that is not the hall, but what is near the anchors that are heard.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from .config import SIDES
from .update import update_state

SMALLEST = 3.0  # m from the middle of the anchors to each bound at least, however flat they lie
# m along an axis that anchors lie in a plane across, which tells nothing of the side of it that the
# tag is on
FLAT = 0.6
BELOW, ABOVE = SIDES.index("below"), SIDES.index("above")
STD = 1.0  # m, of what is known before anything is measured: a tag outside is at the bound


@compiled
def set_bounds(extent: np.ndarray, margin: float, bounds: np.ndarray) -> None:
    """Write the lower and upper bounds, m, to `bounds` (2, 3): `margin` beyond `extent` (2, 3) m,
    that of all anchors.
    """
    longest = max(extent[1, 0] - extent[0, 0], extent[1, 1] - extent[0, 1])
    for k in range(3):
        low, high = extent[0, k], extent[1, k]
        middle, half = 0.5 * (low + high), max(0.5 * (high - low) + margin, SMALLEST)
        if k < 2 and high - low < FLAT:  # of a wall the tag may be as far as it is long
            half = max(half, 0.5 * longest)
        bounds[0, k], bounds[1, k] = middle - half, middle + half


@compiled
def surround(ekf: Record, margin: float, bounds: np.ndarray) -> None:
    """The same, as far as it is within the reach of the anchors heard lately, and on the side of
    them that is configured.
    """
    set_bounds(ekf.extent, margin, bounds)
    for k in range(3):
        bounds[0, k], bounds[1, k] = (
            max(bounds[0, k], ekf.within[0, k]),
            min(bounds[1, k], ekf.within[1, k]),
        )
    axis, sign, plane = ekf.side
    if sign > 0.0:
        bounds[0, int(axis)] = plane
    elif sign < 0.0:
        bounds[1, int(axis)] = plane


@compiled
def configured_side(
    rows: np.ndarray, anchors: np.ndarray, tag_side: int
) -> tuple[float, float, float]:
    """On which side of which plane a tag is that hears the anchors in rows (k,): the axis across
    the plane, 1.0 or -1.0 for the side along that, 0.0 where none is configured or the anchors are
    in no such plane, and its coordinate, m.
    """
    if tag_side == 0 or len(rows) == 0:
        return 2.0, 0.0, 0.0
    axis, sign = 2, -1.0 if tag_side == BELOW else 1.0
    if tag_side > ABOVE:
        axis, sign = (tag_side - ABOVE - 1) // 2, -1.0 if (tag_side - ABOVE) % 2 else 1.0
    low = high = anchors[rows[0]].position[axis]
    for row in rows:
        low, high = min(low, anchors[row].position[axis]), max(high, anchors[row].position[axis])
    return float(axis), sign if high - low < FLAT else 0.0, 0.5 * (low + high)


@compiled
def reflect(x: np.ndarray, side: np.ndarray | tuple[float, float, float]) -> bool:
    """Put position and velocity x (6,) at the mirrored place, if they are on the other side than
    `configured_side` says. Returns whether.
    """
    axis, sign, plane = int(side[0]), side[1], side[2]
    if (x[axis] - plane) * sign >= 0.0:
        return False
    x[axis], x[3 + axis] = 2.0 * plane - x[axis], -x[3 + axis]
    return True


@compiled
def stay_on_side(hypothesis: Record, side: np.ndarray) -> bool:
    """The same for a HYPOTHESIS and its covariance."""
    if not reflect(hypothesis.x, side):
        return False
    axis, P = int(side[0]), hypothesis.P
    for state in (axis, 3 + axis):
        for j in range(len(P)):
            P[state, j], P[j, state] = -P[state, j], -P[j, state]
        P[state, state] = abs(P[state, state])
        for j in range(len(hypothesis.offset_cross)):
            hypothesis.offset_cross[j, state] = -hypothesis.offset_cross[j, state]
    return True


@compiled
def listen(
    ekf: Record, window: np.ndarray, anchors: np.ndarray, reach: float, tag_side: int
) -> None:
    """Note where a tag can be that has heard the anchors of a window (n,) of TDOA: within `reach`,
    m, of each of them, and where two of them are farther apart than that, within as much: they were
    heard, so the radio reaches farther. Note its side of them too.
    """
    rows = rows_heard(window)
    side = configured_side(rows, anchors, tag_side)
    ekf.side[0], ekf.side[1], ekf.side[2] = side
    for k in range(3):
        low, high = np.inf, -np.inf
        for row in rows:
            low, high = min(low, anchors[row].position[k]), max(high, anchors[row].position[k])
        ekf.middle[k] = 0.5 * (low + high)
        ekf.flat[k] = 1.0 if high - low < FLAT and not (side[1] != 0.0 and k == side[0]) else 0.0
    for i in range(len(rows)):
        for j in range(i):
            one, other = anchors[rows[i]].position, anchors[rows[j]].position
            reach = max(
                reach,
                math.sqrt(
                    (one[0] - other[0]) ** 2 + (one[1] - other[1]) ** 2 + (one[2] - other[2]) ** 2
                ),
            )
    for k in range(3):
        ekf.within[0, k], ekf.within[1, k] = -np.inf, np.inf
        for row in rows:
            at = anchors[row].position[k]
            ekf.within[0, k], ekf.within[1, k] = (
                max(ekf.within[0, k], at - reach),
                min(ekf.within[1, k], at + reach),
            )


@compiled
def add_circle(ekf: Record, height_known: bool, x: np.ndarray, covariance: np.ndarray) -> None:
    """Add to the (9, 9) covariance of a position x (3,), m, what anchors along one axis of the
    world leave open: the tag may be anywhere on a circle about them. height_known : whether
    something else determines z.
    """
    square, across = 0.0, 0
    for k in range(3):
        if ekf.flat[k] > 0.0:
            square, across = square + (x[k] - ekf.middle[k]) ** 2, across + 1
    if across != 2 or (height_known and ekf.flat[2] > 0.0):
        return
    for i in range(3):
        for j in range(3):
            if ekf.flat[i] > 0.0 and ekf.flat[j] > 0.0:
                covariance[i, j] += (x[i] - ekf.middle[i]) * (x[j] - ekf.middle[j]) + (
                    0.5 * square if i == j else 0.0
                )


@compiled
def rows_heard(window: np.ndarray) -> np.ndarray:
    """Rows of the anchors in a window (n,) of TDOA, each once."""
    rows, count = np.empty(2 * len(window), np.int64), 0
    for i in range(len(window)):
        for side in range(2):
            row = window[i].a if side == 0 else window[i].b
            k = 0
            while k < count and rows[k] != row:
                k += 1
            if k == count:
                rows[count] = row
                count += 1
    return rows[:count]


@compiled
def contains(bounds: np.ndarray, x: np.ndarray) -> bool:
    """True if position x (3,), m, is within `bounds` (2, 3)."""
    return outside(bounds, x) <= 0.0


@compiled
def outside(bounds: np.ndarray, x: np.ndarray) -> float:
    """How far position x (3,), m, is beyond `bounds` (2, 3), along the axis along which it is
    farthest, m; not above 0 within; inf where it is not a number.
    """
    farthest = -np.inf
    for k in range(3):
        beyond = max(bounds[0, k] - x[k], x[k] - bounds[1, k])
        farthest = max(farthest, beyond) if beyond == beyond else np.inf
    return farthest


@compiled
def is_filled(bounds: np.ndarray, P: np.ndarray) -> bool:
    """True if a tag whose error has covariance P may be anywhere in `bounds` (2, 3): its standard
    deviation exceeds their diagonal.
    """
    spread = size = 0.0
    for k in range(3):
        spread += P[k, k]
        size += (bounds[1, k] - bounds[0, k]) ** 2
    return spread > size


@compiled
def constrain(hypothesis: Record, innovation: Record, bounds: np.ndarray, axis: int) -> bool:
    """Soft constraint of one axis: pull a tag that is outside towards its workspace, and one of
    which less is known than that. Returns whether there was anything to do.

    Only while less is known of the axis: what is given once is not known better by being repeated,
    and TDOAs that agree on a place outside are right.
    """
    x, size = hypothesis.x[axis], bounds[1, axis] - bounds[0, axis]
    if hypothesis.P[axis, axis] > size**2:
        update_state(
            hypothesis, innovation, axis, min(max(x, bounds[0, axis]), bounds[1, axis]), size
        )
        return True
    if bounds[0, axis] <= x <= bounds[1, axis] or hypothesis.P[axis, axis] <= STD**2:
        return False
    update_state(hypothesis, innovation, axis, min(max(x, bounds[0, axis]), bounds[1, axis]), STD)
    return True
