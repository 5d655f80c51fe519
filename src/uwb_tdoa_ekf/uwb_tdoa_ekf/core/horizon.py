# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Moving horizon estimate of a tag that sends few TDOAs and has no other sensor, or a quiet IMU.

Between two TDOAs such a tag moves by metres. A TDOA is not linear over such a distance, so an update
of a prediction is often wrong. The last ROOM TDOAs are therefore linearized again with each new TDOA,
on the path that they determine together (Rao, Rawlings and Mayne, Constrained state estimation for
nonlinear discrete-time systems: stability and moving horizon approximations, IEEE Trans. Automatic
Control 48, 2003). The pass over the window is an iterated Kalman smoother (B. Bell, The iterated Kalman
smoother as a Gauss-Newton method, SIAM J. Optimization 4, 1994). What earlier TDOAs determine is the
state before the window.

Several models of the motion run in parallel, from a tag at rest to a racing drone. Their estimates
are mixed by the likelihood of recent TDOAs (multiple model estimation: Bar-Shalom et al., Estimation
with Applications to Tracking and Navigation, 2001, section 11.6.2).

`smooth` runs the same models over a whole recording.
"""

from __future__ import annotations

import math

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.geometry import linearized_tdoa
from uwb_tdoa_bias.common.robust_loss import GEMAN_MCCLURE, HUBER, weight

from . import hypotheses
from .initialization import last_few, recent
from .memory import LINEARIZATION, MODEL, MODELS, ODOMETRY, OFF, ROOM, RUNNING, STEP
from .startup import anywhere
from .workspace import prior_of

# Each model: random acceleration as a share of motion_noise, from a racing drone to a tag at rest, and
# time in s after which its velocity has faded to 1/e: people turn within seconds, vehicles drive on.
SHARES = np.array([4.0, 1.0, 0.5, 0.25, 0.25, 0.1, 0.1, 0.03, 0.01])
FADING = np.array([6.0, 6.0, 6.0, 6.0, 60.0, 6.0, 60.0, 6.0, 6.0])
MEMORY = 5.0  # s of TDOAs that decide between the models
# TDOAs in the last second below which the horizon begins, and above which it ends
BEGINS, ENDS = (30, 45)
ALONE = 5.0  # s without another sensor after which a tag counts as alone
QUIET = 1.0  # s after which a quiet tag does: its inertial sensor does not show where it is
# passes over the window with a new TDOA, at the begin, over a recording, and last ones over it
PASSES, FIRST, ALL, LAST = (2, 10, 15, 5)
# standard deviations at which the loss of each model bends: a fast tag also moves by much
BENDS = np.array([12.0, 12.0, 12.0, 8.0, 8.0, 6.0, 6.0, 6.0, 6.0])
NEAR = 4.0  # the same of a convex loss, with which a path over a recording finds its side of the anchors
LARGEST_NIS = 9.0  # normalized innovation squared; limits the effect of an outlier on the choice
# Noise of a model: number of TDOAs for which tdoa_std counts, share of a new value, largest
# normalized innovation squared, least standard deviation in m.
PRIOR_TDOAS, NEW, LARGEST_FIT, LEAST_STD = (4.0, 0.2, 9.0, 0.02)


@compiled
def step(ekf: Record, anchors: np.ndarray, parameters: Record, t: float) -> None:
    """Set the filter to the estimate of the horizon, after an update with the newest TDOA.

    Nothing happens if the tag is not alone, rests, or sends many TDOAs.

    Parameters
    ----------
    ekf : EKF
        State of the filter, updated in place.
    anchors : (N,) ANCHOR
        All anchors, by row.
    parameters : PARAMETERS
        Tuning of the filter.
    t : float
        Stamp, s.
    """
    horizon, best, passes = ekf.horizon, ekf.hypotheses[ekf.best], PASSES
    bounds = within(ekf.workspace, parameters, ekf.height.ignore_time > 0.0)
    most = ENDS if horizon.state == RUNNING else BEGINS
    if (
        not (parameters.adapt_noise and parameters.recover)
        or ekf.resting
        or not _is_alone(ekf, parameters, t)
        or len(recent(ekf, 1.0)) > most
    ):
        horizon.state = OFF
        return
    if horizon.state == OFF:
        _begin(horizon, parameters, t, best.x[:6], best.P[:6, :6])
        horizon.state = RUNNING
        return
    if horizon.state == RUNNING:
        _add(ekf, anchors, parameters, bounds)
    else:
        _begin_anew(ekf, parameters, bounds)
        passes = FIRST
    horizon.state = RUNNING
    n, scores = horizon.count, np.empty(MODELS)
    window, steps = ekf.window[ekf.kept - n : ekf.kept], horizon.steps[:n]
    no_rows = np.empty(0, ODOMETRY)
    for m in range(MODELS):
        model, motion = horizon.models[m], _motion(m, parameters)
        at = model.at[:n]
        for _ in range(passes):
            _forward(model, window, anchors, motion, bounds, at, steps)
            _backward(steps, at, no_rows)
            _weigh(GEMAN_MCCLURE, BENDS[m] * model.std, window, anchors, at)
            # an outlier moves the end of the path, so the residual to the path does not show it
            last, scale = steps[n - 1], BENDS[m] * math.sqrt(steps[n - 1].unweighted)
            by_innovation = weight(GEMAN_MCCLURE, last.tdoa.innovation, scale)
            at[n - 1].weight = min(at[n - 1].weight, by_innovation)
        scores[m], fit = _judge(window, steps)
        _learn_noise(model, n, fit, parameters.tdoa_std)
    _mix(ekf, scores, parameters.tdoa_std, max(ekf.extent[1, 2], bounds[0, 2]))


@compiled
def within(workspace: np.ndarray, parameters: Record, left_height: bool) -> np.ndarray:
    """Return a workspace (2, 3), m; of a tag that has not left its fixed height, only this height."""
    bounds = workspace.copy()
    if parameters.planar or (parameters.fixed_height_std > 0.0 and not left_height):
        bounds[:, 2] = parameters.fixed_height
    return bounds


@compiled
def _motion(m: int, parameters: Record) -> tuple[float, float, float]:
    """Return the motion of model m, as `_forward` takes it."""
    power = (SHARES[m] * parameters.motion_noise) ** 2
    return power, FADING[m], parameters.fixed_height_std


@compiled
def _is_alone(ekf: Record, parameters: Record, t: float) -> bool:
    """Return whether only TDOAs show the motion: no other sensor was heard lately, or it is quiet."""
    since = max(ekf.velocity.heard, ekf.height.heard, ekf.barometer.heard, ekf.ranged[0].t)
    if parameters.use_imu and t - ekf.shaken < QUIET:
        return False
    return t - since > ALONE


@compiled
def _begin(
    horizon: Record, parameters: Record, t: float, x: np.ndarray, covariance: np.ndarray
) -> None:
    """Begin without TDOAs, at a state x (6,) and its covariance (6, 6) at stamp t (s)."""
    horizon.count = 0
    for m in range(MODELS):
        model = horizon.models[m]
        model.t, model.std = t, parameters.tdoa_std
        model.x[:], model.end[:] = x, x
        model.P[:, :] = covariance


@compiled
def _begin_anew(ekf: Record, parameters: Record, bounds: np.ndarray) -> None:
    """Begin with the TDOAs of a start, anywhere in bounds (2, 3), m, linearized at its position."""
    window, horizon = last_few(ekf), ekf.horizon
    n = min(len(window), ROOM)
    x, covariance = np.zeros(6), np.zeros((6, 6))
    anywhere(bounds, x, covariance)
    _begin(horizon, parameters, window[len(window) - n].t, x, covariance)
    horizon.count = n
    for m in range(MODELS):
        for k in range(n):
            place = horizon.models[m].at[k]
            place.weight = 1.0
            place.p[:] = ekf.hypotheses[ekf.best].x[:3]


@compiled
def _add(ekf: Record, anchors: np.ndarray, parameters: Record, bounds: np.ndarray) -> None:
    """Add the newest TDOA to the window; the oldest one moves into the state before the window."""
    horizon, n = ekf.horizon, ekf.horizon.count
    newest, full = ekf.window[ekf.kept - 1], n == ROOM
    for m in range(MODELS):
        model = horizon.models[m]
        dt = newest.t - (ekf.window[ekf.kept - 2].t if n > 0 else model.t)
        p = model.end[:3] + dt * model.end[3:]
        if full:
            motion = _motion(m, parameters)
            oldest = ekf.window[ekf.kept - 1 - n : ekf.kept - n]
            _forward(model, oldest, anchors, motion, bounds, model.at, horizon.steps)
            model.t, model.x[:] = oldest[0].t, model.end
            model.P[:, :] = model.end_P
            for k in range(ROOM - 1):
                model.at[k] = model.at[k + 1]
        place = model.at[ROOM - 1 if full else n]
        place.weight, place.p[:] = 1.0, p
    horizon.count = n if full else n + 1


@compiled
def _forward(
    model: Record,
    window: np.ndarray,
    anchors: np.ndarray,
    motion: tuple[float, float, float],
    bounds: np.ndarray,
    at: np.ndarray,
    steps: np.ndarray,
) -> None:
    """Run the Kalman filter of a model over a window; its state at the end becomes model.end.

    Parameters
    ----------
    model : MODEL
        State before the window, and noise.
    window : (n,) TDOA
        TDOAs, by rising stamp.
    anchors : (N,) ANCHOR
        All anchors, by row.
    motion : tuple
        Power of the random acceleration, m^2/s^3, time in s in which the velocity fades, and standard
            deviation of a known height, m.
    bounds : (2, 3) array
        Workspace, m, world frame, from `within`.
    at : (n,) LINEARIZATION
        Where each TDOA is linearized, and its robust weight.
    steps : (n,) STEP
        Filled.
    """
    x, P, t = model.end, model.end_P, model.t
    x[:] = model.x
    P[:, :] = model.P
    for i in range(len(window)):
        tdoa, one = window[i], steps[i]
        a, b, update, p = anchors[tdoa.a], anchors[tdoa.b], one.tdoa, at[i].p
        _predict(x, P, tdoa.t - t, motion, one)
        t = tdoa.t
        for k in range(3):
            _bound(x, P, bounds, motion[2], k, one.bounds[k])
        one.x[:] = x
        one.P[:, :] = P
        row = update.jacobian
        update.innovation = tdoa.d - linearized_tdoa(p, a.position, b.position, row)
        row[3:] = 0.0
        for k in range(3):
            update.innovation -= row[k] * (x[k] - p[k])
        noise = model.std**2 + tdoa.variance + a.delay_variance + b.delay_variance
        noise += a.excess_variance + b.excess_variance
        one.unweighted = noise - noise / at[i].weight
        _update(x, P, noise / at[i].weight, update)
        one.unweighted += update.variance


@compiled
def _update(x: np.ndarray, P: np.ndarray, noise: float, update: Record) -> None:
    """Update a state x (6,) and covariance P (6, 6) with an UPDATE; gain and variance are filled in.

    noise is the variance of the measurement, m^2.
    """
    row, gain, update.variance = update.jacobian, update.gain, noise
    for j in range(6):
        gain[j] = P[j, 0] * row[0] + P[j, 1] * row[1] + P[j, 2] * row[2]
    for k in range(3):
        update.variance += row[k] * gain[k]
    for j in range(6):
        gain[j] /= update.variance
    for j in range(6):
        x[j] += gain[j] * update.innovation
        for k in range(6):
            P[j, k] -= gain[j] * gain[k] * update.variance


@compiled
def _predict(
    x: np.ndarray, P: np.ndarray, dt: float, motion: tuple[float, float, float], one: Record
) -> None:
    """Predict a state x (6,) and covariance P (6, 6) over dt (s) with a velocity that fades.

    White acceleration drives the velocity (an Ornstein-Uhlenbeck process). motion is as for `_forward`.
    The transition is stored in a STEP.
    """
    psd, fading = motion[0], motion[1]
    kept = math.exp(-dt / fading)
    way = fading * (1.0 - kept)
    one.kept, one.way = kept, way
    for k in range(3):
        x[k] += way * x[3 + k]
        x[3 + k] *= kept
        for j in range(6):
            P[k, j] += way * P[3 + k, j]
            P[3 + k, j] *= kept
    for k in range(3):
        for j in range(6):
            P[j, k] += way * P[j, 3 + k]
            P[j, 3 + k] *= kept
    for k in range(3):
        P[k, k] += psd * dt**3 / 3.0
        P[k, 3 + k] += psd * dt**2 / 2.0
        P[3 + k, k] += psd * dt**2 / 2.0
        P[3 + k, 3 + k] += psd * dt


@compiled
def _bound(
    x: np.ndarray, P: np.ndarray, bounds: np.ndarray, of_height: float, axis: int, update: Record
) -> None:
    """Apply the prior of the workspace to x (6,) and P (6, 6), as `workspace.constrain` does.

    of_height is the standard deviation of a known height, m.
    """
    place, std = prior_of(bounds, x, axis)
    if bounds[0, axis] == bounds[1, axis]:
        std = of_height
    update.variance = 0.0
    if P[axis, axis] > std**2:
        update.jacobian[:] = 0.0
        update.jacobian[axis], update.innovation = 1.0, place - x[axis]
        _update(x, P, std**2, update)


@compiled
def _backward(steps: np.ndarray, at: np.ndarray, rows: np.ndarray) -> tuple[float, float]:
    """Linearize at the smoothed path, by the modified Bryson-Frazier recursion of smoother.py.

    Parameters
    ----------
    steps : (n,) STEP
        From `_forward`.
    at : (n,) LINEARIZATION
        The positions are replaced.
    rows : (n,) ODOMETRY
        Position, velocity and their covariance are filled in. Empty: no covariance is computed.

    Returns
    -------
    tuple
        Minus the log likelihood of each TDOA given all others, and the mean of the normalized
            squared residual; 0 without rows.
    """
    adjoint, information = np.zeros(6), np.zeros((6, 6))
    scratch, loss, fit = np.zeros(6), 0.0, 0.0
    whole = len(rows) > 0
    for i in range(len(steps) - 1, -1, -1):
        one = steps[i]
        factor, of_information = through_update(one.tdoa, adjoint, information, whole, scratch)
        for k in range(3):
            p = one.x[k]
            for j in range(6):
                p -= one.P[k, j] * adjoint[j]
            at[i].p[k] = p
        if whole:
            nis = factor**2 / of_information
            loss += 0.5 * (min(nis, LARGEST_NIS) - math.log(of_information))
            fit += min(nis, LARGEST_FIT) / len(steps)
            rows[i].x[:6] = one.x - np.sum(one.P * adjoint, axis=1)
            for j in range(6):
                scratch[:] = np.sum(information * one.P[j], axis=1)
                for k in range(6):
                    rows[i].covariance[j, k] = one.P[j, k] - np.sum(one.P[k] * scratch)
        for k in range(2, -1, -1):
            if one.bounds[k].variance > 0.0:
                through_update(one.bounds[k], adjoint, information, whole, scratch)
        for k in range(3):  # Phi' adjoint and Phi' information Phi
            adjoint[3 + k] = one.way * adjoint[k] + one.kept * adjoint[3 + k]
        if whole:
            information[3:] = one.way * information[:3] + one.kept * information[3:]
            information[:, 3:] = one.way * information[:, :3] + one.kept * information[:, 3:]
    return loss, fit


@compiled
def through_update(
    update: Record, adjoint: np.ndarray, information: np.ndarray, whole: bool, scratch: np.ndarray
) -> tuple[float, float]:
    """Step adjoint (n,) and, if `whole`, information (n, n) backwards through a scalar update.

    The update is an UPDATE of the horizon or a RECORD of the history. The equations are lambda <- C'
    lambda - h' y / S and Lambda <- C' Lambda C + h' h / S with C = I - K h. In the code:

    - lambda, Lambda: adjoint, information
    - h, K: update.jacobian, update.gain
    - y, S: update.innovation and its update.variance

    Return the residual of the measurement to the estimate by all others, and its variance, each over
    the variance: u = K' lambda + y / S and M = K' Lambda K + 1 / S. scratch (n,) is overwritten.
    """
    row, gain, n = update.jacobian, update.gain, len(update.gain)
    u, M = update.innovation / update.variance, 1.0 / update.variance
    for j in range(n):
        u += gain[j] * adjoint[j]
    for j in range(n):
        adjoint[j] -= u * row[j]
    if whole:
        scratch[:] = np.sum(information * gain, axis=1)  # Lambda K
        M += np.sum(gain * scratch)
        for j in range(n):
            for k in range(n):
                information[j, k] += M * row[j] * row[k] - row[j] * scratch[k] - scratch[j] * row[k]
    return u, M


@compiled
def _weigh(
    loss: int, scale: float, window: np.ndarray, anchors: np.ndarray, at: np.ndarray
) -> None:
    """Set the robust weight of each TDOA by its residual to the path; the loss bends at scale, m."""
    row = np.empty(3)
    for i in range(len(window)):
        a, b = anchors[window[i].a].position, anchors[window[i].b].position
        off = window[i].d - linearized_tdoa(at[i].p, a, b, row)
        at[i].weight = weight(loss, off, scale)


@compiled
def _judge(window: np.ndarray, steps: np.ndarray) -> tuple[float, float]:
    """Return log likelihood of recent innovations, and the mean normalized innovation squared."""
    score, fit, n = 0.0, 0.0, len(window)
    for i in range(n):
        one = steps[i]
        nis = min(one.tdoa.innovation**2 / one.unweighted, LARGEST_NIS)
        recency = math.exp((window[i].t - window[n - 1].t) / MEMORY)
        score -= 0.5 * recency * (nis + math.log(one.unweighted))
        fit += min(nis, LARGEST_FIT) / n
    return score, fit


@compiled
def _learn_noise(model: Record, n: int, fit: float, prior: float) -> None:
    """Update the noise of a MODEL by the mean normalized innovation squared of n TDOAs.

    The prior tdoa_std (m) is also the largest value: `noise.learn` adds what an anchor has beyond it.
    """
    found = (PRIOR_TDOAS * prior**2 + n * model.std**2 * fit) / (PRIOR_TDOAS + n)
    std = math.sqrt((1.0 - NEW) * model.std**2 + NEW * found)
    model.std = min(max(std, LEAST_STD), prior)


@compiled
def _mix(ekf: Record, scores: np.ndarray, tdoa_std: float, top: float) -> None:
    """Set all hypotheses to the mean of the models, weighted by exp(scores), (MODELS,).

    Random acceleration and noise become their means, too; tdoa_std is in m. top is that of `_doubt_height`.
    """
    weights = np.exp(scores - np.max(scores))
    weights /= np.sum(weights)
    x, covariance, power, ratio = np.zeros(6), np.zeros((6, 6)), 0.0, 0.0
    for m in range(MODELS):
        x += weights[m] * ekf.horizon.models[m].end
        power += weights[m] * SHARES[m] ** 2
        ratio += weights[m] * (ekf.horizon.models[m].std / tdoa_std) ** 2
    for m in range(MODELS):
        model = ekf.horizon.models[m]
        apart = model.end - x
        covariance += weights[m] * (model.end_P + np.outer(apart, apart))
    _doubt_height(x, covariance, top)
    ekf.motion_ratio, ekf.noise_ratio = power, ratio
    hypotheses.set_states(ekf, x, covariance)


@compiled
def smooth(
    tdoas: np.ndarray,
    anchors: np.ndarray,
    parameters: np.ndarray,
    bounds: np.ndarray,
    begins: np.ndarray,
) -> np.ndarray:
    """Return smoothed estimates (n,) of ODOMETRY at the stamps of all TDOAs of a tag alone.

    Parameters
    ----------
    tdoas : (n,) TDOA
        Corrected TDOAs, by rising stamp.
    anchors : (N,) ANCHOR
        All anchors, by row.
    parameters : (1,) PARAMETERS
        Tuning of the filter.
    bounds : (2, 3) array
        Workspace, m, world frame.
    begins : (k, n, 3) array
        Paths on which the TDOAs are linearized first, m, world frame. The result is a mean of the
        paths to which they lead, weighted by their likelihood.
    """
    n, prior, count = len(tdoas), parameters[0].tdoa_std, len(begins) * MODELS
    steps, at = np.empty(n, STEP), np.empty(n, LINEARIZATION)
    models, rows, losses = np.zeros(count, MODEL), np.zeros((count, n), ODOMETRY), np.empty(count)
    for m in range(count):
        model, motion = models[m], _motion(m % MODELS, parameters[0])
        model.t, model.std = tdoas[0].t, prior
        anywhere(bounds, model.x, model.P)
        for i in range(n):
            at[i].weight, at[i].p[:] = 1.0, begins[m // MODELS, i]
        for sweep in range(1, ALL + LAST + 1):
            _forward(model, tdoas, anchors, motion, bounds, at, steps)
            loss, fit = _backward(steps, at, rows[m])
            if sweep == ALL:
                losses[m] = loss
            if sweep < ALL:
                _weigh(HUBER, NEAR * model.std, tdoas, anchors, at)
            else:
                _weigh(GEMAN_MCCLURE, BENDS[m % MODELS] * model.std, tdoas, anchors, at)
            _learn_noise(model, n, fit, prior)
    weights = np.exp(np.min(losses) - losses)
    weights /= np.sum(weights)
    out, top = np.zeros(n, ODOMETRY), bounds[0, 2]
    for anchor in anchors:
        top = max(top, anchor.position[2])
    for i in range(n):
        out[i].t = tdoas[i].t
        for m in range(count):
            out[i].x[:6] += weights[m] * rows[m, i].x[:6]
        for m in range(count):
            apart = rows[m, i].x[:6] - out[i].x[:6]
            covariance = rows[m, i].covariance[:6, :6] + np.outer(apart, apart)
            out[i].covariance[:6, :6] += 0.5 * weights[m] * (covariance + covariance.T)
        _doubt_height(out[i].x, out[i].covariance, top)
    return out


@compiled
def _doubt_height(x: np.ndarray, covariance: np.ndarray, top: float) -> None:
    """Add the height of a tag above `top`, m, to the standard deviation of z.

    `top` is the height of the highest anchor, or a known height of the tag above it.

    Late anchors near the ground, which these models do not know, lift a tag above all anchors.
    """
    covariance[2, 2] += max(0.0, x[2] - top) ** 2
