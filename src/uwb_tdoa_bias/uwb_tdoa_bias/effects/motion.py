"""Velocity, acceleration and turning rate out of a history of the filter's states: what a node can
know when it corrects a TDOA.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

import numpy as np

from ..foundation.compiled import compiled

SPAN = 0.2  # s over which differences are taken
POSE_LAG = 0.05  # s by which the pose that a TDOA is corrected at is older than the TDOA before it


@dataclass(frozen=True)
class Motion:
    """velocity, acceleration : (n, 3) m/s, m/s^2, world; rate : (n, 3) rad/s, body; NaN where
    unknown.
    """

    velocity: np.ndarray
    acceleration: np.ndarray
    rate: np.ndarray


def motion_at(t: np.ndarray, v: np.ndarray, q: np.ndarray, places: np.ndarray) -> Motion:
    """Motion at some of the states, from those before them alone: acceleration and rate are
    backward differences over SPAN.

    t (m,) rising stamps, s; v (m, 3) m/s, world; q (m, 4) x y z w; places (n,) numbers of states,
    -1 for none.
    """
    out = np.full((3, len(places), 3), np.nan)
    _differences(t, v, q, places, out)
    return Motion(*out)


def preceding(t: np.ndarray, newest: float | None = None) -> np.ndarray:
    """Stamp of the TDOA that precedes each of some: (n,) s. t (n,) s, in order of arrival; newest :
    latest stamp of all before them, s. The first of all precedes itself; a stamp that has fallen
    back counts as its own.
    """
    out = np.empty(len(t))
    precede(t, t[0] if newest is None else newest, out)
    return out


@compiled
def precede(t: np.ndarray, newest: float, out: np.ndarray) -> None:
    """`preceding`, compiled, written to out (n,)."""
    for i in range(len(t)):
        out[i] = min(newest, t[i])
        newest = max(newest, t[i])


@compiled
def _differences(
    t: np.ndarray, v: np.ndarray, q: np.ndarray, places: np.ndarray, out: np.ndarray
) -> None:
    for i in range(len(places)):
        k = places[i]
        if k < 0:
            continue
        out[0, i] = v[k]
        near = np.searchsorted(t, t[k] - SPAN, side="right") - 1
        if near < 0:
            continue
        dt = t[k] - t[near]
        for axis in range(3):
            out[1, i, axis] = (v[k, axis] - v[near, axis]) / dt
        # the turn from the earlier attitude to the later one, in the body frame, as a rotation
        # vector
        ax, ay, az, aw = -q[near, 0], -q[near, 1], -q[near, 2], q[near, 3]
        bx, by, bz, bw = q[k, 0], q[k, 1], q[k, 2], q[k, 3]
        x = aw * bx + ax * bw + ay * bz - az * by
        y = aw * by - ax * bz + ay * bw + az * bx
        z = aw * bz + ax * by - ay * bx + az * bw
        w = aw * bw - ax * bx - ay * by - az * bz
        sine = math.sqrt(x * x + y * y + z * z)
        angle = 2.0 * math.atan2(sine, abs(w))
        scale = (angle / sine if sine > 1e-12 else 2.0) * (1.0 if w >= 0.0 else -1.0) / dt
        out[2, i, 0], out[2, i, 1], out[2, i, 2] = scale * x, scale * y, scale * z
