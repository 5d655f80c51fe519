"""Velocity, acceleration and turning rate out of a history of poses."""

from bisect import bisect_right

import numpy as np
from scipy.spatial.transform import Rotation

SPAN = 0.2  # s over which differences are taken


def motion(t, p, q, places):
    """Motion at some of the poses, from those before them alone.

    t : stamps, s; p : (3,) positions, m; q : (4,) attitudes x y z w; lists of one length. places : (n,) numbers of
    poses, -1 for none. Returns dict of v, acceleration (n, 3) m/s, m/s^2, world, and rate (n, 3) rad/s, body; NaN
    where unknown.
    """
    n = len(places)
    out = {name: np.full((n, 3), np.nan) for name in ("v", "acceleration", "rate")}
    known = {}
    for i, k in enumerate(places):
        if k not in known:
            known[k] = _at(t, p, q, k) if k > 0 else None
        if known[k] is not None:
            out["v"][i], out["acceleration"][i], out["rate"][i] = known[k]
    return out


def _at(t, p, q, k):
    one = bisect_right(t, t[k] - SPAN) - 1
    two = bisect_right(t, t[k] - 2.0 * SPAN) - 1
    if one < 0:
        return None
    v = (np.asarray(p[k]) - p[one]) / (t[k] - t[one])
    earlier = (np.asarray(p[one]) - p[two]) / (t[one] - t[two]) if two >= 0 else np.full(3, np.nan)
    turn = Rotation.from_quat(q[one]).inv() * Rotation.from_quat(q[k]) if np.isfinite([q[one], q[k]]).all() else None
    rate = np.full(3, np.nan) if turn is None else turn.as_rotvec() / (t[k] - t[one])
    return v, (v - earlier) / (t[k] - t[one]), rate
