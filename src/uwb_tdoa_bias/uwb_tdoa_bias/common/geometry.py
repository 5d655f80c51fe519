# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Geometry of a TDOA without systematic effects, and rotations.

The numpy functions take arrays of any shape. The compiled functions do the same for single TDOAs
and short arrays, since the filter needs them a thousand times per second. A test requires equal
bits.
"""

from __future__ import annotations

import math

import numpy as np

from .compiled import compiled

_ON_ANTENNA = 1e-9  # m; closer, the direction of an antenna is undefined


def ranges(p: np.ndarray, anchors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the distances between tag and anchors, and their derivatives by the tag's position.

    Parameters
    ----------
    p, anchors : (..., 3) m, one frame

    Returns
    -------
    distance : (...) m
    direction : (..., 3) unit vectors from anchor to tag; zero where the tag sits on the antenna
    """
    delta = p - anchors
    distance = np.linalg.norm(delta, axis=-1)
    return distance, delta / np.where(distance > _ON_ANTENNA, distance, np.inf)[..., None]


def tdoa(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the difference of the distances to two anchors, d_ab = |p - b| - |p - a|: (...) m.

    Source: eq. 2 of Zhao et al. (RA-L 2021), with the sign that the Crazyflie firmware logs.

    Parameters
    ----------
    p : (..., 3) m, tag
    a, b : (..., 3) m, both anchors, in the frame of p
    """
    return np.linalg.norm(p - b, axis=-1) - np.linalg.norm(p - a, axis=-1)


def tdoa_jacobian(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the derivative of `tdoa` with respect to p: (..., 3), no unit.

    It is zero where the tag sits on an antenna.
    """
    return ranges(p, b)[1] - ranges(p, a)[1]


@compiled
def tdoa_each(p: np.ndarray, a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    """Write `tdoa` of n measurements to out (n,), m; compiled.

    For arrays so short that the overhead of each numpy operation dominates.

    p, a, b : (n, 3) m, one frame
    """
    for i in range(len(p)):
        ax, ay, az = p[i, 0] - a[i, 0], p[i, 1] - a[i, 1], p[i, 2] - a[i, 2]
        bx, by, bz = p[i, 0] - b[i, 0], p[i, 1] - b[i, 1], p[i, 2] - b[i, 2]
        out[i] = math.sqrt(bx * bx + by * by + bz * bz) - math.sqrt(ax * ax + ay * ay + az * az)


@compiled
def linearized_tdoa(p: np.ndarray, a: np.ndarray, b: np.ndarray, jacobian: np.ndarray) -> float:
    """Return `tdoa`, m, and write `tdoa_jacobian` to `jacobian` (3,), no unit; compiled.

    p, a, b : (3,) m, one frame
    """
    ax, ay, az = p[0] - a[0], p[1] - a[1], p[2] - a[2]
    bx, by, bz = p[0] - b[0], p[1] - b[1], p[2] - b[2]
    range_a = math.sqrt(ax * ax + ay * ay + az * az)
    range_b = math.sqrt(bx * bx + by * by + bz * bz)
    scale_a = range_a if range_a > _ON_ANTENNA else np.inf
    scale_b = range_b if range_b > _ON_ANTENNA else np.inf
    jacobian[0] = bx / scale_b - ax / scale_a
    jacobian[1] = by / scale_b - ay / scale_a
    jacobian[2] = bz / scale_b - az / scale_a
    return range_b - range_a


@compiled
def rotate(q: np.ndarray, v: np.ndarray, out: np.ndarray) -> None:
    """Write R(q) v to out (3,); compiled.

    Parameters
    ----------
    q : (4,) unit quaternion x y z w, body to world
    v : (3,), body
    """
    x, y, z, w = q[0], q[1], q[2], q[3]
    tx = 2.0 * (y * v[2] - z * v[1])
    ty = 2.0 * (z * v[0] - x * v[2])
    tz = 2.0 * (x * v[1] - y * v[0])
    out[0] = v[0] + w * tx + y * tz - z * ty
    out[1] = v[1] + w * ty + z * tx - x * tz
    out[2] = v[2] + w * tz + x * ty - y * tx


@compiled
def rotate_each(q: np.ndarray, v: np.ndarray, out: np.ndarray) -> None:
    """Write R(q) v for n quaternions and one vector to out (n, 3).

    The result is NaN where q is zero or not finite. Compiled.

    Parameters
    ----------
    q : (n, 4) x y z w, of any length
    v : (3,)
    """
    unit = np.empty(4)
    for i in range(len(q)):
        length = math.sqrt(q[i, 0] ** 2 + q[i, 1] ** 2 + q[i, 2] ** 2 + q[i, 3] ** 2)
        if length > 0.0 and length < np.inf:
            unit[:] = q[i] / length
            rotate(unit, v, out[i])
        else:
            out[i] = np.nan
