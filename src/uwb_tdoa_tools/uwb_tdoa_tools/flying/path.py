"""What is to be flown, a path from a place on the ground and back to it, or driven."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import make_interp_spline

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
        return sinking(out, t > self.duration)

    def turned(self, t: float) -> float:
        """rad by which it is to be turned t s after the start."""
        return self._turning * t


def sinking(wanted: np.ndarray, after: np.ndarray) -> np.ndarray:
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
