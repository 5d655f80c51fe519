# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fly a vehicle by commands: take off, go to, land, as in crazyswarm2.

A command that cannot be executed raises an InputError with the reason.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
import math

import numpy as np
from scipy.interpolate import BPoly

from uwb_tdoa_bias.common.errors import InputError

from .mission import FLYING, LOST, SETTLE, Mission, with_descent, yaw_of
from .trial import Trial

MAX_SPEED, MAX_ACCELERATION = 1.5, 1.2  # m/s and m/s^2 of a motion to a goal
# peaks of a motion over 1 m in 1 s from rest to rest
PEAK_SPEED, PEAK_ACCELERATION = 15.0 / 8.0, 10.0 / math.sqrt(3.0)
MAX_YAW_RATE = 1.5  # rad/s
LONGEST = 600.0  # s
HIGHEST = 1.0  # m, largest height of a table: a longer descent takes too long
STILL = np.zeros(4)


class CommandedPath:
    """Extend a path by commands.

    Each command starts at the position that the path has at that time. A command that cannot be executed
    raises InputError.

    Attributes
    ----------
    duration : float
        Time from the start to the final descent, s. It is inf before `land`.
    """

    def __init__(self, p: np.ndarray, yaw: float, size: Sequence[float]) -> None:
        """Start at rest.

        Parameters
        ----------
        p, yaw
            Estimated position (3,), m, and yaw, rad.
        size : sequence of float
            Size of the hall (3,), m, centered on the origin in x and y.
        """
        self.duration, self._size, self._first_yaw = math.inf, size, yaw
        self._goal = np.array([*p, yaw])
        self._begins, self._ways = [0.0], [_way((self._goal, STILL, STILL), self._goal, 1.0)]

    @property
    def end(self) -> np.ndarray:
        """Return the place of the landing (2,), m."""
        return self._goal[:2]

    def take_off(self, height: float, seconds: float) -> None:
        """Go straight up to a height, m, within `seconds`."""
        self._go(0.0, [*self._goal[:2], height, self._goal[3]], seconds)

    def go_to(
        self,
        now: float,
        relative: bool,
        goal: Sequence[float] | np.ndarray,
        yaw: float,
        seconds: float,
    ) -> None:
        """Go to a place within `seconds`.

        Parameters
        ----------
        now : float
            Time since the start, s.
        relative : bool
            Count goal and yaw from the goal before.
        goal : array_like
            (3,), m.
        yaw : float
            rad.
        seconds : float
        """
        self._check_flying()
        goal = np.array([*goal, yaw])
        self._go(now, self._goal + goal if relative else goal, seconds)

    def land(self, now: float, height: float, seconds: float) -> None:
        """Descend from `now`, s, to SETTLE above `height`, m, within `seconds`, and land."""
        self._check_flying()
        if not 0.0 <= height <= HIGHEST:
            raise InputError(
                f"height: {height:g} m must be from 0 to {HIGHEST:g} m, that of the ground, "
                "or of a table."
            )
        lowest = min(float(self._at(now)[0, 2]), height + SETTLE)
        self._go(now, [*self._goal[:2], lowest, self._goal[3]], seconds)
        self.duration = now + seconds

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return position, velocity and acceleration (n, 3, 3), m and s, at t (n,) s."""
        return with_descent(np.stack([self._at(one)[:, :3] for one in t]), t > self.duration)

    def yaw_offset(self, t: float) -> float:
        """Return the wanted turn since the start, rad, at t, s."""
        return float(self._at(t)[0, 3]) - self._first_yaw

    def _at(self, t: float) -> np.ndarray:
        """Return x, y, z and yaw with two derivatives (3, 4)."""
        k = max(int(np.searchsorted(self._begins, t, side="right")) - 1, 0)
        way = self._ways[k]
        since = min(t - self._begins[k], way[0].x[-1])
        return np.stack([function(since) for function in way])

    def _check_flying(self) -> None:
        if self.duration < math.inf:
            raise InputError("it lands already; take off again when it has.")

    def _go(self, now: float, goal: Sequence[float] | np.ndarray, seconds: float) -> None:
        goal = np.array(goal, dtype=float)
        if not np.isfinite(goal).all():
            raise InputError(
                f"goal: {goal.tolist()} holds numbers that are not finite; give finite ones."
            )
        x, y, z = self._size
        if not (abs(goal[0]) <= 0.5 * x and abs(goal[1]) <= 0.5 * y and 0.0 <= goal[2] <= z):
            place = ", ".join(f"{number:.2f}" for number in goal[:3])
            raise InputError(
                f"goal: ({place}) m is outside the hall, {x:g} x {y:g} x {z:g} m around (0, "
                "0); give one inside."
            )
        if not 0.0 < seconds <= LONGEST:
            raise InputError(f"duration: {seconds:g} s must be above 0 and at most {LONGEST:g} s.")
        p, v, a = self._at(now)
        goal[3] = p[3] + math.remainder(goal[3] - p[3], 2.0 * math.pi)  # the shorter way around
        far = float(np.linalg.norm(goal[:3] - p[:3]))
        needed = max(
            PEAK_SPEED * far / MAX_SPEED,
            math.sqrt(PEAK_ACCELERATION * far / MAX_ACCELERATION),
            PEAK_SPEED * abs(goal[3] - p[3]) / MAX_YAW_RATE,
        )
        if seconds < needed:
            raise InputError(
                f"duration: {seconds:g} s is too short for {far:.2f} m; give at least "
                f"{math.ceil(10.0 * needed) / 10.0:g} s."
            )
        self._goal = goal
        self._begins.append(now)
        self._ways.append(_way((p, v, a), goal, seconds))


def _way(
    begin: Sequence[np.ndarray], goal: np.ndarray, seconds: float
) -> tuple[BPoly, BPoly, BPoly]:
    """Return functions of time to (4,): the motion to a goal within `seconds`, and two derivatives.

    `begin` holds the value and its derivatives at the start.
    """
    value = BPoly.from_derivatives(
        [0.0, seconds, seconds + 1.0], [begin, (goal, STILL, STILL), (goal, STILL, STILL)]
    )
    return value, value.derivative(1), value.derivative(2)


class Pilot:
    """Execute the commands of a user with the vehicle of a Trial.

    Times are in s, lengths in m, angles in rad. Commands raise InputError.
    """

    def __init__(self, trial: Trial) -> None:
        """Control the vehicle of `trial`."""
        self._trial = trial
        self._path: CommandedPath | None = None

    @property
    def _mission(self) -> Mission | None:
        """Return the mission in the air, or None."""
        last = self._trial.missions[-1:]
        return last[0] if last and last[0].state in (FLYING, LOST) else None

    def take_off(self, group_mask: int, height: float, seconds: float) -> None:
        """Take off from the present place if the estimate is good enough."""
        _check(group_mask)
        if self._mission is not None:
            raise InputError("it flies already; go to a place, or land.")
        source, rules, now = self._trial.source, self._trial.task.rules, self._trial.simulator.now
        pose = source.pose
        if pose is None or now - pose[0] > rules.stale:
            raise InputError(f"there is no odometry to fly by: {source.why or 'none came lately'}.")
        if source.deviation > rules.arm:
            raise InputError(
                "it does not know where it is: "
                f"{source.why or f'to {source.deviation:.1f} m, where {rules.arm:g} m is wanted'}."
            )
        path = CommandedPath(pose[1], yaw_of(pose[3]), self._trial.task.world.size)
        path.take_off(height, seconds)
        self._path = path
        self._trial.begin(path, replace(rules, rest=0.0, patience=0.0))

    def go_to(
        self, group_mask: int, relative: bool, goal: Sequence[float], yaw: float, seconds: float
    ) -> None:
        """Go to goal (3,) m."""
        mission, path = self._in_air(group_mask)
        path.go_to(mission.path_time, relative, goal, yaw, seconds)

    def land(self, group_mask: int, height: float, seconds: float) -> None:
        """Land at the present place, on ground of the given height."""
        mission, path = self._in_air(group_mask)
        path.land(mission.path_time, height, seconds)

    def _in_air(self, group_mask: int) -> tuple[Mission, CommandedPath]:
        _check(group_mask)
        mission, path = self._mission, self._path
        if mission is None or path is None:
            raise InputError("it does not fly; take off first.")
        if mission.state == LOST:
            raise InputError("its estimate is lost: it sinks to the ground.")
        return mission, path


def _check(group_mask: int) -> None:
    if group_mask:
        raise InputError(f"group_mask: {group_mask} is a group that it is not in; give 0.")
