"""How noisy each anchor is, learned from the innovations while flying."""

from uwb_tdoa_bias.foundation.compiled import inlined

WILD = 5.0  # standard deviations that one outlier counts as at most


@inlined
def excess_variance(m, a, b):
    """Variance of a TDOA beyond tdoa_std, m^2: what was learned of its two anchors (rows a, b)."""
    return m.noise[0, a] + m.noise[0, b]


@inlined
def learn(m, t, a, b, innovation, spread, variance, std, memory):
    """Learn from one innovation (m), whose variance is spread + variance, what it has too much, or too little, of.

    An anchor that is received late, e.g. around an obstacle, disturbs every pair it is in: exponential average per
    anchor over `memory` seconds; a pair's excess is divided as the noise believed so far.
    """
    excess = min(innovation * innovation, WILD * WILD * variance) - spread - variance
    base = 0.5 * std * std
    whole = m.noise[0, a] + m.noise[0, b] + 2.0 * base
    for i in (a, b):
        share = (m.noise[0, i] + base) / whole
        step = min(1.0, max(0.0, t - m.noise[1, i]) / memory)
        m.noise[0, i] = max(0.0, m.noise[0, i] + step * share * excess)
        m.noise[1, i] = t
