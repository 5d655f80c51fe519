# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Position and velocity of a tag from a short window of TDOAs.

The search starts in the middle of the workspace and around it. If a tag hears few TDOAs, the window
is longer than usual. Older TDOAs then count less, because the tag may have accelerated since.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.geometry import linearized_tdoa
from uwb_tdoa_bias.common.robust_loss import GEMAN_MCCLURE, geman_mcclure_loss, weight

from .ground import SPEED, KnownHeight, inverse, solve
from .hypotheses import IMPROBABLE
from .workspace import configured_side, principal_axis, reflect, rows_heard

# starts: the middle of the workspace, and the corners of the half-size box around it
CORNERS = np.array([[x, y, z] for z in (-0.5, 0.5) for y in (-0.5, 0.5) for x in (-0.5, 0.5)])
STARTS = np.concatenate((np.zeros((1, 3)), CORNERS))  # in units of half the workspace
SWEEPS = 14  # Gauss-Newton steps per start
COARSE, FINE = 5.0, 0.5  # m, scale of the Geman-McClure loss at the first and the last steps
LONGEST_STEP = 2.0  # m, longest change of the position in a Gauss-Newton step
INLIER = 0.75  # m; a smaller residual agrees with a position
NO_SCALE = 1e6  # m, scale of a loss that is quadratic in practice
APART = 1.0  # m between two places; also the standard deviation above which a place is split
SPLIT = 0.8  # standard deviations from the middle of a place to each half after a split


class Places(NamedTuple):
    """Places where a tag may be, with their probabilities.

    x : (k, 6) positions (m) and velocities (m/s), world frame, or (k, 3) positions. covariance :
    (k, 6, 6), or (k, 3, 3). cost : (k,), minus the logarithm of each probability, up to a constant;
    inf for an unused place.
    """

    x: np.ndarray
    covariance: np.ndarray
    cost: np.ndarray


@compiled
def room_for(count: int) -> Places:
    """Return `count` Places to be filled in."""
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
    """Estimate the position and velocity of a tag by robust multilateration over a window.

    The tag moves at constant velocity. The method is graduated Geman-McClure: Gauss-Newton from
    several starts while the loss narrows. The start with the least final loss wins. The prior is
    that a tag is in its workspace and slow. Without this prior, late arrivals on a floor are
    explained best by a tag ten metres up. The covariance counts one independent error per heard
    anchor, not per TDOA, because errors persist over the window. It grows with the remaining
    residuals.

    Parameters
    ----------
    window : (n,) TDOA
        TDOAs, by rising stamp.
    anchors : (N,) ANCHOR
        All anchors, by row.
    workspace : (2, 3) array
        Lower and upper bounds, m, world frame, see workspace.py.
    parameters : PARAMETERS
        Tuning of the filter.
    height : KnownHeight
        Height by another sensor.
    places : Places
        Filled with places at the last stamp, the most probable first, then others that are APART.
        Costs are relative to the first.

    Returns
    -------
    float
        Share of TDOAs that agree with the first place, 0 to 1.
    """
    x, covariance, cost = places.x, places.covariance, places.cost
    std, ageing = parameters.tdoa_std, np.zeros(len(window))
    for i in range(len(window)):
        age = max(0.0, window[len(window) - 1].t - window[i].t - parameters.start_window)
        ageing[i] = parameters.motion_noise**2 * age**3 / 3.0 / std**2
    mean, prior_std = np.zeros(6), np.full(6, SPEED)
    mean[:3] = 0.5 * (workspace[0] + workspace[1])
    prior_std[:3] = 0.5 * (workspace[1] - workspace[0])
    if not math.isnan(height.z):
        mean[2], prior_std[2], prior_std[5] = height.z, height.std, SPEED
    prior_information = 1.0 / prior_std**2
    rows = rows_heard(window)
    correlation_length = max(1.0, len(window) / max(1.0, len(rows) - 1.0))
    trials, losses = np.empty((len(STARTS), 6)), np.empty(len(STARTS))
    residuals, system = np.zeros(len(window)), np.zeros((6, 7))
    side = configured_side(rows, anchors, parameters.tag_side)
    for start in range(len(STARTS)):
        trial = trials[start]
        trial[:] = mean
        trial[:3] += STARTS[start] * prior_std[:3]
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
        covariance[place] = inverse(system[:, :6]) * variance
        if place == 0:
            share = float(np.mean(np.abs(residuals) < INLIER))
        for other in range(len(STARTS)):
            if np.sum((trials[other, :3] - x[place, :3]) ** 2) < APART**2:
                losses[other] = np.inf
    return share


@compiled
def anywhere(workspace: np.ndarray, x: np.ndarray, covariance: np.ndarray) -> None:
    """Fill in the state x (6,) and covariance (6, 6) of a tag anywhere in its workspace (2, 3), m.

    Both must be 0 before.
    """
    for k in range(3):
        x[k] = 0.5 * (workspace[0, k] + workspace[1, k])
        covariance[k, k] = (0.5 * (workspace[1, k] - workspace[0, k])) ** 2
        covariance[3 + k, 3 + k] = SPEED**2


@compiled
def split(places: Places) -> None:
    """Split an uncertain place into two places of equal probability.

    This applies to a single place with a standard deviation above APART along any direction. Mean
    and covariance of both together stay the same. Over such distances the TDOA model may be
    nonlinear: its curvature depends on the distance to the anchors.
    """
    x, covariance, cost = places.x, places.covariance, places.cost
    axis = np.empty(3)
    variance = principal_axis(covariance[0, :3, :3], axis)
    if cost[1] < np.inf or variance < APART**2:
        return
    step, cost[1] = np.empty(6), cost[0]
    for i in range(6):  # the velocity moves too, in proportion to its correlation
        step[i] = SPLIT / math.sqrt(variance) * np.sum(covariance[0, i, :3] * axis)
    covariance[0] -= np.outer(step, step)
    x[1], covariance[1] = x[0], covariance[0]
    x[0] -= step
    x[1] += step


@compiled
def inliers(window: np.ndarray, anchors: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Return (n,) bool: which TDOAs of a window agree with a state at its end.

    x is position (m) and velocity (m/s), (6,), world frame.
    """
    residuals = np.empty(len(window))
    _normal_equations(
        window, anchors, x, np.zeros(len(window)), NO_SCALE, np.empty((6, 7)), residuals
    )
    return np.abs(residuals) < INLIER


@compiled
def level(accel: np.ndarray, yaw: float, x: np.ndarray) -> None:
    """Set the attitude of a nominal state from the mean specific force and a yaw.

    Parameters
    ----------
    accel : (3,) array
        Mean specific force, m/s^2, body frame. It points up in the world.
    yaw : float
        Yaw, rad.
    x : (16,) array
        Nominal state; its quaternion is set.
    """
    roll = math.atan2(accel[1], accel[2])
    pitch = math.atan2(-accel[0], math.hypot(accel[1], accel[2]))
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    x[6] = sr * cp * cy - cr * sp * sy
    x[7] = cr * sp * cy + sr * cp * sy
    x[8] = cr * cp * sy - sr * sp * cy
    x[9] = cr * cp * cy + sr * sp * sy


@compiled
def _step(
    trial: np.ndarray, system: np.ndarray, prior_information: np.ndarray, mean: np.ndarray
) -> None:
    """Apply a Gauss-Newton step to `trial` (6,), with a prior about `mean` (6,)."""
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
    """Compute the weighted normal equations of a window at a state, and return the loss.

    Parameters
    ----------
    window : (n,) TDOA
        TDOAs, by rising stamp.
    anchors : (N,) ANCHOR
        All anchors, by row.
    x : (6,) array
        Position (m) and velocity (m/s) at the last stamp, world frame.
    ageing : (n,) array
        Ratio of two variances: position of the tag per axis beyond x, and TDOA. It reduces the
        weight.
    scale : float
        Scale of the Geman-McClure loss, m.
    system : (6, 7) array
        Information matrix and gradient. Filled.
    residuals : (n,) array
        Residuals, m. Filled.

    Returns
    -------
    float
        Mean Geman-McClure loss, 0 to 1.
    """
    system[:, :] = 0.0
    loss, n = 0.0, len(window)
    p, row = np.empty(3), np.empty(6)
    for i in range(n):
        tdoa = window[i]
        tau = tdoa.t - window[n - 1].t
        p[:] = x[:3] + tau * x[3:]
        r = tdoa.d - linearized_tdoa(p, anchors[tdoa.a].position, anchors[tdoa.b].position, row)
        if ageing[i] > 0.0:
            share = 1.0 / math.sqrt(1.0 + ageing[i] * (row[0] ** 2 + row[1] ** 2 + row[2] ** 2))
            r *= share
            row[:3] *= share
        row[3:] = tau * row[:3]
        residuals[i] = r
        w = weight(GEMAN_MCCLURE, r, scale)
        loss += geman_mcclure_loss(r, scale)
        for k in range(6):
            for j in range(6):
                system[k, j] += w * row[k] * row[j]
            system[k, 6] += w * row[k] * r
    return loss / n
