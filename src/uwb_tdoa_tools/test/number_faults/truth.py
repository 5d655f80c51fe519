# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Faults in the ground truth."""

from dataclasses import replace

import numpy as np

from uwb_tdoa_bias.common.flight import Truth


def _middle(flight, rng):
    t = flight.truth.t[flight.truth.p[:, 2] > 0.5]
    return t[0] + rng.uniform(0.3, 0.6) * (t[-1] - t[0])


def hole(flight, rng):
    """Drop the poses of two to four seconds."""
    of, first = flight.truth, _middle(flight, rng)
    seen = (of.t < first) | (of.t > first + rng.uniform(2.0, 4.0))
    return replace(flight, truth=Truth(of.t[seen], of.p[seen], of.q[seen]))


def leap(flight, rng):
    """Shift the positions by 0.3 to 2 m for one to five seconds."""
    of, first = flight.truth, _middle(flight, rng)
    moved = (of.t >= first) & (of.t < first + rng.uniform(1.0, 5.0))
    shift = rng.standard_normal(3)
    shift *= rng.uniform(0.3, 2.0) / np.linalg.norm(shift)
    return replace(flight, truth=Truth(of.t, of.p + moved[:, None] * shift, of.q))


def attitude(flight, rng):
    """Mirror the attitude about one axis, invert it, or put w first."""
    x, y, z, w = flight.truth.q.T
    columns = [(x, -y, -z, w), (-x, y, -z, w), (-x, -y, z, w), (-x, -y, -z, w), (w, x, y, z)][
        rng.integers(5)
    ]
    return replace(flight, truth=replace(flight.truth, q=np.column_stack(columns)))
