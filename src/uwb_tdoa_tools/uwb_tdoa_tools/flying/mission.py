# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Define what is flown, and decide when to wait, take off, fly and land.

A mission uses the estimate, its standard deviation and the accelerometer alone.
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any, Protocol

import numpy as np
from scipy.interpolate import make_interp_spline

# t s, p (3,) m, v (3,) m/s, both world frame, q (4,) x y z w
Pose = tuple[float, np.ndarray, np.ndarray, np.ndarray]

KNOT, FINE = 0.02, 0.0025  # s, between knots of the spline and points of its table
SPEED_UP = 1.5  # s, from hovering to the circle and back
CLIMB = 0.4  # share of the ascent and the descent for each ramp
SETTLE = 0.4  # m above the ground, start of the slow descent
SINK = 0.2  # m/s


HEIGHT = 1.2  # m, of the circles
RISE, FALL = 3.0, 4.0  # s, of ascent and descent
# of a rover: places in units of half the length and width of the hall, from its middle, and speed
HALL_SIZE = np.array([6.4, 6.2])  # m
PLACES = np.array([(0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5), (0.5, 0.1)])
SPEED = 0.6  # m/s


@dataclass(frozen=True)
class Circles:
    """Fly up, along circles, and down to the start.

    Parameters
    ----------
    radius : float
        m, 0 to hover.
    turns : int
    turn_time : float
        Duration of a turn, s.
    """

    radius: float = 1.0
    turns: int = 2
    turn_time: float = 8.0

    @property
    def duration(self) -> float:
        """Return the time from the start of the rotors to the final descent, s."""
        return RISE + self.turns * self.turn_time + FALL

    @property
    def middle(self) -> float:
        """Return a time on the circle, s after take-off."""
        return RISE + 4.0

    def starting_at(self, place: np.ndarray, ground: float) -> ReferenceTrajectory:
        """Return the trajectory from `place` (2,) m.

        The circle is entered at its point nearest to +x. `ground` is the height of the body at rest, m.
        """
        knots = np.arange(0.0, self.duration + KNOT, KNOT)
        up = cruise(knots / RISE, CLIMB)
        down = cruise((knots - self.duration + FALL) / FALL, CLIMB)
        air = self.turns * self.turn_time
        angle = 2.0 * np.pi * self.turns * cruise((knots - RISE) / air, SPEED_UP / air)
        x = place[0] + self.radius * (np.cos(angle) - 1.0)
        y = place[1] + self.radius * np.sin(angle)
        z = ground + HEIGHT * up - (HEIGHT - SETTLE) * down
        return ReferenceTrajectory(np.column_stack([x, y, z]))


class Waypoints:
    """Drive straight from place to place of PLACES."""

    @property
    def duration(self) -> float:
        """Return the time from departure to arrival at this speed, s."""
        places = 0.5 * HALL_SIZE * PLACES
        ways = np.linalg.norm(np.diff(places, axis=0, prepend=[[0.0, 0.0]]), axis=1)
        return float(ways.sum()) / SPEED

    @property
    def middle(self) -> float:
        """Return a time on the way, s after departure."""
        return 0.5 * self.duration

    def starting_at(self, place: np.ndarray, ground: float) -> Polyline:
        """Return the polyline from `place` (2,) m at the height `ground`, m."""
        return Polyline(np.vstack([place, 0.5 * HALL_SIZE * PLACES]), ground)


class Polyline:
    """Connect places by straight lines.

    Attributes
    ----------
    length : float
        m.
    end : numpy.ndarray
        Last place (2,), m.
    """

    def __init__(self, places: np.ndarray, height: float) -> None:
        """Store the places.

        Parameters
        ----------
        places : numpy.ndarray
            (n, 2), m. Successive places must differ.
        height : float
            Height of all places, m.
        """
        self._places, self._height = places, height
        self._segments = np.diff(places, axis=0)
        self._segment_lengths = np.linalg.norm(self._segments, axis=1)
        self._arc_lengths = np.concatenate([[0.0], np.cumsum(self._segment_lengths)])
        self.length, self.end = float(self._arc_lengths[-1]), places[-1]

    def at(self, along: np.ndarray) -> np.ndarray:
        """Return the points (n, 3), m, at arc lengths `along` (n,), m."""
        x, y = (np.interp(along, self._arc_lengths, column) for column in self._places.T)
        return np.column_stack([x, y, np.full(len(x), self._height)])

    def nearest(self, p: np.ndarray, first: float = 0.0, last: float = np.inf) -> np.ndarray:
        """Return the arc lengths (n,), m, nearest to p (n, 2) m, between `first` and `last`, m."""
        from_start = p[:, None] - self._places[:-1]
        shares = np.sum(from_start * self._segments, axis=2) / self._segment_lengths**2
        # (n, segments): the nearest point of each segment
        along = self._arc_lengths[:-1] + np.clip(shares, 0.0, 1.0) * self._segment_lengths
        along = np.clip(along, first, min(last, self.length))
        off = self.at(along.ravel())[:, :2].reshape(from_start.shape) - p[:, None]
        best = np.argmin(np.linalg.norm(off, axis=2), axis=1)
        out: np.ndarray = along[np.arange(len(p)), best]
        return out


class ReferenceTrajectory:
    """Give the wanted position, velocity and acceleration over time.

    After its end the vehicle descends and no height is wanted.

    Attributes
    ----------
    duration : float
        s.
    end : numpy.ndarray
        Place of the landing (2,), m.
    """

    def __init__(self, p: np.ndarray) -> None:
        """Fit a spline to positions (m, 3), m, every KNOT s."""
        knots = KNOT * np.arange(len(p))
        spline = make_interp_spline(knots, p, k=5)
        self.duration, self.end, fine = knots[-1], p[-1, :2], np.arange(0.0, knots[-1], FINE)
        self._grid = np.stack(
            [spline(fine), spline.derivative(1)(fine), spline.derivative(2)(fine)], axis=1
        )

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return position, velocity and acceleration (n, 3, 3), m and s, at t (n,) s."""
        out = self._grid[np.clip(np.rint(t / FINE).astype(int), 0, len(self._grid) - 1)]
        return with_descent(out, t > self.duration)

    def yaw_offset(self, t: float) -> float:
        """Return the wanted turn since the start, rad, at t, s."""
        return 0.0


def with_descent(wanted: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Replace the wanted motion (n, 3, 3) by a descent where `after` (n,) is true.

    The height is NaN because only the accelerometer detects the ground.
    """
    wanted[after, 0, 2] = np.nan
    wanted[after, 1:] = 0.0
    wanted[after, 1, 2] = -SINK
    return wanted


def smooth(x: np.ndarray) -> np.ndarray:
    """Rise from 0 to 1 with three zero derivatives at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return x**4 * (35.0 - 84.0 * x + 70.0 * x**2 - 20.0 * x**3)


def cruise(x: np.ndarray, ramp: float) -> np.ndarray:
    """Rise from 0 to 1 over x in 0 ... 1 at one speed, with smooth ramps of length `ramp`."""
    fine = np.linspace(0.0, 1.0, 4001)
    speed = smooth(fine / ramp) * smooth((1.0 - fine) / ramp)
    way = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))])
    return np.interp(x, fine, way / way[-1])  # held beyond


WAITING, FLYING, LOST, DONE, REFUSED = "waiting", "flying", "lost", "done", "refused"


@dataclass(frozen=True)
class Rules:
    """Set the thresholds of a mission.

    Parameters
    ----------
    rest : float
        Least time before the rotors start, s.
    patience : float
        Further time to wait for a good estimate, s.
    arm, lost : float
        Largest standard deviation of a coordinate to start with, and to fly with, m.
    stale : float
        Largest age of an estimate, s.
    descent_speed : float
        Of a lost vehicle, m/s.
    ground_support : float
        Additional support, in units of the weight, that means ground contact.
    near_end : float
        Time before the end of the path from which ground contact counts, s.
    longest_descent : float
        s.
    """

    rest: float = 4.0
    patience: float = 10.0
    arm: float = 1.0
    lost: float = 1.5
    stale: float = 0.6
    descent_speed: float = 0.4
    ground_support: float = 0.09
    near_end: float = 1.5
    longest_descent: float = 10.0


class TimedPath(Protocol):
    """Give the wanted motion from the present place, by seconds since the rotors started."""

    duration: float  # s, until it begins to sink

    @property
    def end(self) -> np.ndarray:
        """Return the place of the landing (2,), m."""

    def at(self, t: np.ndarray) -> np.ndarray:
        """Return position, velocity and acceleration (n, 3, 3), m and s, at t (n,) s."""

    def yaw_offset(self, t: float) -> float:
        """Return the wanted turn since the start, rad, at t, s."""


class Journey:
    """Wait for a good estimate, move, and stop while the estimate is lost.

    Attributes
    ----------
    state : str
        WAITING, FLYING, LOST, DONE or REFUSED.
    started, ended : float or None
        Times of the start and of the end, s.
    lost : float or None
        First time at which the estimate was too uncertain, s.
    """

    def __init__(self, rules: Rules | None, begin: float) -> None:
        """Wait.

        Parameters
        ----------
        rules : Rules or None
        begin : float
            Time of switching on, s.
        """
        self.rules = rules or Rules()
        self.begin = begin
        self.state = WAITING
        self.started: float | None = None
        self.ended: float | None = None
        self.lost: float | None = None
        self._clock: list[tuple[float, float]] = []  # (s, s or m along the path) of each step

    def _judge(self, t: float, pose: Pose | None, deviation: float) -> bool:
        """Set the state at t, s, by the newest estimate, and return whether the vehicle moves."""
        rules = self.rules
        good = pose is not None and t - pose[0] <= rules.stale
        if self.state == WAITING and t >= self.begin + rules.rest:
            if good and deviation <= rules.arm:
                self.state = FLYING
                self.started = t
            elif t >= self.begin + rules.rest + rules.patience:
                self.state = REFUSED
        if self.state not in (FLYING, LOST):
            return False
        if not good or deviation > rules.lost:
            self.state = LOST
            self.lost = t if self.lost is None else self.lost
        elif deviation <= rules.arm:
            self.state = FLYING
        return True

    def _end(self, t: float) -> None:
        """End at t, s."""
        self.state = DONE
        self.ended = t

    @property
    def path_time(self) -> float:
        """Return the time on the path, s, or the way along it, m."""
        return self._clock[-1][1] if self._clock else 0.0

    def _along(self, t: np.ndarray) -> np.ndarray:
        """Return the time on the path, s, or the way along it, m, at t (n,) s."""
        return np.interp(t, *np.transpose(self._clock))


# m, largest distance of the wanted height below the estimated height
DESCENT_LEAD = 0.15
# s, averaging time of the support in the air, where an offset of the accelerometer is all of it
SUPPORT_OFFSET_TIME = 2.0
# s of support that mean ground contact to a lost vehicle: it brakes hard at first
CONTACT_TIME = 0.15


class Mission(Journey):
    """Run one flight along a path.

    A lost mission stops and descends. It continues if the estimate recovers in the air.

    Attributes
    ----------
    yaw : float
        Wanted yaw, rad.
    """

    def __init__(
        self,
        path: TimedPath,
        ground: float,
        rules: Rules | None = None,
        begin: float = 0.0,
    ) -> None:
        """Wait for the start.

        Parameters
        ----------
        path : TimedPath
            From the present place.
        ground : float
            Height of the body at rest, m.
        rules : Rules, optional
        begin : float
            Time of switching on, s.
        """
        super().__init__(rules, begin)
        self.ground = ground
        self._path = path
        self.yaw = self._first_yaw = 0.0
        self._last = 0.0  # s, of the step before
        self._descent_began = 0.0  # s
        self._support_offset = 0.0  # support, of the weight
        self._unsupported = 0.0  # s, last time without support by the ground
        self._descent: tuple[float, float] | None = None  # (s, m) at the start of the final descent

    def decide(
        self, t: float, pose: Pose | None, deviation: float, support: float
    ) -> np.ndarray | None:
        """Return the wanted position, velocity and acceleration (3, 3), or None for rotors off.

        A value of NaN is free.

        Parameters
        ----------
        t : float
            s.
        pose : Pose or None
            Newest estimate.
        deviation : float
            Its largest standard deviation of a coordinate, m.
        support : float
            Share of the weight that the ground carries.
        """
        before = self.state
        if not self._judge(t, pose, deviation):
            return None
        lost = self.state == LOST
        if before == WAITING:
            assert pose is not None  # the start needs a pose
            self._last = t
            self._first_yaw = yaw_of(pose[3])
        if before == WAITING or (lost and before != LOST):
            self._descent_began = t
        along = self.path_time + (0.0 if lost else t - self._last)
        self._clock.append((t, along))
        on_the_way = not lost and along < self._path.duration - self.rules.near_end
        if on_the_way:
            self._support_offset += min(1.0, (t - self._last) / SUPPORT_OFFSET_TIME) * (
                support - self._support_offset
            )
        self._last = t
        if support - self._support_offset <= self.rules.ground_support:
            self._unsupported = t
        on_ground = t - self._unsupported > (CONTACT_TIME if lost else 0.0)
        too_long = t - self._descent_began > self.rules.longest_descent
        if not on_the_way and (on_ground or too_long):
            self._end(t)
            return None
        if lost:
            wanted = np.zeros((3, 3))
            wanted[0] = math.nan
            wanted[1, 2] = -self.rules.descent_speed
            return wanted
        assert pose is not None  # without a pose the state is LOST
        if along < self._path.duration:
            self._descent_began = t
        self.yaw = self._first_yaw + self._path.yaw_offset(along)
        wanted = self._path.at(np.array([along]))[0]
        return self._descend(t, wanted, pose[1][2]) if math.isnan(wanted[0, 2]) else wanted

    def _descend(self, t: float, wanted: np.ndarray, height: float) -> np.ndarray:
        """Add a height, m, that falls at half of the wanted speed if the estimated height does not fall.

        A constant error of the estimated velocity then cannot keep the vehicle in the air.
        """
        begun, first = self._descent = self._descent or (t, height)
        wanted[0, 2] = min(
            height, max(first + 0.5 * wanted[1, 2] * (t - begun), height - DESCENT_LEAD)
        )
        return wanted

    @property
    def place(self) -> np.ndarray:
        """Return the wanted place of the landing (2,), m."""
        return self._path.end

    def wanted(self, t: np.ndarray) -> np.ndarray:
        """Return the wanted motion (n, 3, 3) at t (n,) s."""
        return self._path.at(self._along(t))


def yaw_of(q: np.ndarray) -> Any:
    """Return the yaw, rad, of an attitude (4,) x y z w, or the yaws (n,) of attitudes (n, 4)."""
    x, y, z, w = q.T
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
