"""Where the pieces of a function of a covariate meet."""

from __future__ import annotations

import numpy as np

from uwb_tdoa_bias.effects.covariates import CATEGORIES

PIECES = 4
FEWEST = 100  # values


def knots_of(values: np.ndarray, name: str) -> tuple[float, ...] | None:
    """Quantiles of the values (n,) of a covariate, or for one of names these names: tuple; None if it hardly varies."""
    values = values[np.isfinite(values)]
    if len(values) < FEWEST:
        return None
    if name in CATEGORIES:
        names = np.unique(values[values >= 0])
        return tuple(names.tolist()) if 2 <= len(names) <= 64 else None
    low, high = np.quantile(values, [0.005, 0.995])
    if high - low < 1e-3 * max(abs(low), abs(high), 1e-3):
        return None
    knots = np.quantile(values, np.linspace(0.005, 0.995, PIECES + 1))
    if np.min(np.diff(knots)) < 0.02 * (high - low):  # crowded: even pieces instead
        knots = np.linspace(low, high, PIECES + 1)
    return tuple(float(f"{knot:.6g}") for knot in knots)
