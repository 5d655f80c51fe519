# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Ground truths made by hand."""

import numpy as np

from uwb_tdoa_bias.common.flight import Truth


def truth_of(*legs, rate=100.0):
    """Return a Truth through points (stamp, x, y, z), linear in between."""
    stamps, *places = np.transpose(legs)
    t = np.arange(stamps[0], stamps[-1] + 0.5 / rate, 1.0 / rate)
    return Truth(
        t,
        np.stack([np.interp(t, stamps, values) for values in places], axis=1),
        np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1)),
    )


def flown(floor=0.03, rest=5.0, after=4.0):
    """Return the Truth of a flight that departs at `rest`, s.

    It climbs to 1 m within a second, stays there, and descends within a second.
    """
    up, down = rest + 1.0, rest + 11.0
    return truth_of(
        (0, 0, 0, floor),
        (rest, 0, 0, floor),
        (up, 0, 0, floor + 1),
        (down, 3, 0, floor + 1),
        (down + 1, 3, 0, floor),
        (down + 1 + after, 3, 0, floor),
    )
