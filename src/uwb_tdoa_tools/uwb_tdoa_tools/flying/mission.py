"""Wait, take off, fly, land: decided by nothing but the estimate, its deviation, and what the
accelerometer feels.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import TYPE_CHECKING, Protocol

import numpy as np
from scipy.interpolate import make_interp_spline

if TYPE_CHECKING:
    Pose = tuple[
        float, np.ndarray, np.ndarray, np.ndarray
    ]  # t s, p (3,) m, v (3,) m/s, world, q (4,) x y z w


KNOT, FINE = 0.02, 0.0025  # s, of the spline, and of the points at which it is looked up
SPEED_UP = 1.5  # s, from hovering to the circle and back
CLIMB = 0.4  # of the time up, and of that down, to get as fast as it climbs, and the same to stop
SETTLE = 0.4  # m above the ground from which it sinks slowly
SINK = 0.2  # m/s


@dataclass(frozen=True)
class Circles:
    """Up, circles, down to where it began. height, radius : m; rise, fall : s, up and down; turns;
    turn_time : s each; swing : m, by which the height goes up and down again in each turn.
    """

    height: float = 1.2
    radius: float = 1.0
    rise: float = 3.0
    fall: float = 4.0
    turns: int = 2
    turn_time: float = 8.0
    swing: float = 0.0

    @property
    def duration(self) -> float:
        """s, from the rotors' start to where the slow sinking begins."""
        return self.rise + self.turns * self.turn_time + self.fall

    @property
    def middle(self) -> float:
        """s after take-off, in which it is on the circle."""
        return self.rise + 4.0

    def along(self, place: np.ndarray, ground: float) -> ReferenceTrajectory:
        """The ReferenceTrajectory from `place` (2,) m, where the circle is entered at its point
        nearest to +x; ground : m, height at which the body stands.
        """
        knots = np.arange(0.0, self.duration + KNOT, KNOT)
        up = cruise(knots / self.rise, CLIMB)
        down = cruise((knots - self.duration + self.fall) / self.fall, CLIMB)
        air = self.turns * self.turn_time
        angle = 2.0 * np.pi * self.turns * cruise((knots - self.rise) / air, SPEED_UP / air)
        p = np.empty((len(knots), 3))
        p[:, 0] = place[0] + self.radius * (np.cos(angle) - 1.0)
        p[:, 1] = place[1] + self.radius * np.sin(angle)
        p[:, 2] = (
            ground + self.height * up - (self.height - SETTLE) * down + self.swing * np.sin(angle)
        )
        return ReferenceTrajectory(p)


@dataclass(frozen=True)
class Waypoints:
    """Straight from one place to the next, on wheels. shares (n, 2) : of half the hall's length and
    width, from its middle; speed : m/s; size (2,) m, of the hall.
    """

    size: tuple[float, float] = (6.4, 6.2)
    shares: tuple[tuple[float, float], ...] = (
        (0.5, 0.5),
        (-0.5, 0.5),
        (-0.5, -0.5),
        (0.5, -0.5),
        (0.5, 0.1),
    )
    speed: float = 0.6

    @property
    def duration(self) -> float:
        """s, from departure to arrival at this speed."""
        places = 0.5 * np.array(self.size) * self.shares
        ways = np.linalg.norm(np.diff(places, axis=0, prepend=[[0.0, 0.0]]), axis=1)
        return float(ways.sum()) / self.speed

    @property
    def middle(self) -> float:
        """s after departure, in which it is on its way."""
        return 0.5 * self.duration

    def along(self, place: np.ndarray, ground: float) -> Polyline:
        """The Polyline from `place` (2,) m, at height `ground`, m."""
        return Polyline(np.vstack([place, 0.5 * np.array(self.size) * self.shares]), ground)


class Polyline:
    """Straight lines from place to place. length : m; end (2,) m, its last place."""

    def __init__(self, places: np.ndarray, height: float) -> None:
        """places : (n, 2) m."""
        self._places, self._height = places, height
        self._ways = np.diff(places, axis=0)
        self._lengths = np.linalg.norm(self._ways, axis=1)
        self._stamps = np.concatenate([[0.0], np.cumsum(self._lengths)])
        self.length, self.end = float(self._stamps[-1]), places[-1]

    def at(self, along: np.ndarray) -> np.ndarray:
        """(n, 3) m, at `along` (n,) m from the start."""
        x, y = (np.interp(along, self._stamps, column) for column in self._places.T)
        return np.column_stack([x, y, np.full(len(x), self._height)])

    def nearest(self, p: np.ndarray, first: float = 0.0, last: float = np.inf) -> np.ndarray:
        """(n,) m along it: the points nearest to p (n, 2) m, between `first` and `last`, m."""
        since = p[:, None] - self._places[:-1]
        shares = np.sum(since * self._ways, axis=2) / self._lengths**2
        along = self._stamps[:-1] + np.clip(shares, 0.0, 1.0) * self._lengths  # of each line
        along = np.clip(along, first, min(last, self.length))
        off = self.at(along.ravel())[:, :2].reshape(since.shape) - p[:, None]
        best = np.argmin(np.linalg.norm(off, axis=2), axis=1)
        out: np.ndarray = along[np.arange(len(p)), best]
        return out


class ReferenceTrajectory:
    """Position, velocity and acceleration, (n, 3, 3), m and s, wanted since the rotors started; at
    its end it sinks, and no height is wanted.
    duration : s until then; end (2,) m, where.
    """

    def __init__(self, p: np.ndarray, turning: float = 0.0) -> None:
        """p : (m, 3) m, each KNOT s, from the start on; turning : rad/s."""
        knots = KNOT * np.arange(len(p))
        spline = make_interp_spline(knots, p, k=5)
        self.duration, self.end, fine = knots[-1], p[-1, :2], np.arange(0.0, knots[-1], FINE)
        self._turning = turning
        self._grid = np.stack(
            [spline(fine), spline.derivative(1)(fine), spline.derivative(2)(fine)], axis=1
        )

    def at(self, t: np.ndarray) -> np.ndarray:
        """At t (n,) s; (n, 3, 3)."""
        out = self._grid[np.clip(np.rint(t / FINE).astype(int), 0, len(self._grid) - 1)]
        return with_descent(out, t > self.duration)

    def yaw_offset(self, t: float) -> float:
        """rad by which it is to be turned t s after the start."""
        return self._turning * t


def with_descent(wanted: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Of what is wanted, (n, 3, 3), have it sink where `after`, (n,) bool."""
    wanted[after, 0, 2] = (
        np.nan
    )  # as fast as that, from wherever it is: the ground is where it is felt
    wanted[after, 1:] = 0.0
    wanted[after, 1, 2] = -SINK
    return wanted


def smooth(x: np.ndarray) -> np.ndarray:
    """0 to 1 with three derivatives zero at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return x**4 * (35.0 - 84.0 * x + 70.0 * x**2 - 20.0 * x**3)


def cruise(x: np.ndarray, ramp: float) -> np.ndarray:
    """0 to 1 over x in 0 ... 1, at one speed but for smooth ramps of that length at both ends."""
    fine = np.linspace(0.0, 1.0, 4001)
    speed = smooth(fine / ramp) * smooth((1.0 - fine) / ramp)
    way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))])
    return np.interp(x, fine, way / way[-1])  # held beyond


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
    descent_speed: float = 0.25
    ground_support: float = 0.09
    near_end: float = 1.5
    longest_descent: float = 10.0


class TimedPath(Protocol):
    """What is to be flown from where a vehicle stands, by s since its rotors started."""

    duration: float  # s, until it begins to sink

    @property
    def end(self) -> np.ndarray:
        """(2,) m, where it is to land."""

    def at(self, t: np.ndarray) -> np.ndarray:
        """Position, velocity and acceleration wanted, (n, 3, 3), m and s, at t (n,) s."""

    def yaw_offset(self, t: float) -> float:
        """rad by which it is to be turned at t, s."""


class Plan(Protocol):
    """What is to be flown, wherever it begins."""

    def along(self, place: np.ndarray, ground: float) -> TimedPath:
        """The Way from `place` (2,) m; ground : m, height at which the body stands."""


# m, most by which the height that is wanted while it comes down is below the estimated height
DESCENT_LEAD = 0.15
# s over which it learns what support it feels in the air, where there is none: its accelerometer
# has an offset
SUPPORT_OFFSET_TIME = 2.0


class Mission:
    """One flight along a path. state : of WAITING ...; started, ended : s, when the rotors started
    and stopped, or None; lost : s, when its estimate first said that it was lost, or None: then it
    stops, sinks, and goes on with its path only if its place is given while it is still in the air;
    yaw : rad, wanted now.
    """

    def __init__(
        self,
        path: Plan,
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
        self._support_offset = 0.0  # support, of the weight
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
                self.state, self.started, self._last, self._descent_began = FLYING, t, t, t
                self._first_yaw = yaw_of(pose[3])
            elif t >= self.begin + rules.rest + rules.patience:
                self.state = REFUSED
        if self.state not in (FLYING, LOST):
            return None
        if not good or deviation > rules.lost:
            self.lost = t if self.lost is None else self.lost
            self._descent_began = t if self.state != LOST else self._descent_began
            self.state = LOST
        elif self.state == LOST and good and deviation <= rules.arm:
            self.state = FLYING
        along = self.along + (0.0 if self.state == LOST else t - self._last)
        self._clock.append((t, along))
        if self.state != LOST and along < self._path.duration - rules.near_end:
            self._support_offset += min(1.0, (t - self._last) / SUPPORT_OFFSET_TIME) * (
                support - self._support_offset
            )
        self._last = t
        near_end = self.state == LOST or along > self._path.duration - rules.near_end
        if near_end and (
            support - self._support_offset > rules.ground_support
            or t - self._descent_began > rules.longest_descent
        ):
            self.state, self.ended = DONE, t
            return None
        if self.state != LOST:
            assert pose is not None  # or it would be lost
            self._descent_began = t if along < self._path.duration else self._descent_began
            self.yaw = self._first_yaw + self._path.yaw_offset(along)
            wanted = self._path.at(np.array([along]))[0]
            return self._descend(t, wanted, pose[1][2]) if math.isnan(wanted[0, 2]) else wanted
        wanted = np.zeros((3, 3))
        wanted[0], wanted[1, 2] = math.nan, -rules.descent_speed
        return wanted

    def _descend(self, t: float, wanted: np.ndarray, height: float) -> np.ndarray:
        """Wanted, with a height, m, that falls at half of the wanted velocity, where the estimated
        height does not fall as fast: an estimated velocity that is wrong by a constant does not
        keep it in the air.
        """
        begun, first = self._descent = self._descent or (t, height)
        wanted[0, 2] = min(
            height, max(first + 0.5 * wanted[1, 2] * (t - begun), height - DESCENT_LEAD)
        )
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
