"""Functions of a covariate with few coefficients: each has a level of its own, c0, and is held
constant beyond its knots.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

# {shape: (knots, coefficients)}: low and high end, between them where something begins or ends; of
# a wave one period.
SHAPES = {
    "line": (2, 2),
    "beyond": (3, 2),
    "below": (3, 2),
    "step": (3, 2),
    "interval": (4, 2),
    "wave": (2, 3),
    "parabola": (2, 3),
}


def functions(shape: str, knots: Sequence[float], values: np.ndarray) -> np.ndarray:
    """The functions that the coefficients multiply, at covariate values (n,): (n, k); NaN stays
    NaN.

    line : 1 and what rises from -1/2 to 1/2 between the knots; beyond, below : 1 and what rises
        from 0 at the middle knot
    to 1 at the last, or at the first; step, interval : 1 and 1 beyond the middle knot, or between
    the two inner ones;
    wave : 1 and sine and cosine of the period between the knots; parabola : 1, the line and its
        square.
    """
    v, one = np.asarray(values, dtype=float), np.ones(len(values))
    if shape == "wave":
        phase = 2.0 * np.pi * (v - knots[0]) / (knots[1] - knots[0])
        return np.stack([one, np.sin(phase), np.cos(phase)], axis=1)
    low, high = knots[0], knots[-1]
    held = np.clip(v, low, high)
    if shape in ("line", "parabola"):
        second = (held - low) / (high - low) - 0.5
        if shape == "parabola":
            return np.stack([one, second, second**2], axis=1)
    elif shape == "beyond":
        second = np.maximum(held - knots[1], 0.0) / (high - knots[1])
    elif shape == "below":
        second = np.maximum(knots[1] - held, 0.0) / (knots[1] - low)
    else:
        inside = (v >= knots[1]) & (v < knots[2] if shape == "interval" else True)
        second = np.where(np.isnan(v), np.nan, 1.0 * inside)
    return np.stack([one, second], axis=1)
