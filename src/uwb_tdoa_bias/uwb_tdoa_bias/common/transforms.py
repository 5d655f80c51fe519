# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A tree of frames and the transforms between them: the content of TF, without ROS."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
import math
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from .arrays import rotations
from .errors import InputError

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    from scipy.spatial.transform import Rotation

KEPT = 1000  # transforms kept per moving frame
HELD = 0.5  # s, validity of the last transform of a moving frame
DEEPEST = 100  # frames up to the root
MOST, MOST_MOVING = 1000, 200  # constant frames, and moving frames
SHORTEST, LONGEST = 1e-3, 1e3  # norm of a quaternion, nominally 1
# m and rad. A constant transform that is sent again with a smaller change counts as the same.
SAME_PLACE, SAME_TURN = (1e-3, 1e-3)
FARTHEST = 1e8  # m; squares of larger offsets times rates may overflow

# of a frame in another one, e.g. of a sensor in the body: its turn, and its arm (3,) m
Place: TypeAlias = "tuple[Rotation, np.ndarray]"
_Moved = tuple[float, tuple[float, ...], tuple[float, ...]]  # t, q and p


class Frames:
    """A tree of frames; the transform of each to its parent is constant or moves with time."""

    def __init__(self) -> None:
        self._static: dict[
            str, tuple[str, Rotation, np.ndarray]
        ] = {}  # {frame: (parent, Rotation, p)}
        self._moving: dict[str, tuple[str, deque[_Moved]]] = {}  # {frame: (parent, last ones)}

    def set(self, parent: str, child: str, q: Sequence[float], p: Sequence[float]) -> bool:
        """Set a constant transform, and return whether it is new.

        x_parent = R(q) x_child + p. Raises InputError for an invalid transform.

        Parameters
        ----------
        parent, child : names of frames
        q : (4,) x y z w
        p : (3,) m
        """
        new = self.differs(parent, child, q, p)
        if new:
            self._static[child] = parent, rotations.Rotation.from_quat(q), np.array(p, dtype=float)
        return new

    def knows(self, child: str) -> bool:
        """Return whether a frame has a constant transform."""
        return child in self._static

    def differs(self, parent: str, child: str, q: Sequence[float], p: Sequence[float]) -> bool:
        """Return whether `set` would change something; a frozen node asks before it refuses.

        It would if the child is unknown, has another parent, or differs by more than SAME_PLACE or
        SAME_TURN. Parameters as for `set`. Raises InputError as `set`.
        """
        self._check(self._static, MOST, parent, child, q, p)
        known = self._static.get(child)
        if known is None or known[0] != parent or np.linalg.norm(known[2] - p) > SAME_PLACE:
            return True
        return bool((known[1].inv() * rotations.Rotation.from_quat(q)).magnitude() > SAME_TURN)

    def move(
        self, parent: str, child: str, q: Sequence[float], p: Sequence[float], t: float
    ) -> None:
        """Add the transform at stamp t, s, of a moving frame; the other parameters as for `set`.

        A transform that is not later than the last one is ignored. Another parent, or a stamp more than
        1 s before the last one, deletes the earlier transforms. Raises InputError for an invalid transform.
        """
        self._check(self._moving, MOST_MOVING, parent, child, q, p)
        known = self._moving.get(child)
        if known is None or known[0] != parent:
            known = self._moving[child] = parent, deque(maxlen=KEPT)
        course = known[1]
        if course and t < course[-1][0] - 1.0:
            course.clear()  # time went back
        if not course or t > course[-1][0]:
            course.append((t, tuple(q), tuple(p)))

    def _check(
        self,
        known: Collection[str],
        most: int,
        parent: str,
        child: str,
        q: Sequence[float],
        p: Sequence[float],
    ) -> None:
        if not all(map(math.isfinite, (*q, *p))):
            raise InputError(
                f"{parent} -> {child}: q = {tuple(q)}, p = {tuple(p)} must be finite numbers."
            )
        if max(map(abs, p)) > FARTHEST:
            raise InputError(
                f"{parent} -> {child}: p = {tuple(p)} must be metres, at most {FARTHEST:g} "
                "along each axis."
            )
        if not SHORTEST <= math.hypot(*q) <= LONGEST:
            raise InputError(
                f"{parent} -> {child}: {tuple(q)} is no rotation; give a quaternion x, y, z, "
                "w of length 1."
            )
        if child not in known and len(known) >= most:
            raise InputError(
                f"{parent} -> {child}: there are {most} frames already; publish fewer."
            )

    def between(self, target: str, source: str, t: float | None = None) -> Place | None:
        """Return (Rotation, p (3,) m) with x_target = R x_source + p; None if unknown.

        t : stamp, s, for frames that move
        """
        ours, theirs = self._to_root(source, t), self._to_root(target, t)
        common = next((frame for frame in ours if frame in theirs), None)
        if common is None:
            return None
        (turn, p), (other_turn, other_p) = ours[common], theirs[common]
        return other_turn.inv() * turn, other_turn.inv().apply(p - other_p)

    def _to_root(self, frame: str, t: float | None) -> dict[str, tuple[Rotation, np.ndarray]]:
        """Return {ancestor: (Rotation, p (3,) m)} of a frame, itself first."""
        turn, p = rotations.Rotation.identity(), np.zeros(3)
        found = {frame: (turn, p)}
        for _ in range(DEEPEST):
            step = self._static.get(frame) or self._at(frame, t)
            if step is None or step[0] in found:
                break
            frame, between, offset = step
            turn, p = between * turn, between.apply(p) + offset
            found[frame] = turn, p
        return found

    def _at(self, frame: str, t: float | None) -> tuple[str, Rotation, np.ndarray] | None:
        """Return (parent, Rotation, p (3,) m) of a moving frame at stamp t, s, by interpolation.

        After the last transform, that one holds for HELD. Return None before the first, after this
        time, and for an unknown frame.
        """
        if t is None or frame not in self._moving:
            return None
        parent, course = self._moving[frame]
        stamps = [entry[0] for entry in course]
        following = bisect_right(stamps, t)
        if following == 0 or t > stamps[-1] + HELD:
            return None
        before, after = course[following - 1], course[min(following, len(course) - 1)]
        if after is before:
            return parent, rotations.Rotation.from_quat(before[1]), np.array(before[2])
        share = (t - before[0]) / (after[0] - before[0])
        ends = rotations.Rotation.from_quat([before[1], after[1]])
        turn = rotations.Slerp([0.0, 1.0], ends)(share)
        return parent, turn, (1.0 - share) * np.array(before[2]) + share * np.array(after[2])
