"""What a TDOA is when nothing is wrong with it."""

import numpy as np

from .compiled import compiled


def tdoa(p, a, b):
    """Difference of the distances to two anchors, d_ab = |p - b| - |p - a|.

    Parameters: p, a, b : (..., 3) positions of tag and anchors in one frame, metres. Returns (...) metres.
    Source: eq. 2 of Zhao et al. (RA-L 2021), with the sign that the Crazyflie firmware logs.
    """
    return np.linalg.norm(p - b, axis=-1) - np.linalg.norm(p - a, axis=-1)


def tdoa_jacobian(p, a, b):
    """Derivative of `tdoa` with respect to p: (..., 3), no unit. Zero where the tag sits on an antenna."""
    return _unit(p - b) - _unit(p - a)


def _unit(v):
    norm = np.linalg.norm(v, axis=-1, keepdims=True)
    return v / np.where(norm > 1e-9, norm, np.inf)


@compiled
def rotate(q, v, out):
    """out = R(q) v for a unit quaternion q = x y z w (body to world); all (k,) arrays."""
    x, y, z, w = q[0], q[1], q[2], q[3]
    tx = 2.0 * (y * v[2] - z * v[1])
    ty = 2.0 * (z * v[0] - x * v[2])
    tz = 2.0 * (x * v[1] - y * v[0])
    out[0] = v[0] + w * tx + y * tz - z * ty
    out[1] = v[1] + w * ty + z * tx - x * tz
    out[2] = v[2] + w * tz + x * ty - y * tx
