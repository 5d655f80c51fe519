# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Motion along any path: tags that are carried, driven, thrown, or far away.

The families of trajectories in `simulate` do not cover these.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

from uwb_tdoa_tools.simulation.vehicles import DRAG, GRAVITY, STEP, ExactMotion

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import ArrayLike

    Position = Callable[[np.ndarray], np.ndarray]  # of stamps (n,) s: (n, 3) m
    Attitude = Callable[[np.ndarray], Rotation]  # of stamps (n,) s: body to world

KNOT = 0.02  # s, of the spline through the path
APART = 1e-4  # s, over which attitudes are differentiated


class Path:
    """A trajectory for simulate().

    duration : s
    position : function of stamps (n,) s, 0 to duration, that returns (n, 3) m. It has four
        derivatives.
    attitude : function of stamps that returns a Rotation, body to world. None: the attitude of a
        multirotor, which follows from its thrust.
    running : (begin, end) s, of its motors, or None
    """

    def __init__(
        self,
        duration: float,
        position: Position,
        attitude: Attitude | None = None,
        running: tuple[float, float] | None = None,
    ) -> None:
        t = np.arange(-2.0 * KNOT, duration + 2.5 * KNOT, KNOT)
        self._p, self._attitude, self._running = (
            make_interp_spline(t, position(t), k=5),
            attitude or self._flown,
            running,
        )

    def motion(self, t: ArrayLike) -> ExactMotion:
        """The ExactMotion at the stamps t, (n,) s."""
        t = np.asarray(t, dtype=float)
        p, v, a = (self._p(t, k) for k in range(3))
        turn = self._attitude(t)
        rates = (self._attitude(t - APART).inv() * self._attitude(t + APART)).as_rotvec() / (
            2.0 * APART
        )
        q = turn.as_quat()
        return ExactMotion(p, v, a, q, rates, turn.inv().apply(a + [0.0, 0.0, GRAVITY]))

    def motors(self, t: ArrayLike) -> np.ndarray:
        """Whether the motors turn at the stamps t: (n,) bool."""
        t = np.asarray(t)
        return (
            (t >= self._running[0]) & (t <= self._running[1])
            if self._running
            else np.zeros(len(t), bool)
        )

    def _flown(self, t: np.ndarray) -> Rotation:
        """Thrust along body z, as of a Trajectory, yaw 0."""
        z = self._p(t, 2) + [0.0, 0.0, GRAVITY] + DRAG * self._p(t, 1)
        z /= np.linalg.norm(z, axis=1, keepdims=True)
        y = np.cross(z, [1.0, 0.0, 0.0])
        y /= np.linalg.norm(y, axis=1, keepdims=True)
        return Rotation.from_matrix(np.stack([np.cross(y, z), y, z], axis=2))


def between(*stops: Sequence[float]) -> Position:
    """A position for Path: from one stop (stamp s, x, y, z m) to the next, at rest at each."""
    stamps, places = (
        np.array([stop[0] for stop in stops]),
        np.array([stop[1:] for stop in stops], dtype=float),
    )

    def position(t: np.ndarray) -> np.ndarray:
        t = np.clip(t, stamps[0], stamps[-1])
        k = np.clip(np.searchsorted(stamps, t, side="right") - 1, 0, len(stamps) - 2)
        share = STEP((t - stamps[k]) / (stamps[k + 1] - stamps[k]))[:, None]
        return places[k] + share * (places[k + 1] - places[k])

    return position
