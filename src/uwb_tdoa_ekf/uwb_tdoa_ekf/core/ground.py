# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Tag near the ground: anchors that may be late there, and the position of a tag at rest.

The ground inverts the phase of a ray at grazing incidence. If tag and anchor are near the ground,
direct and reflected ray are nearly equally long. Then they cancel (two-ray ground-reflection model,
e.g. Rappaport, Wireless Communications, ch. 4). The receiver takes a later arrival for the first:
the anchor is late, by metres. The delay is unknown. The two heights and the distance determine
whether the anchor can be late.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.geometry import linearized_tdoa

from .update import GATE
from .workspace import STD, rows_heard

# tangent of the elevation below which the ground inverts the phase of a reflection
GRAZING = math.tan(math.radians(15.0))
HALF_WAVE = 0.0375  # m, at 4 GHz: rays with a larger path difference do not cancel
# m, largest usual delay of a late anchor. Up to it, larger delays are more probable, because the
# path by a reflector is a detour.
LATEST = 6.0
FARTHER = 1e-3  # 1/m, density of larger delays, and of outliers of any kind
RARE = 0.02  # least probability that an anchor is late, and that it is in time
USUAL = 0.1  # prior probability that it is late
CHANGE_TIME = 2.0  # s after which the last state of an anchor does not predict the next
# m above the ground below which reflections distort the pulse; m, standard deviation of the error
# at the ground
BLURRED, BLUR_STD = (0.8, 0.25)
NOT_USED = 0.2  # probability that both anchors of a TDOA are in time, below which it is rejected

MOST_PAIRS, MOST_ANCHORS = 64, 24  # limits for a window: the first pairs and anchors heard count
FEWEST_PAIRS = 3
STILL_TDOAS = 2  # least number of TDOAs of a pair in each half of the window
SMALLEST_SPREAD = 0.02  # m, least standard deviation of the values of a pair
STILL_SPEED = 0.3  # m/s; a velocity of zero is accepted only if its standard deviation is smaller
SPEED = 1.0  # m/s, prior standard deviation of the velocity
# scale of the loss, in standard deviations of a change: beyond, the lateness has changed; and
# number of sweeps
STILL_SCALE, STILL_SWEEPS = (2.5, 5)
MOVING = 12.0  # normalized square of the velocity above which the tag moves
STILL, UNKNOWN, MOVES = range(3)  # motion of a tag, as the TDOAs of a window show it
# Median normalized square of the changes at rest, and its largest deviation for n pairs, times
# sqrt(n).
EXPECTED_RATIO, LARGEST_RATIO = 0.45, 3.5

GROUND_STD = 0.15  # m, of the height of the tag of a body that stands on the ground
GROUND_HEIGHT = 0.05  # m, mean of this height
# standard deviation of the error of a pair, and of an anchor, in units of tdoa_std
PAIR_SHARE, ANCHOR_SHARE = (0.4, 1.0)
# m: mean of the delay that late anchors share, and its standard deviation
LATENESS = 2.0
ALIKE_STD = 0.3  # m, standard deviation of the delay of each late anchor about it
# probability ratio of any other delay, and of no delay, to the shared delay
OTHER, TIMELY = 0.1, 0.5
SWEEPS = 25
KNOWN_STD = 0.1  # m, standard deviation of the delay of an anchor about the known delay
# lateness of anchors near the ground: none, shared by all, or as known
IN_TIME, ALIKE, KNOWN = range(3)

PAIR = np.dtype(
    [
        ("a", np.int64),
        ("b", np.int64),  # rows of the anchors
        ("value", float),  # m, median of its TDOAs
        ("change", float),  # m, median of the second half minus median of the first half
        ("change_variance", float),  # m^2, of `change`; inf if a half has too few TDOAs
        ("apart", float),  # s between the mean stamps of the two halves
    ],
    align=True,
)


class KnownHeight(NamedTuple):
    """Height of the tag by another source than TDOAs, and its standard deviation.

    Both are in m, and NaN if unknown.
    """

    z: float
    std: float


class Evidence(NamedTuple):
    """Measurements and prior of a tag at rest.

    pairs : (k,) PAIR, from `find_pairs`. anchors : (N,) ANCHOR. workspace : (2, 3) bounds, m, world
    frame. prior : (4, 3): prior position, m, and in the last three rows its information, 1/m^2.
    parameters : PARAMETERS.
    """

    pairs: np.ndarray
    anchors: np.ndarray
    workspace: np.ndarray
    prior: np.ndarray
    parameters: Record


@compiled
def may_be_late(position: np.ndarray, x: np.ndarray, lower: float, ground: float) -> bool:
    """Return whether an anchor may be late at a tag over level ground.

    Parameters
    ----------
    position : (3,) array
        Position of the anchor, m, world frame.
    x : (3,) array
        Position of the tag, m, world frame.
    lower : float
        The tag may be up to this distance below x, m.
    ground : float
        Height of the ground, m, world frame.
    """
    tag, anchor = max(x[2] - ground - lower, 0.0), max(position[2] - ground, 0.0)
    distance = math.hypot(x[0] - position[0], x[1] - position[1])
    return tag + anchor < GRAZING * distance and 2.0 * tag * anchor < HALF_WAVE * distance


@compiled
def blur(hypothesis: Record, ground: float) -> float:
    """Return the additional variance of a TDOA near the ground, in m^2.

    The ray that the ground reflects arrives within the length of the pulse and moves its leading
    edge. ground is the height of the ground, m, world frame.
    """
    share = min(max(1.0 - (hypothesis.x[2] - ground) / BLURRED, 0.0), 1.0)
    return (BLUR_STD * share) ** 2


@compiled
def find_lateness(a: Record, b: Record, hypothesis: Record, t: float, ground: float) -> bool:
    """Predict the probability that each anchor is late, and return whether either can be.

    Parameters
    ----------
    a, b : ANCHOR
        Anchors of a TDOA; `late` is updated.
    hypothesis : HYPOTHESIS
        State of the tag.
    t : float
        Stamp, s.
    ground : float
        Height of the ground, m, world frame.
    """
    lower = GATE * math.sqrt(hypothesis.P[2, 2])
    _predict_lateness(a, hypothesis.x, lower, t, ground)
    _predict_lateness(b, hypothesis.x, lower, t, ground)
    return a.late > 0.0 or b.late > 0.0


# Predict the probability that an anchor is late, to stamp t, s. See `find_lateness`.
@compiled
def _predict_lateness(anchor: Record, x: np.ndarray, lower: float, t: float, ground: float) -> None:
    if not may_be_late(anchor.position, x, lower, ground):
        anchor.late = 0.0
    else:
        step = min(1.0, max(0.0, t - anchor.predicted) / CHANGE_TIME)
        anchor.late = min(max(anchor.late + step * (USUAL - anchor.late), RARE), 1.0 - RARE)
    anchor.predicted = t


@compiled
def in_time(a: Record, b: Record, innovation: Record) -> float:
    """Return the probability that both anchors of a TDOA are in time, and update each anchor.

    This is a filter with four modes (Bar-Shalom et al., Estimation with Applications to Tracking
    and Navigation, 2001, section 11.6). The modes do not exchange states, because lateness does not
    show a position. Call after `find_lateness`.

    Parameters
    ----------
    a, b : ANCHOR
        Anchors of the TDOA; `late` becomes the posterior probability.
    innovation : INNOVATION
        TDOA after `project` of the best hypothesis.
    """
    late_a, late_b = a.late, b.late
    r, variance = innovation.value, innovation.prior_variance + innovation.noise_variance
    gauss = math.exp(-0.5 * r * r / variance)
    neither = (
        (1.0 - late_a) * (1.0 - late_b) * (gauss / math.sqrt(2.0 * math.pi * variance) + FARTHER)
    )
    of_b = (1.0 - late_a) * late_b * _nlos_delay(r)
    of_a = (1.0 - late_b) * late_a * _nlos_delay(-r)
    both = late_a * late_b * max(FARTHER, (1.0 - abs(r) / LATEST) / LATEST)
    total = neither + of_a + of_b + both
    a.late, b.late = (of_a + both) / total, (of_b + both) / total
    return neither / total


@compiled
def _nlos_delay(r: float) -> float:
    """Return the probability density of an innovation r (m) by a single late anchor, in 1/m."""
    return max(2.0 * r / LATEST**2, FARTHER) if r < LATEST else FARTHER


@compiled
def find_pairs(window: np.ndarray, pairs: np.ndarray) -> int:
    """Collect the TDOAs of a window by pairs of anchors, in either order, and return their number.

    The variance of a change uses the scatter of all pairs within the halves of the window.

    Parameters
    ----------
    window : (n,) TDOA
        TDOAs, by rising stamp; n > 0.
    pairs : (k,) PAIR
        Filled: median value and change of each pair.

    Returns
    -------
    int
        Number of pairs.
    """
    n, count = len(window), 0
    middle = 0.5 * (window[0].t + window[n - 1].t)
    values, deviations, known = np.empty((2, n)), np.empty(n), 0
    counts, stamps = np.empty(2, np.int64), np.empty(2)  # of a pair in each half
    for i in range(n):
        a, b = window[i].a, window[i].b
        k = 0
        while k < count and not _is_of(window[i], pairs[k].a, pairs[k].b):
            k += 1
        if k < count or count == len(pairs):
            continue
        counts[:], stamps[:] = 0, 0.0
        for j in range(i, n):
            tdoa = window[j]
            if _is_of(tdoa, a, b):
                half = 0 if tdoa.t < middle else 1
                values[half, counts[half]] = tdoa.d if tdoa.a == a else -tdoa.d
                stamps[half] += tdoa.t
                counts[half] += 1
        m0, m1 = counts
        pair = pairs[count]
        pair.a, pair.b, pair.change_variance = a, b, np.inf
        if m0 >= STILL_TDOAS and m1 >= STILL_TDOAS:
            first, second = np.median(values[0, :m0]), np.median(values[1, :m1])
            for half, m, value in ((0, m0, first), (1, m1, second)):
                for j in range(m):
                    deviations[known] = abs(values[half, j] - value) * math.sqrt(m / (m - 1.0))
                    known += 1
            pair.change, pair.apart = second - first, stamps[1] / m1 - stamps[0] / m0
            pair.change_variance = 1.57 * (1.0 / m0 + 1.0 / m1)
        values[0, m0 : m0 + m1] = values[1, :m1]
        pair.value = np.median(values[0, : m0 + m1])
        count += 1
    spread = 1.48 * np.median(deviations[:known]) if known else np.inf
    for k in range(count):
        pairs[k].change_variance *= max(spread, SMALLEST_SPREAD) ** 2
    return count


# Return whether a TDOA is between the anchors in rows a and b, in either order.
@compiled
def _is_of(tdoa: Record, a: int, b: int) -> bool:
    return (tdoa.a == a and tdoa.b == b) or (tdoa.a == b and tdoa.b == a)


@compiled
def judge_motion(
    pairs: np.ndarray, anchors: np.ndarray, x: np.ndarray, covariance: np.ndarray
) -> int:
    """Return whether a tag is STILL or MOVES, or UNKNOWN, from the changes of its TDOAs.

    STILL: the TDOAs of most pairs stay constant. Then the tag is at rest, whatever the delays of
    its anchors are. MOVES: they change. UNKNOWN: they are too few or too noisy. The velocity
    follows by least squares of the changes, robust against anchors with a changed delay.

    Parameters
    ----------
    pairs : (k,) PAIR
        Pairs of anchors, from `ground.find_pairs`.
    anchors : (N,) ANCHOR
        All anchors, by row.
    x : (3,) array
        Approximate position, m, world frame.
    covariance : (3, 3) array
        Covariance of the estimated velocity, m^2/s^2. Filled; large if the TDOAs do not determine
        it.
    """
    n, changes, ratios = 0, np.empty((len(pairs), 5)), np.empty(len(pairs))
    for k in range(len(pairs)):
        pair = pairs[k]
        if pair.change_variance < np.inf:
            linearized_tdoa(x, anchors[pair.a].position, anchors[pair.b].position, changes[n, :3])
            changes[n, 3] = pair.change / pair.apart
            changes[n, 4] = pair.change_variance / pair.apart**2
            ratios[n] = pair.change**2 / pair.change_variance
            n += 1
    if n < FEWEST_PAIRS:
        return UNKNOWN
    if np.median(ratios[:n]) > EXPECTED_RATIO + LARGEST_RATIO / math.sqrt(n):
        return MOVES
    both, v = np.empty((3, 7)), np.zeros(3)
    for _sweep in range(STILL_SWEEPS):
        both[:, :] = 0.0
        both[:, :3], both[:, 3:6] = np.eye(3) / SPEED**2, np.eye(3)
        for k in range(n):
            row = changes[k]
            r = row[3] - row[0] * v[0] - row[1] * v[1] - row[2] * v[2]
            weight = 1.0 / (row[4] * (1.0 + r * r / (STILL_SCALE**2 * row[4])))
            both[:, :3] += np.outer(weight * row[:3], row[:3])
            both[:, 6] += weight * row[:3] * row[3]
        information = both[:, :3].copy()
        solve(both)
        v[:] = both[:, 6]
    covariance[:, :] = both[:, 3:6]
    size = np.sum(np.outer(v, v) * information)
    if size >= MOVING:
        return MOVES
    return STILL if covariance[0, 0] + covariance[1, 1] < STILL_SPEED**2 else UNKNOWN


@compiled
def explain(
    evidence: Evidence, height: KnownHeight, lateness: int, x: np.ndarray, covariance: np.ndarray
) -> float:
    """Estimate the position of a tag at rest, given an assumption about late anchors.

    Each anchor and each pair has an error of its own, rarely large (Student's distribution). ALIKE:
    most anchors near the ground share a delay, because the path by the reflector is the same. Some
    have any other delay, and some are in time (a mixture). KNOWN: the error of an anchor is about
    its floor_delay. The method is iteratively re-weighted least squares.

    Parameters
    ----------
    evidence : Evidence
        Measurements and prior.
    height : KnownHeight
        Height by another sensor.
    lateness : int
        IN_TIME, ALIKE or KNOWN.
    x : (3,) array
        Start position, m, world frame. It becomes the most probable position.
    covariance : (3, 3) array
        Covariance of the position, m^2. Filled.

    Returns
    -------
    float
        Minus the logarithm of the probability, up to a constant.
    """
    anchors, parameters = evidence.anchors, evidence.parameters
    rows, places = heard(evidence.pairs)
    n = 3 + len(rows) + 1
    system, u = np.empty((n, n + 1)), np.zeros(n)
    u[:3] = x
    u[n - 1] = LATENESS if lateness == ALIKE else 0.0
    late, errors = np.zeros(len(rows), np.bool_), np.zeros((len(rows), 2))
    errors[:, 1] = ANCHOR_SHARE * parameters.tdoa_std
    for i in range(len(rows)):
        anchor = anchors[rows[i]]
        if lateness == KNOWN and not math.isnan(anchor.floor_delay):
            errors[i, 0], errors[i, 1] = anchor.floor_delay, math.hypot(anchor.floor_std, KNOWN_STD)
            u[3 + i] = anchor.floor_delay
    for sweep in range(SWEEPS):
        for i in range(len(rows)):
            late[i] = lateness == ALIKE and may_be_late(
                anchors[rows[i]].position, u, 0.0, parameters.ground_height
            )
            if sweep == 0 and late[i]:
                u[3 + i] = LATENESS
        _equations(evidence, height, places, late, errors, u, system)
        if not solve(system):
            return np.inf
        step = system[:, n]
        length = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
        for j in range(n):
            u[j] += min(1.0, 2.0 / max(length, 1e-9)) * step[j]
    cost = _equations(evidence, height, places, late, errors, u, system)
    x[:] = u[:3]
    covariance[:, :] = inverse(system[:, :n])[:3, :3]
    return cost if covariance[0, 0] > 0.0 else np.inf


@compiled
def heard(pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the rows of the heard anchors, and for each pair the indices into them, (k, 2).

    An index is -1 beyond MOST_ANCHORS.
    """
    rows, places = rows_heard(pairs)[:MOST_ANCHORS], np.full((len(pairs), 2), -1)
    for k in range(len(pairs)):
        for j in range(len(rows)):
            if rows[j] == pairs[k].a:
                places[k, 0] = j
            elif rows[j] == pairs[k].b:
                places[k, 1] = j
    return rows, places


@compiled
def _equations(
    evidence: Evidence,
    height: KnownHeight,
    places: np.ndarray,
    late: np.ndarray,
    errors: np.ndarray,
    u: np.ndarray,
    system: np.ndarray,
) -> float:
    """Fill in the normal equations of a step from u (n,), and return the cost.

    u contains the position (m), the error of each heard anchor (m), and the delay that late anchors
    share (m). system is (n, n + 1). errors is (k, 2), in m: expected error of an anchor that is not
    late, and its standard deviation.
    """
    pairs = evidence.pairs
    anchors = evidence.anchors
    workspace = evidence.workspace
    prior = evidence.prior
    parameters = evidence.parameters
    n = len(u)
    system[:, :] = 0.0
    row, cost = np.empty(3), 0.0
    of_pair, of_anchor = PAIR_SHARE * parameters.tdoa_std, ANCHOR_SHARE * parameters.tdoa_std
    states, entries = np.empty(5, np.int64), np.empty(5)
    for k in range(len(pairs)):
        i, j = places[k, 0], places[k, 1]
        if i < 0 or j < 0:
            continue
        r = (
            pairs[k].value
            - linearized_tdoa(u, anchors[pairs[k].a].position, anchors[pairs[k].b].position, row)
            - u[3 + j]
            + u[3 + i]
        )
        square = 0.5 * (r / of_pair) ** 2
        cost += math.log1p(square)
        for axis in range(3):
            states[axis], entries[axis] = axis, row[axis]
        states[3], entries[3], states[4], entries[4] = 3 + i, -1.0, 3 + j, 1.0
        _add(system, states, entries, r, 1.0 / (of_pair**2 * (1.0 + square)))
    for i in range(len(late)):
        if late[i]:
            apart = u[3 + i] - u[n - 1]
            square = 0.5 * (apart / ALIKE_STD) ** 2
            alike = 1.0 / (1.0 + square)
            timely = TIMELY * math.exp(-0.5 * (u[3 + i] / of_anchor) ** 2)
            total = alike + OTHER + timely
            cost -= math.log(total)
            states[0], entries[0], states[1], entries[1] = 3 + i, 1.0, n - 1, -1.0
            _add(
                system,
                states[:2],
                entries[:2],
                -apart,
                alike / total / (ALIKE_STD**2 * (1.0 + square)),
            )
            _add(system, states[:1], entries[:1], -u[3 + i], timely / total / of_anchor**2)
            _add(system, states[:1], entries[:1], 0.0, 1.0 / LATENESS**2)
        else:
            apart, std = errors[i, 0] - u[3 + i], errors[i, 1]
            square = 0.5 * (apart / std) ** 2
            cost += math.log1p(square) + math.log(std / of_anchor)
            states[0], entries[0] = 3 + i, 1.0
            _add(system, states[:1], entries[:1], apart, 1.0 / (std**2 * (1.0 + square)))
    apart = u[n - 1] - LATENESS
    cost += 0.5 * (apart / LATENESS) ** 2 if late.any() else 0.0
    states[0], entries[0] = n - 1, 1.0
    _add(system, states[:1], entries[:1], -apart, 1.0 / LATENESS**2)
    for axis in range(3):
        states[0] = axis
        low, high = workspace[0, axis], workspace[1, axis]
        for k in range(3):
            system[axis, k] += prior[1 + axis, k]
            system[axis, n] += prior[1 + axis, k] * (prior[0, k] - u[k])
            cost += 0.5 * (prior[0, axis] - u[axis]) * prior[1 + axis, k] * (prior[0, k] - u[k])
        outside = u[axis] - min(max(u[axis], low), high)
        cost += 0.5 * (outside / STD) ** 2
        if outside != 0.0:
            _add(system, states[:1], entries[:1], -outside, 1.0 / STD**2)
    if not math.isnan(height.z):
        cost += 0.5 * ((u[2] - height.z) / height.std) ** 2 - math.log(
            (workspace[1, 2] - workspace[0, 2]) / (2.5 * height.std)
        )
        states[0] = 2
        _add(system, states[:1], entries[:1], height.z - u[2], 1.0 / height.std**2)
    return cost


@compiled
def _add(
    system: np.ndarray, states: np.ndarray, entries: np.ndarray, r: float, weight: float
) -> None:
    """Add a scalar equation to the normal equations: sum of entries * step of the states = r."""
    last = system.shape[1] - 1
    for i in range(len(states)):
        for j in range(len(states)):
            system[states[i], states[j]] += weight * entries[i] * entries[j]
        system[states[i], last] += weight * entries[i] * r


@compiled
def inverse(matrix: np.ndarray) -> np.ndarray:
    """Return the inverse of a positive definite matrix; NaN if there is none."""
    n = len(matrix)
    both = np.concatenate((matrix, np.eye(n)), axis=1)
    if not solve(both):
        both[:, :] = np.nan
    return both[:, n:]


@compiled
def solve(system: np.ndarray) -> bool:
    """Solve positive definite equations in place and return whether a solution exists.

    system is (n, n + m): the matrix and m right sides, which become the solutions. np.linalg.solve
    takes two to four times as long for 3 to 12 unknowns, and imports scipy, 0.2 s of a node's start.
    """
    n, columns = system.shape
    for k in range(n):
        pivot = system[k, k]
        if not pivot > 1e-12:
            return False
        for j in range(k, columns):
            system[k, j] /= pivot
        for i in range(n):
            factor = system[i, k]
            for j in range(k, columns if i != k else 0):
                system[i, j] -= factor * system[k, j]
    return True
