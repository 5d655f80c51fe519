# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Faults in ids, signs and packets of TDOAs."""

from dataclasses import replace

import numpy as np

from .values import rows_of_pairs


def _taken(flight, rows):
    return replace(
        flight, tdoa=type(flight.tdoa)(*(column[rows] for column in vars(flight.tdoa).values()))
    )


def ids(flight, rng):
    """Exchange the ids of two anchors."""
    one, two = rng.choice(np.unique(flight.tdoa.a), 2, replace=False)
    table = {one: two, two: one}
    a, b = (
        np.array([table.get(i, i) for i in ids.tolist()]) for ids in (flight.tdoa.a, flight.tdoa.b)
    )
    return replace(flight, tdoa=replace(flight.tdoa, a=a, b=b))


def sign(every):
    """Flip the sign of one pair, or of every pair."""

    def fault(flight, rng):
        d = flight.tdoa.d.copy()
        for rows in rows_of_pairs(flight, rng, every):
            d[rows] *= -1.0
        return replace(flight, tdoa=replace(flight.tdoa, d=d))

    return fault


def twice(flight, rng):
    """Repeat a share of the packets several times."""
    share, times = rng.uniform(0.3, 1.0), int(rng.integers(2, 6))
    count = np.where(rng.random(len(flight.tdoa)) < share, times, 1)
    return _taken(flight, np.repeat(np.arange(len(flight.tdoa)), count))


def reordered(flight, rng):
    """Shuffle packets within blocks. The stamps stay in order."""
    of, block = flight.tdoa, rng.uniform(0.1, 2.0)
    order = np.lexsort((rng.random(len(of)), np.floor((of.t - of.t[0]) / block)))
    return replace(flight, tdoa=replace(_taken(flight, order).tdoa, t=of.t))


def missing(flight, rng):
    """Drop all TDOAs of one anchor, for a while or all the time."""
    of, number = flight.tdoa, rng.choice(np.unique(flight.tdoa.a))
    first, length = rng.uniform(0.0, 0.5), rng.uniform(0.2, 1.0)
    share = (of.t - of.t[0]) / (of.t[-1] - of.t[0])
    lost = ((of.a == number) | (of.b == number)) & (share >= first) & (share < first + length)
    return _taken(flight, np.flatnonzero(~lost))


def lost(flight, rng):
    """Drop all TDOAs for some seconds, again and again."""
    of, period = flight.tdoa, rng.uniform(8.0, 15.0)
    return _taken(flight, np.flatnonzero((of.t - of.t[0]) % period > rng.uniform(0.6, 3.0)))
