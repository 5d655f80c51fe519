# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Features of a network: the 14 inputs of Zhao et al., and the attitude, which limits its use.

Source: Zhao et al. (RA-L 2021), section III.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from ..common.arrays import filled
from ..common.compiled import compiled
from ..common.geometry import rotate

if TYPE_CHECKING:
    from collections.abc import Iterable

    from ..effects.samples import Samples

# d*: position of both anchors relative to the tag, m, world axes. Azimuth (about z, from x) and
# elevation (above the xy plane), rad. A: of the tag in the antenna frame of each anchor. T: of each
# anchor in the tag's body frame.
FEATURES = (
    "dx_a",
    "dy_a",
    "dz_a",
    "dx_b",
    "dy_b",
    "dz_b",
    "azimuth_A_a",
    "azimuth_A_b",
    "azimuth_T_a",
    "azimuth_T_b",
    "elevation_A_a",
    "elevation_A_b",
    "elevation_T_a",
    "elevation_T_b",
)

ATTITUDE = "forward_x", "forward_y", "up_x", "up_y"  # horizontal parts of the body's x and z axes
NAMES = FEATURES + ATTITUDE


def columns(samples: Samples, names: Iterable[str]) -> np.ndarray:
    """Return some features of a batch, (n, len(names)) float; NaN where unknown.

    names : out of NAMES
    """
    return everything(samples)[:, [NAMES.index(name) for name in names]]


def everything(samples: Samples) -> np.ndarray:
    """Return all features of a batch, (n, 18) float, in the order of NAMES.

    They are NaN where they need an unknown pose.
    """
    n, anchors = len(samples), samples.anchors
    ends = samples.p, samples.q, samples.a, samples.b
    return filled(_fill, (n, len(NAMES)), *ends, anchors.positions, anchors.orientations)


@compiled
def _fill(
    p: np.ndarray,
    q: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    positions: np.ndarray,
    orientations: np.ndarray,
    out: np.ndarray,
) -> None:
    delta = np.empty(3)
    inverse = np.empty(4)
    seen = np.empty(3)
    for i in range(len(a)):
        for side in range(2):
            anchor = a[i] if side == 0 else b[i]
            for k in range(3):
                delta[k] = positions[anchor, k] - p[i, k]
                out[i, 3 * side + k] = delta[k]
            _conjugate(q[i], inverse)
            rotate(inverse, delta, seen)
            out[i, 8 + side] = math.atan2(seen[1], seen[0])
            out[i, 12 + side] = math.atan2(seen[2], math.hypot(seen[0], seen[1]))
            for k in range(3):
                delta[k] = -delta[k]
            _conjugate(orientations[anchor], inverse)
            rotate(inverse, delta, seen)
            out[i, 6 + side] = math.atan2(seen[1], seen[0])
            out[i, 10 + side] = math.atan2(seen[2], math.hypot(seen[0], seen[1]))
        x, y, z, w = q[i]
        out[i, 14], out[i, 15] = 1 - 2 * (y * y + z * z), 2 * (x * y + z * w)
        out[i, 16], out[i, 17] = 2 * (x * z + y * w), 2 * (y * z - x * w)


@compiled
def _conjugate(q: np.ndarray, out: np.ndarray) -> None:
    out[0], out[1], out[2], out[3] = -q[0], -q[1], -q[2], q[3]
