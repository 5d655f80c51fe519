"""The 14 features of Zhao et al. (RA-L 2021, section III): the relative poses of a tag and two anchors."""

import math

import numpy as np

from .compiled import compiled
from .geometry import rotate

# Azimuth (about z, from x) and elevation (above the x-y plane) of the tag seen from the antenna frame of each anchor (A),
# and of each anchor seen from the tag's body frame (T), rad; positions of the anchors relative to the tag, world axes, m.
FEATURES = (
    "dx_a", "dy_a", "dz_a", "dx_b", "dy_b", "dz_b",
    "azimuth_A_a", "azimuth_A_b", "azimuth_T_a", "azimuth_T_b",
    "elevation_A_a", "elevation_A_b", "elevation_T_a", "elevation_T_b",
)  # fmt: skip


def features(samples):
    """The features of a batch, in the order of FEATURES.

    Parameters: samples : Samples. Returns (n, 14) float; NaN where an attitude it needs is unknown.
    """
    out = np.empty((len(samples), len(FEATURES)))
    anchors = samples.anchors
    _fill(samples.p, samples.q, samples.a, samples.b, anchors.positions, anchors.orientations, out)
    return out


@compiled
def _fill(p, q, a, b, positions, orientations, out):
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


@compiled
def _conjugate(q, out):
    out[0], out[1], out[2], out[3] = -q[0], -q[1], -q[2], q[3]
