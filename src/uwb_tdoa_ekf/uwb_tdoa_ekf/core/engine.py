"""The compiled filter: events in stamp order in, odometry and residuals out. Everything it remembers is in Memory."""

import math

import numpy as np

from uwb_tdoa_bias.foundation.compiled import compiled, inlined

from . import hypotheses, inertial, noise
from .memory import (
    AGREEMENT, BEST, FIRST_TDOA, FORCE, GYRO, HYPOTHESES, KEPT, LAST_IMU, LAST_TDOA, MEAN_FORCE, NEXT_ODOMETRY,
    NEXT_REST, NEXT_TRY, NOW, QUIET, RECOVERIES, RUNNING, WINDOW,
)  # fmt: skip
from .robust import gain_terms, kalman, predicted, update_gate, update_innovation, update_m_estimation
from .startup import INLIER, believable, level, locate, reach, share_of_inliers
from .state import GRAVITY, coast, predict
from .tape import REPLACED, UPDATE, note_coast, note_prediction, note_update

# verdict on one TDOA; the values of TdoaResidual.VERDICT_*
USED, REJECTED, LATE, INVALID, STARTUP = range(5)

MINIMUM = 12  # TDOAs a start needs
AGREE, AGREE_ANYHOW = 0.7, 0.6  # share of TDOAs that a start, and a restart, must explain
AGREEMENT_TIME = 0.3  # s, memory of how well the filter explains its TDOAs
RETRY = 0.1  # s between two attempts at a start
LOST_TIME = 60.0  # s without any message after which the filter starts anew
MAX_STEP = 0.05  # s, longest single prediction
START_TILT_STD = 0.1  # rad
STALE_TURN_PSD = 0.25  # (rad/s)^2/Hz while there is no gyroscope
REST_PERIOD, REST_STD = 0.05, 0.02  # s between, and m/s of, zero-velocity updates at rest
REST_SPEED = 0.05  # m/s; a quiet tag stands still if it is known to be slower: it might also glide
QUIET_NOISE = 0.01  # m/s^2/sqrt(Hz), of the accelerometer of a quiet tag
REACH_STD = 1.0  # m, doubt that a tag beyond reach is there, each time a TDOA says so


@compiled
def run(m, c, positions, imu_t, gyro, force, tdoa_t, a, b, d, bias_std, odometry, covariance, residuals, tape):
    """Feed events in stamp order.

    m : Memory; c : Tuning; positions (N, 3) m. imu_t (n,) s, gyro (n, 3) rad/s, force (n, 3) m/s^2. tdoa_t (k,) s,
    a, b (k,) anchor rows, d (k,) corrected m, bias_std (k,) m. Both rising, neither before what was fed earlier.
    Writes: odometry (>= n + k, 17) rows of stamp and state; covariance (>= n + k, 9, 9) of [p, v, attitude];
    residuals (k, 4) rows of innovation, its variance, weight, verdict; tape : Tape. Returns the number of odometry rows.
    """
    i = k = rows = 0
    while i < len(imu_t) or k < len(tdoa_t):
        if k == len(tdoa_t) or (i < len(imu_t) and imu_t[i] <= tdoa_t[k]):
            t = imu_t[i]
            _on_imu(m, c, t, gyro[i], force[i], tape)
            i += 1
        else:
            t = tdoa_t[k]
            _on_tdoa(m, c, positions, t, a[k], b[k], d[k], bias_std[k], residuals[k], tape)
            k += 1
        if m.clock[RUNNING] and t >= m.clock[NEXT_ODOMETRY]:
            m.clock[NEXT_ODOMETRY] = (math.floor(t * c.odometry_rate + 1e-6) + 1.0) / c.odometry_rate
            best = int(m.clock[BEST])
            odometry[rows, 0] = t
            odometry[rows, 1:] = m.x[best]
            covariance[rows] = m.P[best, :9, :9]
            hypotheses.add_doubt(m, covariance[rows])
            rows += 1
    return rows


@inlined
def _on_imu(m, c, t, gyro, force, tape):
    fresh = inertial.observe(m, t, gyro, force, c.imu_timeout)
    if m.clock[RUNNING]:
        _advance(m, c, t, tape)
        m.clock[QUIET] = c.zero_velocity and fresh and inertial.quiet(m)
        if m.clock[QUIET] and t >= m.clock[NEXT_REST]:
            m.clock[NEXT_REST] = t + REST_PERIOD
            _stand_still(m, t, tape)
    m.clock[LAST_IMU] = t
    for k in range(3):
        m.imu[GYRO, k], m.imu[FORCE, k] = gyro[k], force[k]


@inlined
def _advance(m, c, t, tape):
    """Predict every hypothesis to stamp t, with the inertial sample at hand or, if it is too old, without one."""
    if t - m.clock[NOW] > LOST_TIME:
        m.clock[RUNNING], m.clock[FIRST_TDOA], m.clock[NEXT_TRY] = 0.0, t, -np.inf
        return
    trust, psd, walk = m.S[0], m.S[1], m.S[2]  # scratch
    best = int(m.clock[BEST])
    sensed = c.use_imu and t - m.clock[LAST_IMU] < c.imu_timeout
    if sensed:
        for k in range(3):
            trust[k], error = inertial.trust(m, k, c.vibration_trust, c.vibration_gain)
            psd[k] = QUIET_NOISE**2 if m.clock[QUIET] else c.accel_noise**2 + 2.0 * inertial.PERSISTENCE * error
            walk[k] = c.accel_bias_walk**2
    while m.clock[NOW] < t:
        dt = min(t - m.clock[NOW], MAX_STEP)
        for h in range(HYPOTHESES):
            if m.belief[h] == -np.inf:
                continue
            if sensed:
                predict(
                    m.x[h], m.P[h], m.F, m.R, m.E, m.step, dt, m.imu[GYRO], m.imu[FORCE], trust, psd,
                    c.gyro_noise**2, walk, c.gyro_bias_walk**2,
                )  # fmt: skip
                if h == best:
                    note_prediction(tape, m)
            else:
                coast(m.x[h], m.P[h], dt, c.motion_noise**2, STALE_TURN_PSD if c.use_imu else 0.0)
                if h == best:
                    note_coast(tape, dt)
        m.clock[NOW] = t if t - m.clock[NOW] <= MAX_STEP else m.clock[NOW] + dt


@compiled
def _on_tdoa(m, c, positions, t, a, b, d, bias_std, residual, tape):
    _remember(m, t, a, b, d)
    if not m.clock[RUNNING]:
        residual[0] = residual[1] = np.nan
        residual[2], residual[3] = 0.0, STARTUP
        if t - m.clock[LAST_TDOA] > c.start_window:
            m.clock[FIRST_TDOA] = t
        m.clock[LAST_TDOA] = t
        waited = t - m.clock[FIRST_TDOA]
        if waited > 0.9 * c.start_window and t >= m.clock[NEXT_TRY]:
            _start(m, c, positions, t, waited > c.start_patience, tape)
        return
    _advance(m, c, t, tape)
    if not m.clock[RUNNING]:
        residual[0] = residual[1] = np.nan
        residual[2], residual[3] = 0.0, STARTUP
        return
    variance = c.tdoa_std**2 + bias_std**2
    if c.adapt_noise:
        variance += noise.excess_variance(m, a, b)
    best = int(m.clock[BEST])
    for h in range(HYPOTHESES):
        if m.belief[h] == -np.inf:
            continue
        innovation = d - predicted(m.x[h], positions[a], positions[b], m.g)
        spread = gain_terms(m.P[h], m.g, m.K)
        hypotheses.blame(m, h, innovation, spread + variance * c.tdoa_correlation)
        w, total = _update(m, c, m.x[h], m.P[h], innovation, spread, variance)
        if h == best:
            residual[0], residual[1], residual[2] = innovation, spread + variance, w
            residual[3] = USED if w > 0.0 else REJECTED
            if w > 0.0:
                note_update(tape, m, t, UPDATE, innovation, total, m.g, 0)
            if c.adapt_noise:
                noise.learn(m, t, a, b, innovation, spread, variance, c.tdoa_std, c.noise_memory)
    _stay_in_reach(m, t, tape)
    hypotheses.choose(m, t)
    agrees = 1.0 if abs(residual[0]) < INLIER else 0.0
    m.clock[AGREEMENT] += min(1.0, (t - m.clock[LAST_TDOA]) / AGREEMENT_TIME) * (agrees - m.clock[AGREEMENT])
    m.clock[LAST_TDOA] = t
    if c.recover and m.clock[AGREEMENT] < 0.5 and t >= m.clock[NEXT_TRY]:
        _recover(m, c, positions, t, tape)


@inlined
def _update(m, c, x, P, innovation, spread, variance):
    """One robust update; K = P g and spread are in m.K and at hand. Returns weight and total variance, m^2."""
    if c.robust == 0:
        return update_innovation(
            x, P, m.K, innovation, spread, variance, c.tdoa_correlation, c.loss, c.measurement_scale
        )
    if c.robust == 1:
        return update_gate(x, P, m.K, innovation, spread, variance, c.tdoa_correlation, c.gate)
    return update_m_estimation(
        x, P, m.S, m.K, m.g, innovation, variance, c.tdoa_correlation,
        c.loss, c.state_scale, c.measurement_scale, c.iterations,
    )  # fmt: skip


@compiled
def _stand_still(m, t, tape):
    """Zero velocity, one axis after the other, for a quiet tag that the TDOAs have shown to be slow."""
    for h in range(HYPOTHESES):
        x, P = m.x[h], m.P[h]
        slow = m.belief[h] > -np.inf
        for axis in range(3):
            slow = slow and abs(x[3 + axis]) < REST_SPEED and P[3 + axis, 3 + axis] < REST_SPEED**2
        if not slow:
            continue
        for axis in range(3):
            innovation, total = -x[3 + axis], P[3 + axis, 3 + axis] + REST_STD**2
            m.K[:] = P[3 + axis]
            kalman(x, P, m.K, innovation, total)
            if h == int(m.clock[BEST]):
                for k in range(3):
                    m.g[k] = 1.0 if k == axis else 0.0
                note_update(tape, m, t, UPDATE, innovation, total, m.g, 3)


@inlined
def _stay_in_reach(m, t, tape):
    """Pull a tag that left the surroundings of its anchors towards them, one axis after the other.

    Wrong TDOAs, e.g. late arrivals on a floor, are often explained best by a tag far away."""
    for h in range(HYPOTHESES):
        if m.belief[h] == -np.inf:
            continue
        x, P = m.x[h], m.P[h]
        for axis in range(3):
            innovation = min(max(x[axis], m.box[0, axis]), m.box[1, axis]) - x[axis]
            if innovation == 0.0:
                continue
            total = P[axis, axis] + REACH_STD**2
            m.K[:] = P[axis]
            kalman(x, P, m.K, innovation, total)
            if h == int(m.clock[BEST]):
                for k in range(3):
                    m.g[k] = 1.0 if k == axis else 0.0
                note_update(tape, m, t, UPDATE, innovation, total, m.g, 0)


@inlined
def _remember(m, t, a, b, d):
    """Append a TDOA to the window."""
    kept = int(m.clock[KEPT])
    if kept == m.window.shape[1]:
        m.window[:, :WINDOW] = m.window[:, WINDOW:].copy()
        kept = WINDOW
    m.window[0, kept], m.window[1, kept], m.window[2, kept], m.window[3, kept] = t, a, b, d
    m.clock[KEPT] = kept + 1.0


@compiled
def _window(m, c):
    """The TDOAs of the last start_window seconds: t, a, b, d."""
    kept = int(m.clock[KEPT])
    first = kept - 1
    while first > 0 and kept - first < WINDOW and m.window[0, first - 1] > m.window[0, kept - 1] - c.start_window:
        first -= 1
    w = m.window[:, first:kept]
    return w[0], w[1].astype(np.int64), w[2].astype(np.int64), w[3]


@compiled
def _start(m, c, positions, t, anyhow, tape):
    """Begin if the window tells one position, or `anyhow` with the covariance that its contradictions leave."""
    wt, wa, wb, wd = _window(m, c)
    if len(wt) < MINIMUM:
        return
    m.clock[NEXT_TRY] = t + RETRY
    found, cov = np.empty(6), np.empty((6, 6))
    share = locate(wt, wa, wb, wd, positions, c.tdoa_std, c.reach, found, cov)
    if not anyhow and (share < AGREE or not believable(positions, c.reach, found)):
        return
    force = m.F[0, :3]  # scratch
    for k in range(3):
        felt, _ = inertial.trust(m, k, c.vibration_trust, c.vibration_gain)
        up = GRAVITY if k == 2 else 0.0
        force[k] = up + felt * (m.imu[MEAN_FORCE, k] - up)
    unknown = c.use_imu and c.initial_yaw_std > hypotheses.YAW_STD
    for h in range(HYPOTHESES):
        turned = hypotheses.quarter(h)
        off = min(turned, 2.0 * math.pi - turned)
        m.belief[h] = -0.5 * (off / c.initial_yaw_std) ** 2 if unknown or h == 0 else -np.inf
        x, P = m.x[h], m.P[h]
        level(force, c.initial_yaw + turned, x)
        x[:6] = found
        x[10:] = 0.0
        P[:, :] = 0.0
        P[:6, :6] = cov
        P[6, 6] = P[7, 7] = START_TILT_STD**2
        P[8, 8] = min(c.initial_yaw_std, hypotheses.YAW_STD) ** 2
        for k in range(3):
            P[9 + k, 9 + k] = c.initial_accel_bias_std**2
            P[12 + k, 12 + k] = c.initial_gyro_bias_std**2
    for k in range(3):
        middle, far = reach(positions, k, c.reach)
        m.box[0, k], m.box[1, k] = middle - far, middle + far
    m.clock[BEST] = 0.0
    m.clock[NOW] = m.clock[LAST_TDOA] = t
    m.clock[AGREEMENT] = 1.0
    m.clock[RUNNING] = 1.0
    _note_replaced(m, tape)


@compiled
def _recover(m, c, positions, t, tape):
    """If the window agrees on a position that the filter does not believe, go there; attitude and biases stay."""
    wt, wa, wb, wd = _window(m, c)
    if len(wt) < MINIMUM:
        return
    m.clock[NEXT_TRY] = t + RETRY
    found, cov = np.empty(6), np.empty((6, 6))
    share = locate(wt, wa, wb, wd, positions, c.tdoa_std, c.reach, found, cov)
    believed = share_of_inliers(wt, wa, wb, wd, positions, m.x[int(m.clock[BEST]), :6])
    if not believable(positions, c.reach, found) or share < AGREE_ANYHOW or share < 0.2 + believed:
        return
    for h in range(HYPOTHESES):
        m.x[h, :6] = found
        m.P[h, :6, :] = 0.0
        m.P[h, :, :6] = 0.0
        m.P[h, :6, :6] = cov
    m.clock[AGREEMENT] = 1.0
    m.clock[RECOVERIES] += 1.0
    _note_replaced(m, tape)


@compiled
def _note_replaced(m, tape):
    m.K[:] = 0.0
    note_update(tape, m, m.clock[NOW], REPLACED, 0.0, 1.0, m.g, 0)
