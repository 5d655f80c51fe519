"""Where an effect was seen, and what is taken of it elsewhere.

What was fitted over a minute, or between 1 and 2 m of height, says nothing of an hour, or of the floor. Beyond its domain an effect
fades, and what is not taken out any more counts as noise: the filter believes such TDOAs less, instead of a guess.
"""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

import numpy as np

from ..foundation.errors import InputError
from .covariates import CATEGORIES, EXTRA, OF_ARRIVAL, OF_IMU, OF_TDOA, UNITS

if TYPE_CHECKING:
    from .base import Effect
    from .samples import Samples

FADE = 0.5  # share of the width of a domain: so far beyond it, exp(-1/2) of an effect is left
LITTLE = 0.5  # share of an effect; where less is taken out, nodes say so


def bounded(name: str) -> bool:
    """Whether a covariate has a domain: whether it is a quantity that nodes know, no name of something."""
    return name not in CATEGORIES and not name.startswith(EXTRA)


def checked(effect: str, domain: Any) -> dict[str, tuple[float, float]]:
    """{covariate: (low, high)} as written in effects.yaml; raises InputError. effect : name."""
    out = {}
    for covariate, limits in (domain or {}).items():
        try:
            low, high = map(float, limits)
        except (TypeError, ValueError):
            low = high = np.nan
        if str(covariate) not in (*OF_TDOA, *OF_ARRIVAL, *OF_IMU) or not bounded(str(covariate)) or not -np.inf < low <= high < np.inf:
            raise InputError(
                f"effects: {effect}: domain: {covariate}: {limits!r}; expected a covariate with the least and the largest value seen, as "
                "time: [0, 60]."
            )
        out[str(covariate)] = low, high
    return out


def share(values: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """What is left of an effect at values (n,) of a covariate that was seen between two limits: (n,), 1 within; 1 where it is not
    known, too."""
    low, high = limits
    beyond = np.maximum(np.maximum(low - values, values - high), 0.0)
    return np.exp(-0.5 * (np.nan_to_num(beyond) / (FADE * max(high - low, 1e-6))) ** 2)


def faded(effect: Effect, samples: Samples) -> tuple[np.ndarray, np.ndarray | float, np.ndarray | float]:
    """(bias of an Effect in Samples, (n,) m, NaN where it cannot tell; standard deviation of what of it is not taken out, (n,) m;
    share that is taken out, (n,)); the last two are 0.0 and 1.0 without a domain. The time goes on to its end only:
    what grows with it is not known to grow further."""
    if not effect.domain:
        return effect.bias(samples), 0.0, 1.0
    left, n = np.ones(len(samples)), len(samples)
    for covariate, limits in effect.domain.items():
        if covariate in OF_ARRIVAL:
            left *= share(OF_ARRIVAL[covariate](samples, samples.rows), limits).reshape(-1, n).min(axis=0)
        elif (values := OF_TDOA[covariate](samples)) is not None:
            left *= share(values, limits)
    bias = effect.bias(samples.until(samples.start + effect.domain["time"][1]) if "time" in effect.domain else samples)
    return left * bias, (1.0 - left) * np.abs(np.nan_to_num(bias)), left


def in_words(effect: Effect) -> str:
    """One phrase on an Effect with a domain."""
    seen = (f"{name} {low:.3g} to {high:.3g} {UNITS[name]}" for name, (low, high) in effect.domain.items())
    return f"{effect.label} ({', '.join(seen)})"
