# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The poses of the last seconds, and a queue of measurements that wait for a pose."""

from __future__ import annotations

from collections import deque
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..common.compiled import compiled
from ..effects.samples import precede

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike


POSE_NUMBERS, TWIST_NUMBERS = 3 + 4 + 36, 6 + 36  # of PoseWithCovariance and TwistWithCovariance
HISTORY = 4096  # poses kept at least
# s after the first pose. Earlier TDOAs are corrected without a pose, which costs accuracy.
START = 0.2
TILT = 0.5  # rad; with a larger tilt std the filter estimates no attitude


class Columns(NamedTuple):
    """Poses as arrays.

    Attributes
    ----------
    t : (m,) s
    p : (m, 3) m, world
    q : (m, 4) x y z w, body to world
    v : (m, 3) m/s, world; NaN if unknown
    yaw_std : (m,) rad
    """

    t: np.ndarray
    p: np.ndarray
    q: np.ndarray
    v: np.ndarray
    yaw_std: np.ndarray


class Poses:
    """Poses in the order of their stamps; at least the last `history` are kept.

    No pose is used in the first `start` s after the first pose. The first pose may arrive that much
    later than its stamp without changing a result.

    begin : stamp, s, from which poses are used: `start` s after the first pose; inf before it
    """

    def __init__(self, history: int = HISTORY, start: float = START) -> None:
        self._start = start
        self._columns = Columns(
            *(np.empty((2 * history, *shape)) for shape in ((), (3,), (4,), (3,), ()))
        )
        self.clear()

    def clear(self) -> None:
        """Delete all poses."""
        self._count, self.begin = 0, math.inf

    @property
    def kept(self) -> Columns:
        """All kept poses."""
        return Columns(*(column[: self._count] for column in self._columns))

    @property
    def newest(self) -> float:
        """Stamp of the last pose, s; -inf if there is none."""
        return self._columns.t[self._count - 1] if self._count else -np.inf

    def add(
        self, t: ArrayLike, p: ArrayLike, q: ArrayLike, v: ArrayLike, yaw_std: ArrayLike
    ) -> None:
        """Append one pose, or k poses; poses not later than all before them are ignored.

        Parameters
        ----------
        t : (k,) s
        p : (k, 3) m
        q : (k, 4) x y z w
        v : (k, 3) m/s
        yaw_std : (k,) rad
        """
        parts: Any = (t, p, q, v, yaw_std) if np.ndim(t) else ([t], [p], [q], [v], [yaw_std])
        new = Columns(*(np.ascontiguousarray(part, dtype=float) for part in parts))
        self._count = _append(self._count, self._columns, new)
        if self._count and self.begin == math.inf:
            self.begin = float(self._columns.t[0]) + self._start

    def before(
        self, t: np.ndarray, newest: float, lag: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the newest pose at least `lag` s before the TDOA that precedes each TDOA.

        Parameters
        ----------
        t : (n,) s, of the TDOAs; `preceding` gives the TDOA before each
        newest : latest stamp of earlier TDOAs, s
        lag : s

        Returns
        -------
        places, p, q, yaw_std : (n,) int, (n, 3) m, (n, 4), (n,) rad; -1 and NaN where there is no pose,
            and before `begin`
        """
        n = len(t)
        out = np.empty(n, dtype=np.int64), np.empty((n, 3)), np.empty((n, 4)), np.empty(n)
        _look_up(t, newest, (lag, self.begin), self._count, self._columns, out)
        return out


@compiled
def _append(count: int, kept: Columns, new: Columns) -> int:
    """Append poses that are later than all before them, and return the new count; compiled.

    A full array keeps its last half.
    """
    history = len(kept.t) // 2
    for i in range(len(new.t)):
        if not new.t[i] > (kept.t[count - 1] if count else -np.inf):
            continue
        if count == 2 * history:
            kept.t[:history] = kept.t[history:]
            kept.p[:history] = kept.p[history:]
            kept.q[:history] = kept.q[history:]
            kept.v[:history] = kept.v[history:]
            kept.yaw_std[:history] = kept.yaw_std[history:]
            count = history
        kept.t[count], kept.yaw_std[count] = new.t[i], new.yaw_std[i]
        kept.p[count], kept.q[count], kept.v[count] = new.p[i], new.q[i], new.v[i]
        count += 1
    return count


@compiled
def _look_up(
    t: np.ndarray,
    newest: float,
    limits: tuple[float, float],
    count: int,
    kept: Columns,
    out: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    places, p, q, yaw_std = out[0], out[1], out[2], out[3]
    lag, begin = limits[0], limits[1]
    precede(t, newest, yaw_std)
    for i in range(len(t)):
        place = (
            np.searchsorted(kept.t[:count], yaw_std[i] - lag, side="right") - 1
            if yaw_std[i] >= begin
            else -1
        )
        places[i] = place
        if place >= 0:
            p[i], q[i], yaw_std[i] = kept.p[place], kept.q[place], kept.yaw_std[place]
        else:
            p[i], q[i], yaw_std[i] = np.nan, np.nan, np.nan


def known_yaw_std(std: np.ndarray) -> np.ndarray:
    """Return the standard deviation of the yaw, (n,) rad.

    It is 0 where the tilt is unknown: such a filter estimates no attitude, and means level at yaw 0.

    std : (n, 3) rad, of the attitude about the axes of the world
    """
    return np.where(np.maximum(std[:, 0], std[:, 1]) < TILT, std[:, 2], 0.0)


def parts_of(
    poses: np.ndarray, twists: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the input of a Corrector from numbers of nav_msgs/Odometry.

    Parameters
    ----------
    poses : (n, 43), PoseWithCovariance, in the order of the message
    twists : (n, 42), TwistWithCovariance, body, in the order of the message

    Returns
    -------
    p, q, v, yaw_std : (n, 3) m, (n, 4) x y z w, (n, 3) m/s, world, (n,) rad; q is NaN for the
        orientation (0, 0, 0, 0), which means unknown
    """
    p, q, v, std = (np.empty((len(poses), k)) for k in (3, 4, 3, 3))
    _part(poses, twists, p, q, v, std)
    return p, q, v, known_yaw_std(std)


@compiled
def _part(
    poses: np.ndarray,
    twists: np.ndarray,
    p: np.ndarray,
    q: np.ndarray,
    v: np.ndarray,
    std: np.ndarray,
) -> None:
    for n in range(len(poses)):
        p[n], q[n] = poses[n, :3], poses[n, 3:7]
        if not q[n].any():
            q[n] = np.nan
        x, y, z, w = q[n]
        a, b, c = twists[n, :3]
        # R(q) v = v + w d + (x, y, z) x d, with d = 2 (x, y, z) x v
        d, e, f = (2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a))
        v[n, 0], v[n, 1], v[n, 2] = (
            a + w * d + y * f - z * e,
            b + w * e + z * d - x * f,
            c + w * f + x * e - y * d,
        )
        for axis in range(3):
            std[n, axis] = math.sqrt(max(poses[n, 7 + 7 * (3 + axis)], 0.0))


def rotated_in_yaw(q: np.ndarray, quarters: int) -> np.ndarray:
    """Return attitudes turned about the vertical by some quarters of a turn.

    q : (n, 4) x y z w
    """
    s, c = np.sin(0.25 * np.pi * quarters), np.cos(0.25 * np.pi * quarters)
    x, y, z, w = q.T
    return np.stack([c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z], axis=1)


MOST = 10_000  # items; limits a queue whose stamps stand still


class PoseQueue:
    """A queue in order of arrival; its first item leaves when it is ready, or has waited too long.

    Whether an item is ready depends on the stamp of the item before it. An item has waited too long
    if a newer item is stamped more than `limit` s later. The same holds if more than MOST items wait.
    """

    def __init__(self, limit: float) -> None:
        """Set the limit of the wait, s."""
        self.limit = limit
        self._items: deque[tuple[float, float, Any]] = deque()
        self._newest: float = None  # type: ignore[assignment]  # latest stamp so far, s, once there is one

    def __len__(self) -> int:
        return len(self._items)

    def add(self, t: float, item: Any) -> None:
        """Append an item stamped t, s."""
        newest = t if self._newest is None else self._newest
        self._items.append((t, min(t, newest), item))
        self._newest = max(newest, t)

    def shorten(self, most: int) -> int:
        """Remove the oldest of more than `most` items, and return their number."""
        removed = max(len(self._items) - most, 0)
        for _ in range(removed):
            self._items.popleft()
        return removed

    def take(self, ready: Callable[[float], bool]) -> list[tuple[float, Any, bool]]:
        """Remove and return the items that may leave: a list of (t, item, ready(before)).

        before : s, the latest stamp added before the item, at most t; t for the first item
        """
        out = []
        while self._items:
            t, before, item = self._items[0]
            is_ready = ready(before)
            if not is_ready and self._newest - t <= self.limit and len(self._items) <= MOST:
                break
            out.append((t, item, is_ready))
            self._items.popleft()
        return out
