"""How noisy each anchor is, learned from the innovations while flying."""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.common.compiled import Record, compiled

LARGEST_OUTLIER = 5.0  # standard deviations that one outlier counts as at most
LARGEST_STEP = (
    0.1  # share of an anchor's variance that one innovation makes at most: ten say what one cannot
)


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
