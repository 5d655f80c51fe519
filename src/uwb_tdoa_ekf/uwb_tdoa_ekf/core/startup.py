"""Where is the tag? A position and velocity from a short window of TDOAs and nothing else.

In a room the search begins in the middle and the corners of its workspace. Where that is large a
coarse grid over it says where else to begin. TDOAs that are older than a usual window, of a tag
that hears few, tell less, as the tag may have moved by any acceleration since.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.geometry import linearized_tdoa
from uwb_tdoa_bias.common.robust_loss import GEMAN_MCCLURE, geman_mcclure_loss, weight

from .ground import KnownHeight, solve
from .workspace import configured_side, reflect, rows_heard

STARTS = 9  # the middle of the workspace and the corners of the half-size box around it,
GRID_STARTS = 7  # and the best places of a grid over one that is larger than
LARGE = 20.0  # m, along x or y
# m, between its places at least; how many at a height at most; m between heights at most
GRID_STEP, GRID_POINTS, GRID_LEVEL = 2.0, 600, 4.0
GRID_LEVELS = 20  # heights at most: the work has a bound, however far the anchors are apart
GRID_TDOAS = 60  # of the window, that it looks at
# grid steps: scale of the loss, and between two of the best places
GRID_LOSS, GRID_APART = (1.5, 2.5)
SWEEPS = 14  # Gauss-Newton steps per start
COARSE, FINE = 5.0, 0.5  # m, scale of the Geman-McClure loss at the first and the last steps
SPEED = 1.0  # m/s, standard deviation of the velocity before anything is known
LONGEST_STEP = 2.0  # m
INLIER = 0.75  # m, a residual below this does not contradict a position
NO_SCALE = 1e6  # m, of a loss that is quadratic
APART = 1.0  # m between two places, and standard deviation of a place that becomes two
# minus the logarithm of the probability of a place beside another, beyond which it is none
IMPROBABLE = 8.0
SMALLEST = 1e-300  # m^2, in place of a variance of 0
SPLIT = 0.8  # standard deviations from the middle of a place to each of two that it becomes


class Places(NamedTuple):
    """Places where a tag may be: positions and velocities x (k, 6) m, m/s (or positions alone, (k,
    3)), their covariance (k, 6, 6), and minus the logarithm of the probability of each, up to a
    constant, cost (k,): inf for a place that is none.
    """

    x: np.ndarray
    covariance: np.ndarray
    cost: np.ndarray


@compiled
def room_for(count: int) -> Places:
    """Places to be filled in."""
    return Places(np.empty((count, 6)), np.empty((count, 6, 6)), np.empty(count))


@compiled
def locate(
    window: np.ndarray,
    anchors: np.ndarray,
    workspace: np.ndarray,
    parameters: Record,
    height: KnownHeight,
    places: Places,
) -> float:
    """Robust multilateration over a window, with constant velocity.

    window : (n,) of TDOA, stamps rising; anchors : (N,) of ANCHOR; workspace : (2, 3) m, see
        workspace.py; parameters : one of
    PARAMETERS. Fills in places, at the last stamp, with costs less that of the first: the most
    probable one first, then others that are APART. In a large workspace the covariance of the last
    one holds those for which there is no room. Returns the share of TDOAs that agree with the
    first, 0 to 1.

    Graduated Geman-McClure: Gauss-Newton from several starts while the loss narrows; the start with
    the least final loss wins. A tag is in its workspace and slow until proven otherwise: without
    that prior, the late arrivals on a floor are explained best by a tag ten metres up. The
    covariance counts one independent error per anchor heard, not per TDOA, because errors persist
    over the window, and grows with the disagreement that is left.
    """
    x, covariance, cost = places.x, places.covariance, places.cost
    std, ageing = parameters.tdoa_std, np.zeros(len(window))
    for i in range(len(window)):
        age = max(0.0, window[len(window) - 1].t - window[i].t - parameters.start_window)
        ageing[i] = parameters.motion_noise**2 * age**3 / 3.0 / std**2
    mean, prior_std = np.zeros(6), np.full(6, SPEED)
    for k in range(3):
        mean[k], prior_std[k] = (
            0.5 * (workspace[0, k] + workspace[1, k]),
            0.5 * (workspace[1, k] - workspace[0, k]),
        )
    if not math.isnan(height.z):
        mean[2], prior_std[2], prior_std[5] = height.z, height.std, SPEED
    prior_information = 1.0 / prior_std**2
    rows = rows_heard(window)
    correlation_length = max(1.0, len(window) / max(1.0, len(rows) - 1.0))
    trials, losses = np.zeros((STARTS + GRID_STARTS, 6)), np.full(STARTS + GRID_STARTS, np.inf)
    residuals, system = np.zeros(len(window)), np.zeros((6, 7))
    side = configured_side(rows, anchors, parameters.tag_side)
    large = max(prior_std[0], prior_std[1]) > 0.5 * LARGE
    starts = STARTS + (
        _best_of_grid(window, anchors, mean, prior_std, ageing, trials[STARTS:]) if large else 0
    )
    for start in range(starts):
        trial = trials[start]
        if start < STARTS:
            trial[:] = mean
        for k in range(3):
            if 0 < start < STARTS:
                trial[k] += 0.5 * prior_std[k] * (1.0 if ((start - 1) >> k) & 1 else -1.0)
        for sweep in range(SWEEPS):
            scale = max(COARSE * 0.7**sweep, FINE)
            reflect(trial, side)
            _normal_equations(window, anchors, trial, ageing, scale, system, residuals)
            _step(
                trial,
                system,
                correlation_length * max(std, 0.5 * scale) ** 2 * prior_information,
                mean,
            )
        reflect(trial, side)
        loss = _normal_equations(window, anchors, trial, ageing, FINE, system, residuals)
        far = np.sum(((trial - mean) / prior_std) ** 2)
        losses[start] = 0.5 * (len(window) / correlation_length * loss * (FINE / std) ** 2 + far)
    share, least = 0.0, np.min(losses)
    for place in range(len(x)):
        start = int(np.argmin(losses))
        cost[place] = losses[start] - least if losses[start] - least < IMPROBABLE else np.inf
        x[place] = trials[start]
        _normal_equations(window, anchors, x[place], ageing, NO_SCALE, system, residuals)
        variance = correlation_length * max(std, 1.5 * np.median(np.abs(residuals))) ** 2
        for k in range(6):
            system[k, k] += variance * prior_information[k]
        both = np.concatenate((system[:, :6], np.eye(6)), axis=1)
        solve(both)
        covariance[place] = both[:, 6:] * variance
        if place == 0:
            share = float(np.mean(np.abs(residuals) < INLIER))
        for other in range(starts):
            if np.sum((trials[other, :3] - x[place, :3]) ** 2) < APART**2:
                losses[other] = np.inf
    if large:
        _hold_others(trials, losses - least, places)
    return share


@compiled
def _hold_others(trials: np.ndarray, costs: np.ndarray, places: Places) -> None:
    """Spread the last of the places that is one over the others (m, 6) that are left, whose costs
    (m,) are inf where they are not.
    """
    x, covariance, cost = places.x, places.covariance, places.cost
    last = 0
    for place in range(len(x)):
        if cost[place] < np.inf:
            last = place
    total = math.exp(-cost[last])
    for other in range(len(costs)):
        total += math.exp(-costs[other]) if costs[other] < IMPROBABLE else 0.0
    for other in range(len(costs)):
        if costs[other] < IMPROBABLE:
            share = math.exp(-costs[other]) / total
            for i in range(3):
                for j in range(3):
                    covariance[last, i, j] += (
                        share * (trials[other, i] - x[last, i]) * (trials[other, j] - x[last, j])
                    )
    cost[last] = min(cost[last], -math.log(total))


@compiled
def _best_of_grid(
    window: np.ndarray,
    anchors: np.ndarray,
    mean: np.ndarray,
    prior_std: np.ndarray,
    ageing: np.ndarray,
    places: np.ndarray,
) -> int:
    """Fill in places (k, 6), at rest, of a grid over `mean` +- `prior_std` (6,) that explain a
    window best, apart from each other. Returns how many.
    """
    step = max(
        GRID_STEP,
        math.sqrt(4.0 * prior_std[0] * prior_std[1] / GRID_POINTS),
        2.0 * max(prior_std[0], prior_std[1]) / GRID_POINTS,
    )
    counts, origin, steps = np.empty(3, np.int64), np.empty(3), np.empty(3)
    for k in range(3):
        wanted = math.ceil(2.0 * prior_std[k] / (GRID_LEVEL if k == 2 else step))
        counts[k] = int(max(2.0, min(wanted, GRID_LEVELS))) if k == 2 else int(max(1.0, wanted))
        steps[k] = 2.0 * prior_std[k] / counts[k]
        origin[k] = mean[k] - prior_std[k] + 0.5 * steps[k]
    losses, p, row = np.empty(counts[0] * counts[1] * counts[2]), np.empty(3), np.empty(3)
    apart = max(1, len(window) // GRID_TDOAS)
    for i in range(len(losses)):
        p[0] = origin[0] + steps[0] * (i % counts[0])
        p[1] = origin[1] + steps[1] * (i // counts[0] % counts[1])
        p[2] = origin[2] + steps[2] * (i // (counts[0] * counts[1]))
        losses[i] = 0.0
        for j in range(len(window) - 1, -1, -apart):
            r = window[j].d - linearized_tdoa(
                p, anchors[window[j].a].position, anchors[window[j].b].position, row
            )
            losses[i] += geman_mcclure_loss(r / math.sqrt(1.0 + ageing[j]), GRID_LOSS * step)
    for place in range(len(places)):
        i = int(np.argmin(losses))
        if losses[i] == np.inf:
            return place
        places[place, 0] = origin[0] + steps[0] * (i % counts[0])
        places[place, 1] = origin[1] + steps[1] * (i // counts[0] % counts[1])
        places[place, 2] = origin[2] + steps[2] * (i // (counts[0] * counts[1]))
        for other in range(len(losses)):
            away = (origin[0] + steps[0] * (other % counts[0]) - places[place, 0]) ** 2
            away += (
                origin[1] + steps[1] * (other // counts[0] % counts[1]) - places[place, 1]
            ) ** 2
            if away < (GRID_APART * step) ** 2:
                losses[other] = np.inf
    return len(places)


@compiled
def split(places: Places) -> None:
    """Where there is a single one of two places, and it is less known than APART along any
    direction, fill in two of equal probability that have the same mean and covariance together:
    TDOAs are as curved there as the anchors are far.
    """
    x, covariance, cost = places.x, places.covariance, places.cost
    axis, variance = np.empty(3), 0.0
    for start in range(
        3
    ):  # power iteration; the principal axis is not normal to all axes of the world
        trial, its = np.zeros(3), 0.0
        trial[start] = 1.0
        for _ in range(30):
            trial[:] = np.array([np.sum(covariance[0, i, :3] * trial) for i in range(3)])
            its = math.sqrt(np.sum(trial**2))
            trial /= max(its, SMALLEST)
        if its > variance:
            axis[:], variance = trial, its
    if cost[1] < np.inf or variance < APART**2:
        return
    step, cost[1] = np.empty(6), cost[0]
    for i in range(6):  # the velocity goes along, as far as it is correlated
        step[i] = SPLIT / math.sqrt(variance) * np.sum(covariance[0, i, :3] * axis)
    for i in range(6):
        for j in range(6):
            covariance[0, i, j] -= step[i] * step[j]
    x[1], covariance[1] = x[0], covariance[0]
    x[0] -= step
    x[1] += step


@compiled
def share_of_inliers(window: np.ndarray, anchors: np.ndarray, x: np.ndarray) -> float:
    """Share of the window's TDOAs that agree with position and velocity x (6,) at its end, 0 to 1."""
    return float(np.mean(inliers(window, anchors, x)))


@compiled
def inliers(window: np.ndarray, anchors: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(n,) bool, which of the window's TDOAs agree with position and velocity x (6,) at its end."""
    residuals = np.empty(len(window))
    _normal_equations(
        window, anchors, x, np.zeros(len(window)), NO_SCALE, np.empty((6, 7)), residuals
    )
    return np.abs(residuals) < INLIER


@compiled
def level(accel: np.ndarray, yaw: float, x: np.ndarray) -> None:
    """Write to x the attitude in which `accel` (3,), the mean specific force, points up, and which
    has this yaw.
    """
    roll = math.atan2(accel[1], accel[2])
    pitch = math.atan2(-accel[0], math.hypot(accel[1], accel[2]))
    cr, sr, cp, sp = (
        math.cos(roll / 2),
        math.sin(roll / 2),
        math.cos(pitch / 2),
        math.sin(pitch / 2),
    )
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    x[6] = sr * cp * cy - cr * sp * sy
    x[7] = cr * sp * cy + sr * cp * sy
    x[8] = cr * cp * sy - sr * sp * cy
    x[9] = cr * cp * cy + sr * sp * sy


@compiled
def _step(
    trial: np.ndarray, system: np.ndarray, prior_information: np.ndarray, mean: np.ndarray
) -> None:
    """One Gauss-Newton step of `trial` (6,), with a prior about `mean` (6,)."""
    for k in range(6):
        system[k, k] += prior_information[k]
        system[k, 6] += prior_information[k] * (mean[k] - trial[k])
    solve(system)
    step = system[:, 6]
    length = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
    trial += min(1.0, LONGEST_STEP / max(length, 1e-9)) * step


@compiled
def _normal_equations(
    window: np.ndarray,
    anchors: np.ndarray,
    x: np.ndarray,
    ageing: np.ndarray,
    scale: float,
    system: np.ndarray,
    residuals: np.ndarray,
) -> float:
    """Weighted normal equations of the window at x (6,): information matrix and gradient to
    `system` (6, 7).

    ageing : (n,) variance of where the tag was, per axis, beyond what x says, over that of a TDOA,
        by which its residual counts less.
    Returns the mean Geman-McClure loss, 0 to 1; writes the residuals (n,), m.
    """
    system[:, :] = 0.0
    loss, n = 0.0, len(window)
    p, row = np.empty(3), np.empty(6)
    for i in range(n):
        tdoa = window[i]
        tau = tdoa.t - window[n - 1].t
        for k in range(3):
            p[k] = x[k] + tau * x[3 + k]
        r = tdoa.d - linearized_tdoa(p, anchors[tdoa.a].position, anchors[tdoa.b].position, row)
        if ageing[i] > 0.0:
            share = 1.0 / math.sqrt(1.0 + ageing[i] * (row[0] ** 2 + row[1] ** 2 + row[2] ** 2))
            r *= share
            for k in range(3):
                row[k] *= share
        for k in range(3):
            row[3 + k] = tau * row[k]
        residuals[i] = r
        w = weight(GEMAN_MCCLURE, r, scale)
        loss += geman_mcclure_loss(r, scale)
        for k in range(6):
            for j in range(6):
                system[k, j] += w * row[k] * row[j]
            system[k, 6] += w * row[k] * r
    return loss / n
