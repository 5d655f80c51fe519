"""What is taken of an effect where it was not seen.

What was fitted over a minute, or between 1 and 2 m of height, says nothing of an hour, or of the
floor. Beyond its domain an effect fades, and what is not taken out any more counts as noise: the
filter believes such TDOAs less, instead of a guess.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .covariates import OF_ARRIVAL, OF_TDOA, UNITS
from .domain import share

if TYPE_CHECKING:
    from .base import Effect
    from .samples import Samples

LITTLE = 0.5  # share of an effect; where less is taken out, nodes say so


def faded(
    effect: Effect, samples: Samples
) -> tuple[np.ndarray, np.ndarray | float, np.ndarray | float]:
    """(bias of an Effect in Samples, (n,) m, NaN where it is not known; standard deviation of what
    of it is not taken out, (n,) m; share that is taken out, (n,)); the last two are 0.0 and 1.0
    without a domain. The time goes on to its end only: what grows with it is not known to grow
    further.
    """
    if not effect.domain:
        return effect.bias(samples), 0.0, 1.0
    left, n = np.ones(len(samples)), len(samples)
    for covariate, limits in effect.domain.items():
        if covariate in OF_ARRIVAL:
            left *= (
                share(OF_ARRIVAL[covariate](samples, samples.rows), limits)
                .reshape(-1, n)
                .min(axis=0)
            )
        elif (values := OF_TDOA[covariate](samples)) is not None:
            left *= share(values, limits)
    bias = effect.bias(
        samples.until(samples.start + effect.domain["time"][1])
        if "time" in effect.domain
        else samples
    )
    return left * bias, (1.0 - left) * np.abs(np.nan_to_num(bias)), left


def in_words(effect: Effect) -> str:
    """One phrase on an Effect with a domain."""
    seen = (
        f"{name} {low:.3g} to {high:.3g} {UNITS[name]}"
        for name, (low, high) in effect.domain.items()
    )
    return f"{effect.label} ({', '.join(seen)})"
