"""Where an effect was seen, and what is left of it beyond: `fading.py` applies that."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..foundation.errors import InputError
from .covariates import CATEGORIES, EXTRA, OF_ARRIVAL, OF_IMU, OF_TDOA

FADE = 0.5  # share of the width of a domain: so far beyond it, exp(-1/2) of an effect is left


def bounded(name: str) -> bool:
    """Whether a covariate has a domain: whether it is a quantity that nodes know, no name of
    something.
    """
    return name not in CATEGORIES and not name.startswith(EXTRA)


def checked(effect: str, domain: Any) -> dict[str, tuple[float, float]]:
    """{covariate: (low, high)} as written in effects.yaml; raises InputError. effect : name."""
    out = {}
    for covariate, limits in (domain or {}).items():
        try:
            low, high = map(float, limits)
        except (TypeError, ValueError):
            low = high = np.nan
        if (
            str(covariate) not in (*OF_TDOA, *OF_ARRIVAL, *OF_IMU)
            or not bounded(str(covariate))
            or not -np.inf < low <= high < np.inf
        ):
            raise InputError(
                f"effects: {effect}: domain: {covariate}: {limits!r}; expected a covariate "
                "with the least and the largest value seen, as "
                "time: [0, 60]."
            )
        out[str(covariate)] = low, high
    return out


def share(values: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """What is left of an effect at values (n,) of a covariate that was seen between two limits:
    (n,), 1 within; 1 where it is not known, too.
    """
    low, high = limits
    beyond = np.maximum(np.maximum(low - values, values - high), 0.0)
    return np.exp(-0.5 * (np.nan_to_num(beyond) / (FADE * max(high - low, 1e-6))) ** 2)
