"""Several yaws at once, while nobody knows which is right.

A tag that starts anywhere cannot see its yaw: only motion that its accelerometer feels and its TDOAs see tells. One
filter per direction runs until the TDOAs have decided (multiple model estimation, e.g. Bar-Shalom et al., Estimation
with Applications to Tracking and Navigation, 2001, section 11.6.2, static case).
"""

import math

import numpy as np

from uwb_tdoa_bias.foundation.compiled import compiled, inlined

from .memory import BEST, HYPOTHESES, NEXT_MERGE
from .state import difference

YAW_STD = 0.6  # rad, of each hypothesis: they start 90 degrees apart
HOPELESS = -8.0  # log probability relative to the best at which a hypothesis is given up
SAME = 0.1  # rad between two hypotheses that have become one
MERGE_PERIOD = 0.1  # s
SURPRISE = 9.0  # squared standard deviations that one TDOA counts as at most


@compiled
def quarter(h):
    """Angle of hypothesis h to initial_yaw, rad."""
    return h * 2.0 * math.pi / HYPOTHESES


@inlined
def blame(m, h, innovation, total):
    """Hypothesis h met an innovation (m) of variance `total` (m^2), errors alike included."""
    m.belief[h] -= 0.5 * (min(innovation * innovation / total, SURPRISE) + math.log(total))


@inlined
def choose(m, t):
    """Follow the most probable hypothesis; give up those that are hopeless, or have become the same as a better one."""
    best = 0
    for h in range(HYPOTHESES):
        if m.belief[h] > m.belief[best]:
            best = h
    top = m.belief[best]
    for h in range(HYPOTHESES):
        m.belief[h] -= top
        if m.belief[h] < HOPELESS:
            m.belief[h] = -np.inf
    m.clock[BEST] = best
    if t < m.clock[NEXT_MERGE]:
        return
    m.clock[NEXT_MERGE] = t + MERGE_PERIOD
    apart = m.S[:9, 0]  # scratch
    for h in range(HYPOTHESES):
        if h != best and m.belief[h] > -np.inf:
            difference(m.x[best], m.x[h], apart)
            if apart[6] ** 2 + apart[7] ** 2 + apart[8] ** 2 < SAME**2:
                m.belief[h] = -np.inf


@compiled
def add_doubt(m, covariance):
    """Add to the (9, 9) covariance of the best hypothesis what the others say: their mean square distance from it."""
    best = int(m.clock[BEST])
    apart = m.S[:9, 0]  # scratch
    weights = 0.0
    for h in range(HYPOTHESES):
        weights += math.exp(m.belief[h])
    for h in range(HYPOTHESES):
        if h != best and m.belief[h] > -np.inf:
            difference(m.x[best], m.x[h], apart)
            share = math.exp(m.belief[h]) / weights
            for i in range(9):
                for j in range(9):
                    covariance[i, j] += share * apart[i] * apart[j]
