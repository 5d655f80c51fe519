# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Faults in the stamps of a stream. The result is sorted by stamp, as a reader sorts it."""

from dataclasses import replace

import numpy as np


def of_stream(stream, change):
    """Return a fault of the stamps of "tdoa" or "imu": change(t, rng) -> t."""

    def fault(flight, rng):
        part = getattr(flight, stream)
        t = change(part.t, rng)
        order = np.argsort(t, kind="stable")
        columns = {name: column[order] for name, column in vars(part).items()}
        return replace(flight, **{stream: replace(part, **{**columns, "t": t[order]})})

    return fault


def _signed(rng, low, high):
    return rng.choice([-1.0, 1.0]) * np.exp(rng.uniform(np.log(low), np.log(high)))


def quantised(t, rng):
    """Round down to steps of 20 ms to 0.5 s."""
    step = _signed(rng, 0.02, 0.5)
    return t[0] + np.floor((t - t[0]) / abs(step)) * abs(step)


def drifting(t, rng):
    """Drift by 0.1 to 1 s over the flight."""
    return t + _signed(rng, 0.1, 1.0) * (t - t[0]) / (t[-1] - t[0])


def jumping(t, rng):
    """Jump by 0.1 to 1 s near the middle of the flight."""
    return t + _signed(rng, 0.1, 1.0) * (t - t[0] > rng.uniform(0.3, 0.7) * (t[-1] - t[0]))
