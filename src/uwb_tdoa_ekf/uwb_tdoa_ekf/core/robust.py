"""One scalar TDOA against the state: three ways not to be misled by an outlier.

All share the model d = |p - b| - |p - a| + n, whose Jacobian g is zero but for the position, and work on x (16,), P (15, 15)
of `state`. `variance` is that of one measurement; `dilution` >= 1 says how many successive measurements count as one,
because their errors are alike: the update uses variance * dilution, the weight judges with variance.
"""

import math

import numpy as np

from uwb_tdoa_bias.foundation.compiled import compiled

from .state import inject

GEMAN_MCCLURE, HUBER, CAUCHY = 0, 1, 2  # as in config.LOSSES
NEGLIGIBLE = 0.01  # weight below which a measurement is not used


@compiled
def weight(loss, e, scale):
    """IRLS weight w(e) = rho'(e) / e, 1 at e = 0. e: normalised residual; scale: where the loss bends, same unit."""
    u = (e / scale) ** 2
    if loss == GEMAN_MCCLURE:
        return 1.0 / ((1.0 + u) * (1.0 + u))
    if loss == HUBER:
        return 1.0 if u <= 1.0 else 1.0 / math.sqrt(u)
    return 1.0 / (1.0 + u)


@compiled
def predicted(x, a, b, g):
    """Predicted d_ab (m) for antenna positions a, b (3,); writes its derivative by the position to g (3,)."""
    ax, ay, az = x[0] - a[0], x[1] - a[1], x[2] - a[2]
    bx, by, bz = x[0] - b[0], x[1] - b[1], x[2] - b[2]
    ra = max(math.sqrt(ax * ax + ay * ay + az * az), 1e-6)
    rb = max(math.sqrt(bx * bx + by * by + bz * bz), 1e-6)
    g[0], g[1], g[2] = bx / rb - ax / ra, by / rb - ay / ra, bz / rb - az / ra
    return rb - ra


@compiled
def gain_terms(P, g, K):
    """K <- P g (15,); returns g' P g, m^2."""
    for j in range(15):
        K[j] = P[j, 0] * g[0] + P[j, 1] * g[1] + P[j, 2] * g[2]
    return g[0] * K[0] + g[1] * K[1] + g[2] * K[2]


@compiled
def update_innovation(x, P, K, innovation, spread, variance, dilution, loss, scale):
    """Weight from the whitened innovation, then one Kalman update with the variance divided by it.
    Returns the weight and the total variance used, m^2.

    K = P g and spread = g' P g come from gain_terms. Because the prior's own uncertainty whitens the innovation, a
    filter that knows little listens to everything: the redescending weight cannot lock it out.
    """
    w = weight(loss, innovation / math.sqrt(spread + variance), scale)
    if w < NEGLIGIBLE:
        return 0.0, np.inf
    total = spread + variance * dilution / w
    kalman(x, P, K, innovation, total)
    return w, total


@compiled
def update_gate(x, P, K, innovation, spread, variance, dilution, gate):
    """Kalman update if the innovation is within `gate` standard deviations.
    Returns the weight, 1 or 0, and the total variance used, m^2."""
    if innovation * innovation > gate * gate * (spread + variance):
        return 0.0, np.inf
    total = spread + variance * dilution
    kalman(x, P, K, innovation, total)
    return 1.0, total


@compiled
def kalman(x, P, K, innovation, total):
    """Scalar Kalman update: K = P h' (15,), total = h P h' + variance."""
    inject(x, K, innovation / total)
    for i in range(15):
        k = K[i] / total
        for j in range(i, 15):
            P[i, j] -= k * K[j]
            P[j, i] = P[i, j]


@compiled
def update_m_estimation(x, P, S, K, g, innovation, variance, dilution, loss, state_scale, scale, iterations):
    """M-estimation update, Zhao et al. (RA-L 2021), eqs. 8 - 13.
    Returns the measurement's weight and the total variance used, m^2; K becomes that of the weighted prior.

    The error state is scaled by the Cholesky factor of the prior (eq. 9), prior and measurement are re-weighted
    `iterations` times (eq. 10), and the posterior follows from the weighted gain (eqs. 11 - 13). A TDOA moves only the
    first three elements of the scaled error, so three columns of the factor suffice: S (15, 3), scratch. The Jacobian
    is kept at the prior mean: over the centimetres of one update it does not change.
    """
    for i in range(3):
        for j in range(i, 15):
            value = P[j, i]
            for k in range(i):
                value -= S[j, k] * S[i, k]
            S[j, i] = math.sqrt(max(value, 1e-18)) if j == i else value / S[i, i]
        for j in range(i):
            S[j, i] = 0.0
    noise = variance * dilution
    y0 = S[0, 0] * g[0] + S[1, 0] * g[1] + S[2, 0] * g[2]  # S' G; its other elements are zero
    y1 = S[1, 1] * g[1] + S[2, 1] * g[2]
    y2 = S[2, 2] * g[2]
    e0 = e1 = e2 = 0.0  # scaled error of the state, eq. 9
    for _ in range(iterations):
        w = max(weight(loss, (innovation - y0 * e0 - y1 * e1 - y2 * e2) / math.sqrt(noise), scale), 1e-6)
        w0, w1, w2 = weight(loss, e0, state_scale), weight(loss, e1, state_scale), weight(loss, e2, state_scale)
        total = y0 * y0 / w0 + y1 * y1 / w1 + y2 * y2 / w2 + noise / w
        step = innovation / total
        e0, e1, e2 = y0 / w0 * step, y1 / w1 * step, y2 / w2 * step
    for i in range(15):  # the weighted prior: P + S (1/W - 1) S'
        s0, s1, s2 = (1.0 / w0 - 1.0) * S[i, 0], (1.0 / w1 - 1.0) * S[i, 1], (1.0 / w2 - 1.0) * S[i, 2]
        for j in range(15):
            P[i, j] += s0 * S[j, 0] + s1 * S[j, 1] + s2 * S[j, 2]
        K[i] = S[i, 0] * y0 / w0 + S[i, 1] * y1 / w1 + S[i, 2] * y2 / w2
    kalman(x, P, K, innovation, total)
    return w, total
