"""Where is the tag? A position and velocity from a short window of TDOAs and nothing else."""

import math

import numpy as np

from uwb_tdoa_bias.foundation.compiled import compiled

STARTS = 9  # the middle of the anchors and the corners of the half-size box around it
SWEEPS = 14  # Gauss-Newton steps per start
COARSE, FINE = 5.0, 0.5  # m, scale of the Geman-McClure loss at the first and the last steps
SPEED = 1.0  # m/s, standard deviation of the velocity before anything is known
ROOM = 3.0  # m from the middle of the anchors that a tag may be at least, however flat they lie
LEAP = 2.0  # m, longest step
INLIER = 0.75  # m, a residual below this does not contradict a position


@compiled
def locate(t, a, b, d, positions, std, margin, x, cov):
    """Robust multilateration over a window, with constant velocity.

    t, a, b, d : (n,) TDOAs (s, anchor rows, m), t rising; positions (N, 3), m; std: m, of one TDOA;
    margin: as of `reach`. Writes position and
    velocity at t[-1] to x (6,) and their covariance to cov (6, 6). Returns the share of TDOAs that agree with it, 0 to 1.

    Graduated Geman-McClure: Gauss-Newton from several starts while the loss narrows; the start with the least final loss
    wins. A tag is near its anchors and slow until proven otherwise: without that prior, the late arrivals on a floor are
    explained best by a tag ten metres up. The covariance counts one independent error per anchor heard, not per TDOA,
    because errors persist over the window, and grows with the disagreement that is left.
    """
    n = len(t)
    middle, prior = np.zeros(6), np.full(6, SPEED)
    for k in range(3):
        middle[k], prior[k] = reach(positions, k, margin)
    heard = np.zeros(len(positions))
    for i in range(n):
        heard[a[i]] = heard[b[i]] = 1.0
    alike = max(1.0, n / max(1.0, np.sum(heard) - 1.0))  # TDOAs that share one error
    best_loss = np.inf
    trial = np.zeros(6)
    information, gradient, residuals = np.zeros((6, 6)), np.zeros(6), np.zeros(n)
    for start in range(STARTS):
        trial[:] = middle
        for k in range(3):
            if start > 0:
                trial[k] += 0.5 * prior[k] * (1.0 if ((start - 1) >> k) & 1 else -1.0)
        for sweep in range(SWEEPS):
            scale = max(COARSE * 0.7**sweep, FINE)
            _normal_equations(t, a, b, d, positions, trial, scale, information, gradient, residuals)
            belief = alike * max(std, 0.5 * scale) ** 2
            for k in range(6):
                information[k, k] += belief / prior[k] ** 2
                gradient[k] += belief / prior[k] ** 2 * (middle[k] - trial[k])
            step = np.linalg.solve(information, gradient)
            length = math.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2)
            trial += min(1.0, LEAP / max(length, 1e-9)) * step
        loss = _normal_equations(t, a, b, d, positions, trial, FINE, information, gradient, residuals)
        loss += alike / n * np.sum(((trial - middle) / prior) ** 2) * (std / FINE) ** 2
        if loss < best_loss:
            best_loss = loss
            x[:] = trial
    _normal_equations(t, a, b, d, positions, x, 1e6, information, gradient, residuals)
    variance = alike * max(std, 1.5 * np.median(np.abs(residuals))) ** 2
    for k in range(6):
        information[k, k] += variance / prior[k] ** 2
    cov[:, :] = np.linalg.inv(information) * variance
    return np.mean(np.abs(residuals) < INLIER)


@compiled
def reach(positions, k, margin):
    """Middle of the anchors along axis k, and how far from it a tag is believed to be, m: `margin` beyond them."""
    low, high = np.min(positions[:, k]), np.max(positions[:, k])
    return 0.5 * (low + high), max(0.5 * (high - low) + margin, ROOM)


@compiled
def believable(positions, margin, x):
    """True if position x (3,) is within reach of the anchors."""
    for k in range(3):
        middle, far = reach(positions, k, margin)
        if abs(x[k] - middle) > far:
            return False
    return True


@compiled
def share_of_inliers(t, a, b, d, positions, x):
    """Share of the window's TDOAs that agree with position and velocity x (6,) at its end, 0 to 1."""
    residuals = np.empty(len(t))
    _normal_equations(t, a, b, d, positions, x, 1e6, np.empty((6, 6)), np.empty(6), residuals)
    return np.mean(np.abs(residuals) < INLIER)


@compiled
def _normal_equations(t, a, b, d, positions, x, scale, information, gradient, residuals):
    """Weighted normal equations of the window at x (6,); returns the mean Geman-McClure loss, 0 to 1."""
    information[:, :] = 0.0
    gradient[:] = 0.0
    loss = 0.0
    n = len(t)
    row = np.empty(6)
    for i in range(n):
        tau = t[i] - t[n - 1]
        ra = rb = 0.0
        for k in range(3):
            p = x[k] + tau * x[3 + k]
            ra += (p - positions[a[i], k]) ** 2
            rb += (p - positions[b[i], k]) ** 2
        ra, rb = max(math.sqrt(ra), 1e-6), max(math.sqrt(rb), 1e-6)
        for k in range(3):
            p = x[k] + tau * x[3 + k]
            row[k] = (p - positions[b[i], k]) / rb - (p - positions[a[i], k]) / ra
            row[3 + k] = tau * row[k]
        r = d[i] - (rb - ra)
        residuals[i] = r
        u = r * r / (scale * scale)
        w = 1.0 / ((1.0 + u) * (1.0 + u))
        loss += u / (1.0 + u)
        for k in range(6):
            gradient[k] += w * row[k] * r
            for m in range(6):
                information[k, m] += w * row[k] * row[m]
    return loss / n


@compiled
def level(force, yaw, x):
    """Write to x the attitude in which `force` (3,), the mean specific force, points up, and which has the given yaw."""
    roll = math.atan2(force[1], force[2])
    pitch = math.atan2(-force[0], math.hypot(force[1], force[2]))
    cr, sr, cp, sp = math.cos(roll / 2), math.sin(roll / 2), math.cos(pitch / 2), math.sin(pitch / 2)
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    x[6] = sr * cp * cy - cr * sp * sy
    x[7] = cr * sp * cy + sr * cp * sy
    x[8] = cr * cp * sy - sr * sp * cy
    x[9] = cr * cp * cy + sr * sp * sy
