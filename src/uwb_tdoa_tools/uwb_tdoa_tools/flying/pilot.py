"""Does what is asked for piece by piece, with the vehicle of a Trial: take off, go to, land.

Refuses, with why, what it cannot do.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from uwb_tdoa_bias.foundation.errors import InputError

from .commanded import Commanded
from .mission import FLYING, LOST, yaw_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .mission import Mission
    from .trial import Trial


class Pilot:
    """Of a Trial, whose source also says `why` it is not to be flown by.

    Seconds, metres and rad; raises InputError.
    """

    def __init__(self, trial: Trial) -> None:
        """trial : Trial."""
        self._trial = trial
        self._path: Commanded | None = None

    @property
    def _mission(self) -> Mission | None:
        """The mission in the air, or None."""
        last = self._trial.missions[-1:]
        return last[0] if last and last[0].state in (FLYING, LOST) else None

    def take_off(self, group_mask: int, height: float, seconds: float) -> None:
        """Take off from where it stands, if it knows where that is."""
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
        path = Commanded(pose[1], yaw_of(pose[3]), self._trial.task.world.size)
        path.take_off(height, seconds)
        self._path = path
        self._trial.begin(path, replace(rules, rest=0.0, patience=0.0))

    def go_to(
        self, group_mask: int, relative: bool, goal: Sequence[float], yaw: float, seconds: float
    ) -> None:
        """Go to goal (3,) m."""
        mission, path = self._in_air(group_mask)
        path.go_to(mission.along, relative, goal, yaw, seconds)

    def land(self, group_mask: int, height: float, seconds: float) -> None:
        """Land where it is, on what is `height` m high."""
        mission, path = self._in_air(group_mask)
        path.land(mission.along, height, seconds)

    def _in_air(self, group_mask: int) -> tuple[Mission, Commanded]:
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
