"""Whatever else a log holds, as a covariate: the temperature of a sensor, the voltage of a battery,
the power of motors.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.effects.covariates import EXTRA

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.effects import ImuSamples, Samples
    from uwb_tdoa_bias.foundation.flight import Flight

FEWEST = 10  # samples of a stream


def extra_at(flight: Flight, t: np.ndarray) -> dict[str, np.ndarray]:
    """Values of the other streams of a Flight at the stamps t (n,) s: {"stream.column": (n,)}. What
    a simulation reports of itself is no log.
    """
    out = {}
    for name, columns in flight.extra.items():
        stamps = np.asarray(columns.get("t", ()), dtype=float)
        if name.endswith("_truth") or len(stamps) < FEWEST:
            continue
        for column, values in columns.items():
            values = np.asarray(values)
            if (
                column != "t"
                and values.dtype.kind in "fiu"
                and values.ndim == 1
                and np.ptp(values) > 0
            ):
                out[f"{name}.{column}"] = np.interp(t, stamps, values.astype(float))
    return out


def extra_names(parts: Sequence[Samples] | Sequence[ImuSamples]) -> list[str]:
    """Covariates "extra.STREAM.COLUMN" that all of some samples have: list."""
    return [
        EXTRA + name
        for name in sorted(set.intersection(*(set(part.extra or ()) for part in parts)))
    ]
