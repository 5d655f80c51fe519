"""What is to be flown: a path from a place on the ground and back to it."""

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
