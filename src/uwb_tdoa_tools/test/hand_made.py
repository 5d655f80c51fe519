# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Ground truths made by hand."""

import numpy as np

from uwb_tdoa_bias.common.flight import Truth


def truth_of(*legs, rate=100.0):
    """A Truth through (stamp, x, y, z), straight in between."""
    stamps, *places = np.transpose(legs)
    t = np.arange(stamps[0], stamps[-1] + 0.5 / rate, 1.0 / rate)
    return Truth(
        t,
        np.stack([np.interp(t, stamps, values) for values in places], axis=1),
        np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1)),
    )


def flown(floor=0.03, rest=5.0, after=4.0):
    """On the floor, a second up to 1 m above it, there, and a second down; departs at `rest`."""
    up, down = rest + 1.0, rest + 11.0
    return truth_of(
        (0, 0, 0, floor),
        (rest, 0, 0, floor),
        (up, 0, 0, floor + 1),
        (down, 3, 0, floor + 1),
        (down + 1, 3, 0, floor),
        (down + 1 + after, 3, 0, floor),
    )
