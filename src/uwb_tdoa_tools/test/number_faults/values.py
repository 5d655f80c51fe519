# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Faults in the values of TDOAs, of one pair or of every pair.

Each is a callable(Flight, Generator) -> Flight.
"""

from dataclasses import replace

import numpy as np

# smallest and largest number of packets over which values are held or interpolated; excludes the
# end
STEPS = 2, 11


def rows_of_pairs(flight, rng, every):
    """Return [rows (n,)] of each measured pair, or of one frequently measured pair."""
    of = flight.tdoa
    heard, key, count = np.unique(
        np.column_stack([of.a, of.b]), axis=0, return_inverse=True, return_counts=True
    )
    often = np.flatnonzero(count >= 0.8 * np.median(count))
    chosen = range(len(heard)) if every else [rng.choice(often)]
    return [np.flatnonzero(key.reshape(-1) == k) for k in chosen]


def of_pairs(change, every):
    """Return a fault of the values of one pair, or of every pair in the same way.

    change : (draw, apply); size = draw(rng, values), values = apply(values, t, size)
    """
    draw, apply = change

    def fault(flight, rng):
        d, size = flight.tdoa.d.copy(), draw(rng, flight.tdoa.d)
        for rows in rows_of_pairs(flight, rng, every):
            d[rows] = apply(d[rows], flight.tdoa.t[rows], size)
        return replace(flight, tdoa=replace(flight.tdoa, d=d))

    return fault


def _packets(rng, d):
    return int(rng.integers(*STEPS))


def _held(d, t, packets):
    return d[np.arange(len(d)) // packets * packets]


def _rounded(d, t, grid):
    return np.round(d / grid) * grid


def _clipped(d, t, limit):
    return np.clip(d, -limit, limit)


def _interval(rng, d):
    first = rng.uniform(0.2, 0.5)
    return first, first + rng.uniform(0.15, 0.35)


def _stands(d, t, interval):
    """Hold the last value over an interval, given as two shares of the flight."""
    first, last = (np.searchsorted(t, t[0] + share * (t[-1] - t[0])) for share in interval)
    return np.concatenate([d[:first], np.full(last - first, d[max(first - 1, 0)]), d[last:]])


def _late(d, t, packets):
    return np.concatenate([d[: min(packets, len(d))], d[:-packets]])[: len(d)]


def _interpolated(d, t, packets):
    """Keep every n-th value, n = packets. Interpolate linearly in between."""
    known = np.arange(0, len(d), packets)
    return np.interp(np.arange(len(d)), known, d[known])


REPEATED = _packets, _held
ROUNDED = (
    (lambda rng, d: float(np.round(np.exp(rng.uniform(np.log(0.1), np.log(2.0))), 2))),
    _rounded,
)
CLIPPED = (lambda rng, d: np.quantile(np.abs(d), rng.uniform(0.3, 0.85))), _clipped
FROZEN = _interval, _stands
LATE = _packets, _late
INTERPOLATED = _packets, _interpolated
