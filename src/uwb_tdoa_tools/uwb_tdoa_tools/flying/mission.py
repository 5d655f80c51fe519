"""Wait, take off, fly, land: decided by nothing but the estimate, its deviation, and what the
accelerometer feels.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    Pose = tuple[
        float, np.ndarray, np.ndarray, np.ndarray
    ]  # t s, p (3,) m, v (3,) m/s, world, q (4,) x y z w

WAITING, FLYING, LOST, DONE, REFUSED = "waiting", "flying", "lost", "done", "refused"


@dataclass(frozen=True)
class Rules:
    """When to do what. rest : s before the rotors start at the earliest; patience : s after that,
    to wait for an estimate that is good enough; arm, lost : m, largest standard deviation of a
    coordinate to start with, and beyond which it is lost; stale : s, an older estimate is none;
    sink : m/s, while it is lost; carried : of the weight: it stands where it feels that much more
    support than usual;
    near_end : s before the path's end from which on it may; longest_sink : s.
    """

    rest: float = 4.0
    patience: float = 10.0
    arm: float = 1.0
    lost: float = 1.5
    stale: float = 0.6
    sink: float = 0.25
    carried: float = 0.09
    near_end: float = 1.5
    longest_sink: float = 10.0


class Way(Protocol):
    """What is to be flown from where a vehicle stands, by s since its rotors started."""

    duration: float  # s, until it begins to sink

    @property
    def end(self) -> np.ndarray:
        """(2,) m, where it is to land."""

    def at(self, t: np.ndarray) -> np.ndarray:
        """Position, velocity and acceleration wanted, (n, 3, 3), m and s, at t (n,) s."""

    def turned(self, t: float) -> float:
        """rad by which it is to be turned at t, s."""


class Route(Protocol):
    """What is to be flown, wherever it begins."""

    def along(self, place: np.ndarray, ground: float) -> Way:
        """The Way from `place` (2,) m; ground : m, height at which the body stands."""


# m, most by which the height that is wanted while it comes down is below the estimated height
PULL = 0.15
# s over which it learns what support it feels in the air, where there is none: its accelerometer
# has an offset
USUAL = 2.0


class Mission:
    """One flight along a path. state : of WAITING ...; started, ended : s, when the rotors started
    and stopped, or None; lost : s, when its estimate first said that it was lost, or None: then it
    stops, sinks, and goes on with its path only if its place is given while it is still in the air;
    yaw : rad, wanted now.
    """

    def __init__(
        self,
        path: Route,
        place: np.ndarray,
        ground: float,
        rules: Rules | None = None,
        begin: float = 0.0,
    ) -> None:
        """path : Circles, or what else has `along`; place (2,) m; ground : m, of the body's origin;
        begin : s, when it was switched on.
        """
        self.ground, self.rules, self.begin = ground, rules or Rules(), begin
        self._path = path.along(place, ground)
        self._clock: list[
            tuple[float, float]
        ] = []  # (s, s since the start of the path) of each call
        self.state = WAITING
        self.started: float | None = None
        self.ended: float | None = None
        self.lost: float | None = None
        self.yaw = self._first_yaw = 0.0
        self._usual = 0.0  # support, of the weight
        self._descent: tuple[float, float] | None = (
            None  # (s, m) where it began to come down on whatever is there
        )

    def decide(
        self, t: float, pose: Pose | None, deviation: float, support: float
    ) -> np.ndarray | None:
        """What the controller is to do at t, s: (3, 3) position, velocity, acceleration, NaN where
        it does not matter; None for rotors off. pose : as of an estimate, or None; deviation : m;
        support : of the weight, that something else than the rotors carries, as felt.
        """
        rules = self.rules
        good = pose is not None and t - pose[0] <= rules.stale
        if self.state == WAITING and t >= self.begin + rules.rest:
            if pose is not None and good and deviation <= rules.arm:
                self.state, self.started, self._last, self._sinking = FLYING, t, t, t
                self._first_yaw = yaw_of(pose[3])
            elif t >= self.begin + rules.rest + rules.patience:
                self.state = REFUSED
        if self.state not in (FLYING, LOST):
            return None
        if not good or deviation > rules.lost:
            self.lost = t if self.lost is None else self.lost
            self._sinking = t if self.state != LOST else self._sinking
            self.state = LOST
        elif self.state == LOST and good and deviation <= rules.arm:
            self.state = FLYING
        along = self.along + (0.0 if self.state == LOST else t - self._last)
        self._clock.append((t, along))
        if self.state != LOST and along < self._path.duration - rules.near_end:
            self._usual += min(1.0, (t - self._last) / USUAL) * (support - self._usual)
        self._last = t
        near_end = self.state == LOST or along > self._path.duration - rules.near_end
        if near_end and (
            support - self._usual > rules.carried or t - self._sinking > rules.longest_sink
        ):
            self.state, self.ended = DONE, t
            return None
        if self.state != LOST:
            assert pose is not None  # or it would be lost
            self._sinking = t if along < self._path.duration else self._sinking
            self.yaw = self._first_yaw + self._path.turned(along)
            wanted = self._path.at(np.array([along]))[0]
            return self._descend(t, wanted, pose[1][2]) if math.isnan(wanted[0, 2]) else wanted
        wanted = np.zeros((3, 3))
        wanted[0], wanted[1, 2] = math.nan, -rules.sink
        return wanted

    def _descend(self, t: float, wanted: np.ndarray, height: float) -> np.ndarray:
        """Wanted, with a height, m, that falls at half of the wanted velocity, where the estimated
        height does not fall as fast: an estimated velocity that is wrong by a constant does not
        keep it in the air.
        """
        begun, first = self._descent = self._descent or (t, height)
        wanted[0, 2] = min(height, max(first + 0.5 * wanted[1, 2] * (t - begun), height - PULL))
        return wanted

    @property
    def place(self) -> np.ndarray:
        """(2,) m, where it is to land."""
        return self._path.end

    @property
    def along(self) -> float:
        """s since the start of the path."""
        return self._clock[-1][1] if self._clock else 0.0

    def wanted(self, t: np.ndarray) -> np.ndarray:
        """Of the path, (n, 3, 3), at t (n,) s."""
        return self._path.at(np.interp(t, *np.transpose(self._clock)))


def yaw_of(q: np.ndarray) -> float:
    """rad, of q (4,) x y z w."""
    x, y, z, w = q
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
