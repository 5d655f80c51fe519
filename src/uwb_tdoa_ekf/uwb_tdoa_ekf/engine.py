"""The compiled filter: events in stamp order in, odometry and residuals out. Everything it remembers is in Memory."""

import math
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.compiled import compiled

from .robust import predicted, gain_terms, update_gate, update_innovation, update_m_estimation
from .startup import INLIER, believable, level, locate, share_of_inliers
from .state import GRAVITY, coast, predict

# verdict on one TDOA; the values of TdoaResidual.VERDICT_*
USED, REJECTED, LATE, INVALID, STARTUP = range(5)

WINDOW = 512  # TDOAs kept for a start
MINIMUM = 12  # TDOAs a start needs
AGREE, AGREE_ANYHOW = 0.7, 0.6  # share of TDOAs that a start, and a restart, must explain
AGREEMENT_TIME = 0.3  # s, memory of how well the filter explains its TDOAs
RETRY = 0.1  # s between two attempts at a start
LOST_TIME = 60.0  # s without any message after which the filter starts anew
MAX_STEP = 0.05  # s, longest single prediction
START_TILT_STD, START_VELOCITY_STD = 0.1, 1.0  # rad, m/s
STALE_TURN_PSD = 0.25  # (rad/s)^2/Hz while there is no gyroscope
VIBRATION_CORNER, VIBRATION_TIME = 0.05, 0.3  # s: what is faster than the first is vibration; its power is averaged over the second
VIBRATION_MEMORY = 0.2  # s over which that error persists


class Memory(NamedTuple):
    """State of one filter. A copy of its arrays is a copy of the filter."""

    x: np.ndarray  # (16,) nominal state, see state.py
    P: np.ndarray  # (15, 15) error covariance
    clock: np.ndarray  # see the indices below
    imu: np.ndarray  # (5, 3): last gyro, last force, slow force, vibration power, mean force
    window: np.ndarray  # (4, 2 * WINDOW): t, a, b, d of recent TDOAs, oldest first
    F: np.ndarray  # the rest is scratch
    R: np.ndarray
    K: np.ndarray
    g: np.ndarray
    S: np.ndarray


# places in Memory.clock
NOW, LAST_IMU, FIRST_TDOA, LAST_TDOA, NEXT_TRY, NEXT_ODOMETRY, AGREEMENT, RUNNING, RECOVERIES, KEPT = range(10)


def new_memory():
    """Memory of a filter that has seen nothing."""
    clock = np.full(10, -np.inf)
    clock[[AGREEMENT, RUNNING, RECOVERIES, KEPT]] = 1.0, 0.0, 0.0, 0.0
    imu = np.zeros((5, 3))
    imu[[1, 2, 4], 2] = GRAVITY
    x = np.zeros(16)
    x[9] = 1.0
    shapes = ((15, 15), (3, 3), (15,), (3,), (15, 3))
    return Memory(x, np.eye(15), clock, imu, np.zeros((4, 2 * WINDOW)), *(np.zeros(shape) for shape in shapes))


@compiled
def run(m, c, positions, imu_t, gyro, force, tdoa_t, a, b, d, bias_std, odometry, covariance, residuals):
    """Feed events in stamp order.

    m : Memory; c : Tuning; positions (N, 3) m. imu_t (n,) s, gyro (n, 3) rad/s, force (n, 3) m/s^2. tdoa_t (k,) s,
    a, b (k,) anchor rows, d (k,) corrected m, bias_std (k,) m. Both rising, neither before what was fed earlier.
    Writes: odometry (>= n + k, 17) rows of stamp and state; covariance (>= n + k, 9, 9) of [p, v, attitude];
    residuals (k, 4) rows of innovation, its variance, weight, verdict. Returns the number of odometry rows.
    """
    i = k = rows = 0
    while i < len(imu_t) or k < len(tdoa_t):
        if k == len(tdoa_t) or (i < len(imu_t) and imu_t[i] <= tdoa_t[k]):
            t = imu_t[i]
            _on_imu(m, c, t, gyro[i], force[i])
            i += 1
        else:
            t = tdoa_t[k]
            _on_tdoa(m, c, positions, t, a[k], b[k], d[k], bias_std[k], residuals[k])
            k += 1
        if m.clock[RUNNING] and t >= m.clock[NEXT_ODOMETRY]:
            m.clock[NEXT_ODOMETRY] = (math.floor(t * c.odometry_rate + 1e-6) + 1.0) / c.odometry_rate
            odometry[rows, 0] = t
            odometry[rows, 1:] = m.x
            covariance[rows] = m.P[:9, :9]
            rows += 1
    return rows


@compiled
def _on_imu(m, c, t, gyro, force):
    last_gyro, last_force, slow, power, mean = m.imu[0], m.imu[1], m.imu[2], m.imu[3], m.imu[4]
    dt = t - m.clock[LAST_IMU]
    fresh = dt < c.imu_timeout
    for k in range(3):
        if fresh:
            slow[k] += min(1.0, dt / VIBRATION_CORNER) * (force[k] - slow[k])
            mean[k] += min(1.0, dt / VIBRATION_TIME) * (slow[k] - mean[k])
            power[k] += min(1.0, dt / VIBRATION_TIME) * ((force[k] - slow[k]) ** 2 - power[k])
            last_gyro[k], last_force[k] = 0.5 * (last_gyro[k] + gyro[k]), 0.5 * (last_force[k] + force[k])
        else:
            slow[k] = mean[k] = force[k]
            power[k] = 0.0
            last_gyro[k], last_force[k] = gyro[k], force[k]
    if m.clock[RUNNING]:
        _advance(m, c, t)
    m.clock[LAST_IMU] = t
    for k in range(3):
        last_gyro[k], last_force[k] = gyro[k], force[k]


@compiled
def _advance(m, c, t):
    """Predict to stamp t with the inertial sample at hand, or without one if it is too old."""
    if t - m.clock[NOW] > LOST_TIME:
        m.clock[RUNNING], m.clock[FIRST_TDOA], m.clock[NEXT_TRY] = 0.0, t, -np.inf
        return
    trust, psd = m.S[0], m.S[1]  # scratch
    inertial = c.use_imu and t - m.clock[LAST_IMU] < c.imu_timeout
    if inertial:
        for k in range(3):
            doubt = c.vibration_gain * m.imu[3, k]
            trust[k] = c.vibration_trust**2 / (c.vibration_trust**2 + doubt)
            psd[k] = c.accel_noise**2 + 2.0 * VIBRATION_MEMORY * trust[k] * doubt
    while m.clock[NOW] < t:
        dt = min(t - m.clock[NOW], MAX_STEP)
        if inertial:
            predict(
                m.x, m.P, m.F, m.R, dt, m.imu[0], m.imu[1], trust, psd,
                c.gyro_noise**2, c.accel_bias_walk**2, c.gyro_bias_walk**2,
            )  # fmt: skip
        else:
            coast(m.x, m.P, dt, c.motion_noise**2, STALE_TURN_PSD if c.use_imu else 0.0)
        m.clock[NOW] = t if t - m.clock[NOW] <= MAX_STEP else m.clock[NOW] + dt


@compiled
def _on_tdoa(m, c, positions, t, a, b, d, bias_std, residual):
    first, kept = _remember(m, c, t, a, b, d)
    if not m.clock[RUNNING]:
        residual[0] = residual[1] = np.nan
        residual[2], residual[3] = 0.0, STARTUP
        if t - m.clock[LAST_TDOA] > c.start_window:
            m.clock[FIRST_TDOA] = t
        m.clock[LAST_TDOA] = t
        waited = t - m.clock[FIRST_TDOA]
        if kept - first >= MINIMUM and waited > 0.9 * c.start_window and t >= m.clock[NEXT_TRY]:
            m.clock[NEXT_TRY] = t + RETRY
            _start(m, c, positions, t, first, kept, waited > c.start_patience)
        return
    _advance(m, c, t)
    if not m.clock[RUNNING]:
        residual[0] = residual[1] = np.nan
        residual[2], residual[3] = 0.0, STARTUP
        return
    innovation = d - predicted(m.x, positions[a], positions[b], m.g)
    spread = gain_terms(m.P, m.g, m.K)
    variance = c.tdoa_std**2 + bias_std**2
    if c.robust == 0:
        w = update_innovation(
            m.x, m.P, m.K, innovation, spread, variance, c.tdoa_correlation, c.loss, c.measurement_scale
        )
    elif c.robust == 1:
        w = update_gate(m.x, m.P, m.K, innovation, spread, variance, c.tdoa_correlation, c.gate)
    else:
        w = update_m_estimation(
            m.x, m.P, m.S, m.K, m.g, innovation, variance, c.tdoa_correlation,
            c.loss, c.state_scale, c.measurement_scale, c.iterations,
        )  # fmt: skip
    residual[0], residual[1], residual[2] = innovation, spread + variance, w
    residual[3] = USED if w > 0.0 else REJECTED
    agrees = 1.0 if abs(innovation) < INLIER else 0.0
    m.clock[AGREEMENT] += min(1.0, (t - m.clock[LAST_TDOA]) / AGREEMENT_TIME) * (agrees - m.clock[AGREEMENT])
    m.clock[LAST_TDOA] = t
    if m.clock[AGREEMENT] < 0.5 and kept - first >= MINIMUM and t >= m.clock[NEXT_TRY]:
        m.clock[NEXT_TRY] = t + RETRY
        _recover(m, c, positions, first, kept)


@compiled
def _remember(m, c, t, a, b, d):
    """Append to the window; returns the places of the first TDOA within start_window and of the end."""
    kept = int(m.clock[KEPT])
    if kept == m.window.shape[1]:
        m.window[:, :WINDOW] = m.window[:, WINDOW:].copy()
        kept = WINDOW
    m.window[0, kept], m.window[1, kept], m.window[2, kept], m.window[3, kept] = t, a, b, d
    kept += 1
    m.clock[KEPT] = kept
    first = kept - 1
    while first > 0 and kept - first < WINDOW and m.window[0, first - 1] > t - c.start_window:
        first -= 1
    return first, kept


@compiled
def _window(m, first, kept):
    w = m.window[:, first:kept]
    return w[0], w[1].astype(np.int64), w[2].astype(np.int64), w[3]


@compiled
def _start(m, c, positions, t, first, kept, anyhow):
    """Begin if the window tells one position, or `anyhow` with the covariance that its contradictions leave."""
    wt, wa, wb, wd = _window(m, first, kept)
    found, cov = np.empty(6), np.empty((6, 6))
    share = locate(wt, wa, wb, wd, positions, c.tdoa_std, found, cov)
    if not anyhow and (share < AGREE or not believable(positions, found)):
        return
    force = m.F[0, :3]  # scratch
    for k in range(3):
        trust = c.vibration_trust**2 / (c.vibration_trust**2 + c.vibration_gain * m.imu[3, k])
        up = GRAVITY if k == 2 else 0.0
        force[k] = up + trust * (m.imu[4, k] - up)
    level(force, c.initial_yaw, m.x)
    m.x[:6] = found
    m.x[10:] = 0.0
    m.P[:, :] = 0.0
    m.P[:6, :6] = cov
    m.P[6, 6] = m.P[7, 7] = START_TILT_STD**2
    m.P[8, 8] = c.initial_yaw_std**2
    for k in range(3):
        m.P[9 + k, 9 + k] = c.initial_accel_bias_std**2
        m.P[12 + k, 12 + k] = c.initial_gyro_bias_std**2
    m.clock[NOW] = m.clock[LAST_TDOA] = t
    m.clock[AGREEMENT] = 1.0
    m.clock[RUNNING] = 1.0


@compiled
def _recover(m, c, positions, first, kept):
    """If the window agrees on a position that the filter does not believe, go there; attitude and biases stay."""
    wt, wa, wb, wd = _window(m, first, kept)
    found, cov = np.empty(6), np.empty((6, 6))
    share = locate(wt, wa, wb, wd, positions, c.tdoa_std, found, cov)
    if not believable(positions, found) or share < AGREE_ANYHOW or share < 0.2 + share_of_inliers(wt, wa, wb, wd, positions, m.x[:6]):
        return
    m.x[:6] = found
    m.P[:6, :] = 0.0
    m.P[:, :6] = 0.0
    m.P[:6, :6] = cov
    m.clock[AGREEMENT] = 1.0
    m.clock[RECOVERIES] += 1.0
