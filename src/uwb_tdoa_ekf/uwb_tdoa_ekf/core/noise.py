"""How noisy each anchor is, learned from the innovations while flying."""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

from .ground import solve

LARGEST_OUTLIER = 5.0  # standard deviations that one outlier counts as at most
# share of an anchor's variance that one innovation makes at most: ten say what one cannot
LARGEST_STEP = 0.1


@compiled
def excess_variance(a: Record, b: Record) -> float:
    """Variance of a TDOA beyond tdoa_std, m^2: what was learned of its two anchors (of ANCHOR)."""
    return a.excess_variance + b.excess_variance


@compiled
def learn(a: Record, b: Record, t: float, innovation: Record, parameters: Record) -> None:
    """Learn from one INNOVATION, stamped t (s), what its noise_variance has too little, or too
    much, of.

    An anchor that is received late, e.g. around an obstacle, disturbs every pair it is in:
    exponential average per anchor over noise_memory; a pair's excess is divided as the noise
    learned so far.
    """
    noise = innovation.noise_variance
    squared = min(innovation.value**2, LARGEST_OUTLIER**2 * noise)
    excess = squared - innovation.prior_variance - noise
    base = 0.5 * parameters.tdoa_std**2
    whole = a.excess_variance + b.excess_variance + 2.0 * base
    _learn_one(a, t, (a.excess_variance + base) / whole * excess, parameters.noise_memory)
    _learn_one(b, t, (b.excess_variance + base) / whole * excess, parameters.noise_memory)


@compiled
def _learn_one(anchor: Record, t: float, excess: float, memory: float) -> None:
    step = (
        min(LARGEST_STEP, max(0.0, t - anchor.learned) / memory)
        if anchor.learned > -np.inf
        else 1.0
    )
    anchor.excess_variance = max(0.0, anchor.excess_variance + step * excess)
    anchor.learned = t


# of the variance of a TDOA that persists where its errors are correlated: delays and antennas, as
# large as noise
SHARE = 0.5
MEMORY = 1.0  # s of TDOAs that are looked at: an anchor that was not heard for so long is not there
LONGEST_STEP = 0.1  # s; what anchors tell is not forgotten in silence
# times the covariance of the filter is the most that is added: it does not hear anchors alone
MOST = 400.0


@compiled
def begin(information: np.ndarray, P: np.ndarray) -> None:
    """Fill in the information (3, 3), 1/m^2, of a start whose covariance P (15, 15) has counted
    each anchor once, see `observe`.
    """
    both = np.concatenate((P[:3, :3], np.eye(3)), axis=1)
    solve(both)
    information[:, :] = SHARE * both[:, 3:]


@compiled
def observe(
    information: np.ndarray, a: Record, b: Record, innovation: Record, t: float, last: float
) -> None:
    """Take a TDOA stamped t, s, between two of ANCHOR, an INNOVATION, into the information (3, 3),
    1/m^2, of a position by a single TDOA of each anchor that is heard, as noisy as it is; last : s,
    stamp of the TDOA before.
    """
    fades = min(t - last, LONGEST_STEP) / MEMORY
    # adds up to the number of anchors
    apart = 0.5 * (min(t - a.heard, MEMORY) + min(t - b.heard, MEMORY)) / MEMORY
    a.heard = b.heard = t
    gain = apart * innovation.weight / (innovation.noise_variance + innovation.curvature / SHARE)
    for i in range(3):
        for j in range(3):
            information[i, j] += (
                gain * innovation.row[i] * innovation.row[j] - fades * information[i, j]
            )


@compiled
def fill(
    information: np.ndarray,
    P: np.ndarray,
    correlation_length: float,
    height_std: float,
    covariance: np.ndarray,
) -> None:
    """Fill in the covariance (3, 3), m^2, that errors which persist make of a position whose
    covariance in the filter is P (15, 15). Of white noise, of correlation_length 1, nothing
    persists. height_std : m, of a height that is held, 0: none is; what is held does not follow
    these errors.
    """
    covariance[:, :] = 0.0
    share = SHARE * (1.0 - 1.0 / max(correlation_length, 1.0))
    both = np.concatenate((P[:3, :3], np.eye(3)), axis=1)
    if share == 0.0 or not solve(both):
        return
    both[:, :3] = information / share + both[:, 3:] / MOST
    if height_std > 0.0:
        both[2, 2] += 1.0 / height_std**2
    both[:, 3:] = np.eye(3)
    if solve(both):
        covariance[:, :] = both[:, 3:]
    if height_std > 0.0:  # what the height adds to the information has no part in the error
        share = 1.0 / height_std**2
        for i in range(3):
            for j in range(3):
                covariance[i, j] -= both[i, 5] * share * both[2, 3 + j]
