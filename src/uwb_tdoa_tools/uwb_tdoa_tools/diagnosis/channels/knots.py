"""Where the pieces of a function of a covariate meet."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects.covariates import CATEGORIES

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .base import ChannelResidual

PIECES = 4
FEWEST = 100  # values


def knots_of(name: str, residuals: Sequence[ChannelResidual]) -> tuple[float, ...] | None:
    """Quantiles of a covariate at all that is looked at in several ChannelResiduals, or for one of
    names these names: tuple; None if it hardly varies, or one of them does not know it.
    """
    known = [
        values for values in (part.covariate(name) for part in residuals) if values is not None
    ]
    if len(known) < len(residuals):
        return None
    values = np.concatenate(known)
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
