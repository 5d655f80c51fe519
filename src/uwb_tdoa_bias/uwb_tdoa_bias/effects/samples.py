"""A batch of TDOAs with the motion of the tag, as effects see it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from ..foundation.anchors import Anchors

MOTION_TIME = 0.1  # s over which velocity, acceleration and turning rate are taken


@dataclass(frozen=True)
class Samples:
    """A batch of TDOAs and the pose the tag had, or was believed to have, when they were taken.

    t : (n,) s; a, b : (n,) rows of `anchors`; p : (n, 3) m, world; q : (n, 4) x y z w, body to world, NaN if unknown.
    start : s, stamp of the first TDOA of the recording, from which slow changes count.
    v, acceleration : (n, 3) m/s and m/s^2, world, of the body; rate : (n, 3) rad/s, body; each None if nobody asked.
    interval : (n,) s since the TDOA before; previous : (n,) id of the later anchor of that; vibration : (n,) m/s^2,
    root of the power of the high-passed accelerometer; None if unknown.
    extra : {name: (n,)}, anything else that a recording holds; None if nobody asked.
    yaw_std : (n,) rad, standard deviation of the yaw in q; None for a known one.
    """

    t: np.ndarray
    a: np.ndarray
    b: np.ndarray
    p: np.ndarray
    q: np.ndarray
    anchors: Anchors
    start: float = 0.0
    v: np.ndarray | None = None
    acceleration: np.ndarray | None = None
    rate: np.ndarray | None = None
    interval: np.ndarray | None = None
    previous: np.ndarray | None = None
    vibration: np.ndarray | None = None
    extra: dict | None = None
    yaw_std: np.ndarray | None = None

    def __len__(self):
        return len(self.t)

    @property
    def position_a(self):
        """(n, 3) antennas of the first anchors, m."""
        return self.anchors.positions[self.a]

    @property
    def position_b(self):
        """(n, 3) antennas of the second anchors, m."""
        return self.anchors.positions[self.b]


def samples_at(t, a, b, poses, anchors, start=0.0, motion=True):
    """Samples of TDOAs (t, a, b as in Samples) at poses interpolated linearly, attitudes on the great circle.

    poses : Truth, or anything with t (m,), p (m, 3), q (m, 4). Beyond its ends the nearest pose counts.
    motion : give velocity, acceleration and turning rate too.
    """
    stamps, first = np.unique(poses.t, return_index=True)
    p, q = poses.p[first], poses.q[first]
    if len(stamps) < 2:
        stamps, p, q = np.array([stamps[0], stamps[0] + 1.0]), np.repeat(p, 2, axis=0), np.repeat(q, 2, axis=0)

    def place(at):
        return np.stack([np.interp(at, stamps, p[:, k]) for k in range(3)], axis=1)

    h = 0.5 * MOTION_TIME
    at, turn = place(t), None
    attitude, rate = np.full((len(t), 4), np.nan), np.full((len(t), 3), np.nan)
    known = np.isfinite(q).all(axis=1)
    if known.sum() > 1:
        turn = Slerp(stamps[known], Rotation.from_quat(q[known]))
        low, high = stamps[known][0], stamps[known][-1]
        attitude = turn(np.clip(t, low, high)).as_quat()
    if not motion:
        return Samples(t, a, b, at, attitude, anchors, start)
    if turn is not None:
        swing = turn(np.clip(t - h, low, high)).inv() * turn(np.clip(t + h, low, high))
        rate = swing.as_rotvec() / MOTION_TIME
    return Samples(
        t, a, b, at, attitude, anchors, start,
        v=(place(t + h) - place(t - h)) / MOTION_TIME,
        acceleration=(place(t + 2 * h) - 2.0 * at + place(t - 2 * h)) / (2 * h) ** 2,
        rate=rate,
    )  # fmt: skip


def true_samples(flight):
    """(Samples, rows): the usable TDOAs of a Flight at its ground truth, and which rows of flight.tdoa they are."""
    tdoa = flight.tdoa
    a, b = flight.anchors.index(tdoa.a), flight.anchors.index(tdoa.b)
    rows = np.flatnonzero((a >= 0) & (b >= 0) & (a != b) & np.isfinite(tdoa.d) & np.isfinite(tdoa.t))
    start = float(tdoa.t[0]) if len(tdoa) else 0.0
    return samples_at(tdoa.t[rows], a[rows], b[rows], flight.truth, flight.anchors, start), rows
