# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Vehicles that carry the tag along a path: a quadrotor, a rover on wheels, a person on foot.

A path is a trajectory family, or goes through waypoints. It gives positions over "path time" s. Path
time runs with the clock at cruise; vehicles slow it down at both ends.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, CubicHermiteSpline, CubicSpline, make_interp_spline
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.errors import InputError, refuse_others

from .config import REST_HEIGHT, Complete, Room

KNOT = 0.05  # s, spacing of the spline's knots
SPEED_UP = 2.0  # s, from rest to cruise and back
CORNER_TIME = 1.2  # s, to turn a corner of the square
HEADING_TIME = 3.0  # s, over which a heading along the track is smoothed
# 0 to 1 with four derivatives zero at both ends
STEP = Polynomial([0, 0, 0, 0, 0, 126, -420, 540, -315, 70])
_RAMP = STEP.integ()


def circle(s: np.ndarray, config: Complete, room: Room, rng: np.random.Generator) -> np.ndarray:
    """Fly a level circle around the place, radius and speed as configured."""
    angle = config.speed * s / config.radius
    return np.column_stack(
        [
            config.place[0] + config.radius * np.cos(angle),
            config.place[1] + config.radius * np.sin(angle),
            np.full(len(s), config.height),
        ]
    )


def rising_circle(
    s: np.ndarray, config: Complete, room: Room, rng: np.random.Generator
) -> np.ndarray:
    """Fly the circle with a height that rises and falls in a sine, up to 0.6 m, 0.7 times per turn."""
    p = circle(s, config, room, rng)
    low, high = room.path_box
    swing = np.clip(min(high[2] - config.height, config.height - low[2]), 0.0, 0.6)
    p[:, 2] += swing * np.sin(0.7 * config.speed * s / config.radius)
    return p


def sines(s: np.ndarray, config: Complete, room: Room, rng: np.random.Generator) -> np.ndarray:
    """Fly products of two sines per axis, of seeded amplitude, period and phase.

    They fill the flyable room. `speed` is the root mean square here. Source: the training
    trajectories of Zhao et al. (RA-L 2021), section V-B.
    """
    low, high = room.path_box
    reach = 0.5 * (high - low) * rng.uniform(0.75, 1.0, 3)
    rate = 2.0 * np.pi / rng.uniform([[8.0], [13.0]], [[13.0], [24.0]], (2, 3))
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, 3))

    def position(u: np.ndarray) -> np.ndarray:
        return 0.5 * (low + high) + reach * np.prod(np.sin(rate * u[:, None, None] + phase), axis=1)

    u = np.linspace(0.0, 240.0, 4801)  # long enough for the mean over all periods
    velocity = np.gradient(position(u), u, axis=0)
    return position(s * config.speed / np.sqrt(np.mean(np.sum(velocity**2, axis=1))))


def square(s: np.ndarray, config: Complete, room: Room, rng: np.random.Generator) -> np.ndarray:
    """Fly a level square around the place, its edges `radius` away, with rounded corners."""
    return _laps(s, config, [[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]], config.radius)


def line_x(s: np.ndarray, config: Complete, room: Room, rng: np.random.Generator) -> np.ndarray:
    """Fly back and forth along x through the place, `radius` to each side, with smooth turns."""
    return _laps(s, config, [[-1, 0], [1, 0], [-1, 0]], 0.0)


def line_y(s: np.ndarray, config: Complete, room: Room, rng: np.random.Generator) -> np.ndarray:
    """Fly back and forth along y in the same way."""
    return _laps(s, config, [[0, -1], [0, 1], [0, -1]], 0.0)


def waypoints(s: np.ndarray, config: Complete, room: Room, rng: np.random.Generator) -> np.ndarray:
    """Fly through the points of `config.path` and back to the first, repeatedly, corners rounded."""
    # A point x, y is at `config.height`.
    points = np.array([(*point, config.height)[:3] for point in config.path])
    closed = np.vstack([points, points[:1]])
    lengths = np.linalg.norm(np.diff(closed, axis=0), axis=1)
    return _round(s, config.speed, closed, np.concatenate([[0.0], np.cumsum(lengths)]), 0.0)


def timed(s: np.ndarray, config: Complete, room: Room, rng: np.random.Generator) -> np.ndarray:
    """Fly the timed `poses`, and stay at the last."""
    t, x, y, z, _ = np.transpose(config.poses)
    at: np.ndarray = CubicSpline(t - t[0], np.column_stack([x, y, z]))(np.minimum(s, t[-1] - t[0]))
    return at


def _laps(
    s: np.ndarray, config: Complete, corners: Sequence[Sequence[float]], ahead: float
) -> np.ndarray:
    """Return positions along level corners, (n, 2) in units of the radius, equally far apart.

    The start is `ahead` m further.
    """
    ends = 2.0 * config.radius * np.arange(len(corners))
    rounded = _round(s, config.speed, config.radius * np.asarray(corners), ends, ahead)
    return np.column_stack([rounded + config.place, np.full(len(s), config.height)])


def _round(
    s: np.ndarray, speed: float, around: np.ndarray, ends: np.ndarray, ahead: float
) -> np.ndarray:
    """Return positions along a closed line with rounded corners.

    Parameters
    ----------
    s : (n,) s, path time.
    around : (m, k) m, corners.
    ends : (m,) m, path length at the corners.
    ahead : m, path length at the start.
    """
    dt = 0.01
    s_fine = np.arange(-CORNER_TIME, s[-1] + CORNER_TIME + dt, dt)
    along = np.mod(speed * s_fine + ahead, ends[-1])
    sharp = np.column_stack([np.interp(along, ends, coordinate) for coordinate in around.T])
    rounded: np.ndarray = CubicSpline(s_fine, _smoothed(sharp, int(CORNER_TIME / dt) | 1))(s)
    return rounded


def hover(s: np.ndarray, config: Complete, room: Room, rng: np.random.Generator) -> np.ndarray:
    """Stay at the place."""
    return np.tile([*config.place, config.height], (len(s), 1))


TRAJECTORIES = {
    "circle": circle,
    "rising_circle": rising_circle,
    "sines": sines,
    "square": square,
    "line_x": line_x,
    "line_y": line_y,
    "hover": hover,
    "spin": hover,  # with the yaw rotating
}


def path_of(s: np.ndarray, config: Complete, room: Room, rng: np.random.Generator) -> np.ndarray:
    """Return positions (n, 3) m at path times s (n,) s, of the waypoints or the family of a config.

    Raises InputError if they leave the room.
    """
    refuse_others("trajectory", [config.trajectory], TRAJECTORIES)
    family, name = TRAJECTORIES[config.trajectory], config.trajectory
    if config.path is not None or config.poses is not None:
        family, name = waypoints if config.poses is None else timed, "the path"
    p = family(s, config, room, rng)
    outside = (p < room.lower).any(axis=0) | (p > room.upper).any(axis=0)
    if outside.any():
        axis = int(np.argmax(outside))
        reach = f"{p[:, axis].min():.2f} ... {p[:, axis].max():.2f} m"
        walls = f"{room.lower[axis]:.2f} ... {room.upper[axis]:.2f} m"
        raise InputError(
            f"trajectory: {name} reaches {reach} in {'xyz'[axis]}, outside the room's "
            f"{walls}; change place, height or radius."
        )
    return p


def path_time(tau: np.ndarray, rise: float, air: float) -> np.ndarray:
    """Return path time after tau seconds in the air: at rest during rise and descent, smooth between."""

    def since(x: np.ndarray) -> np.ndarray:  # integral of the smooth step, in units of SPEED_UP
        """Integrate the smooth step, in units of SPEED_UP."""
        return _RAMP(np.clip(x, 0.0, 1.0)) + np.maximum(x - 1.0, 0.0)

    return SPEED_UP * (
        since((tau - rise) / SPEED_UP) - since((tau - (air - rise - SPEED_UP)) / SPEED_UP)
    )


def yaw_along(s: np.ndarray, p: np.ndarray, config: Complete) -> np.ndarray:
    """Return the yaw at every knot, rad: that of the poses, or "fixed", "along_track" or "rotating"."""
    if config.poses is not None:
        t, *_, yaw = np.transpose(config.poses)
        return config.yaw_angle + np.interp(s, t - t[0], np.unwrap(yaw))
    if config.trajectory == "spin" or config.yaw == "rotating":
        return config.yaw_angle + config.yaw_rate * s
    if config.yaw == "fixed" or np.ptp(s) == 0.0:
        return np.full(len(s), config.yaw_angle)
    step = np.diff(p[:, :2], axis=0)
    going = np.hypot(*step.T) > 1e-6
    if not going.any():
        return np.full(len(s), config.yaw_angle)
    track = np.unwrap(np.arctan2(step[going, 1], step[going, 0]))
    middle = 0.5 * (np.arange(len(step)) + np.arange(1, len(step) + 1))
    course = np.interp(np.arange(len(s)), middle[going], track)
    return config.yaw_angle + _smoothed(course[:, None], int(HEADING_TIME / KNOT) | 1)[:, 0]


def _smoothed(values: np.ndarray, width: int) -> np.ndarray:
    """Average columns of (n, k) values with a raised-cosine window of `width` samples.

    The ends are extended as constants.
    """
    window = np.hanning(width + 2)[1:-1]
    window /= window.sum()
    padded = np.pad(values, ((width, width), (0, 0)), mode="edge")
    return np.column_stack([np.convolve(column, window, mode="same") for column in padded.T])[
        width:-width
    ]


GRAVITY = 9.81  # m/s^2
DRAG = 0.2  # 1/s, rotor drag per mass: without it the lateral accelerometers would measure nothing
MAX_ACCELERATION = 8.0  # m/s^2, what a small quadrotor still flies
SPIN_UP = 0.5  # s, the motors turn before take-off and after landing
PULL = 1.5  # 1/s, speed of the rover by its distance to the point that it follows
TURN = 2.5  # 1/s, turning rate by the direction to that point
SLACK = 0.03  # m, within which it stands still
SLOWEST = 0.05  # m/s, so that it gets there
HARDEST, HARDEST_TURN = 1.0, 4.0  # m/s^2, rad/s^2
FASTEST_TURN = 1.5  # rad/s
DRIVES, STANDS = (8.0, 20.0), (6.0, 9.0)  # s, between stops and of a stop
FINE = 0.01  # s, steps in which the position of the rover is summed up
STEPS = 1.9  # Hz, of a person who walks
BOB, SWAY, TILT = 0.02, 0.01, np.deg2rad(6.0)  # m, m, rad: of a hand, by steps and otherwise


@dataclass(frozen=True)
class ExactMotion:
    """Exact motion at n instants. Body frame x forward, y left, z up; world z up.

    Attributes
    ----------
    p, v, a : (n, 3) m, m/s, m/s^2, world.
    q : (n, 4) x y z w, body to world.
    body_rates : (n, 3) rad/s, body.
    specific_force : (n, 3) m/s^2, body.
    """

    p: np.ndarray
    v: np.ndarray
    a: np.ndarray
    q: np.ndarray
    body_rates: np.ndarray
    specific_force: np.ndarray


class Trajectory:
    """A quadrotor flight along splines of position and yaw.

    Their derivatives are exact; attitude and rates follow from them.

    Attributes
    ----------
    take_off, landing : s; None for a start in the air.
    """

    def __init__(self, t: np.ndarray, p: np.ndarray, yaw: np.ndarray, at_rest: bool = True) -> None:
        """Fit the splines.

        Parameters
        ----------
        t : (n,) s, rising.
        p : (n, 3) m.
        yaw : (n,) rad, without jumps.
        at_rest : whether it is at rest before and after.
        """
        self.take_off: float | None = None
        self.landing: float | None = None
        self._start, self._end, self._at_rest = float(t[0]), float(t[-1]), at_rest
        of_position = ([(k, np.zeros(3)) for k in (1, 2, 3)],) * 2 if at_rest else None
        of_yaw = ([(k, 0.0) for k in (1, 2, 3)],) * 2 if at_rest else None
        self._p = make_interp_spline(t, p, k=7, bc_type=of_position)
        self._yaw = make_interp_spline(t, yaw, k=7, bc_type=of_yaw)

    @classmethod
    def of_config(cls, config: Complete, room: Room, rng: np.random.Generator) -> Trajectory:
        """Return the flight over 0 ... config.duration, of a complete config in a room.

        Around the path the vehicle takes off, speeds up, slows down and lands. `rng` draws the
        family of the path. Raises InputError if the flight does not fit the room, the time or the
        vehicle.
        """
        start, end = 0.0, config.duration
        if not config.start_in_air:
            rise = max(3.0, 1.5 * config.height)
            shortest = 2.0 * (config.floor_time + rise + SPEED_UP)
            if config.duration < shortest:
                raise InputError(
                    f"duration: {config.duration:g} s is too short to take off and land; give "
                    f"{shortest:g} s or more, "
                    "a shorter floor_time, or start in the air."
                )
            start, end = config.floor_time, config.duration - config.floor_time
        air = end - start
        tau = np.linspace(0.0, air, max(int(np.ceil(air / KNOT)), 8) + 1)
        s = tau if config.start_in_air else path_time(tau, rise, air)
        p = path_of(s, config, room, rng)
        yaw = yaw_along(s, p, config)
        if not config.start_in_air:
            lift = STEP(np.clip(tau / rise, 0.0, 1.0)) * STEP(np.clip((air - tau) / rise, 0.0, 1.0))
            ground = room.lower[2] + REST_HEIGHT
            p[:, 2] = ground + lift * (p[:, 2] - ground)
        out = cls(start + tau, p, yaw, not config.start_in_air)
        if not config.start_in_air:
            out.take_off, out.landing = start, end
        hardest = np.linalg.norm(out._p.derivative(2)(start + tau), axis=1).max()
        if hardest > MAX_ACCELERATION:
            raise InputError(
                f"speed: {config.speed:g} m/s asks for an acceleration of {hardest:.1f} m/s^2 "
                "on this path, "
                f"more than {MAX_ACCELERATION:g}; fly slower or wider."
            )
        return out

    def motion(self, t: ArrayLike) -> ExactMotion:
        """Return the ExactMotion at stamps t, (n,) s; it rests before take-off and after landing.

        The thrust, along body z, carries weight, acceleration and rotor drag (differential flatness
        of a quadrotor, after Mellinger and Kumar, ICRA 2011). The body rates are the analytic
        derivative of that attitude.
        """
        t = np.asarray(t, dtype=float)
        inside = np.clip(t, self._start, self._end)
        moving = ((t > self._start) & (t < self._end))[:, None] if self._at_rest else 1.0
        p = self._p(inside)
        v, a, jerk = (self._p.derivative(k)(inside) * moving for k in (1, 2, 3))
        yaw, yaw_rate = self._yaw(inside), self._yaw.derivative()(inside) * np.squeeze(moving)

        gravity = np.array([0.0, 0.0, GRAVITY])
        thrust = a + gravity + DRAG * v
        thrust_rate = jerk + DRAG * a
        size = np.linalg.norm(thrust, axis=1, keepdims=True)
        z = thrust / size
        z_rate = (thrust_rate - z * np.sum(z * thrust_rate, axis=1, keepdims=True)) / size
        heading = np.column_stack([np.cos(yaw), np.sin(yaw), np.zeros(len(t))])
        heading_rate = yaw_rate[:, None] * np.column_stack(
            [-np.sin(yaw), np.cos(yaw), np.zeros(len(t))]
        )
        y = np.cross(z, heading)
        y_size = np.linalg.norm(y, axis=1, keepdims=True)
        y /= y_size
        x = np.cross(y, z)
        y_rate = (
            np.cross(z_rate, heading) + np.cross(z, heading_rate)
        ) / y_size  # up to a part along y itself
        body_rates = np.column_stack(
            [np.sum(u * w, axis=1) for u, w in ((-y, z_rate), (x, z_rate), (-x, y_rate))]
        )
        axes = np.stack([x, y, z], axis=2)
        q = _without_sign_flips(Rotation.from_matrix(axes).as_quat())
        return ExactMotion(p, v, a, q, body_rates, np.einsum("nij,ni->nj", axes, a + gravity))

    def motors(self, t: ArrayLike) -> np.ndarray:
        """Return whether the motors run at stamps t: (n,) bool."""
        t = np.asarray(t)
        return (
            (t >= self._start - SPIN_UP) & (t <= self._end + SPIN_UP)
            if self._at_rest
            else np.ones(len(t), bool)
        )


class Rover:
    """A rover with two driven wheels that follows a point along the path of a config.

    Its base is on the floor, x ahead. Heights of the path are ignored. It stops with the point, and
    stands for config.floor_time before and after.
    """

    def __init__(self, config: Complete, room: Room, rng: np.random.Generator) -> None:
        """Follow the path of a complete config in a room; `rng` draws stops and the family."""
        _check_time(config)
        self._floor = float(room.lower[2])
        tau = np.arange(0.0, config.duration + KNOT, KNOT)
        goes = _path_rate(tau, config, rng)
        target = path_of(np.concatenate([[0.0], np.cumsum(KNOT * goes)[:-1]]), config, room, rng)[
            :, :2
        ]
        start, heading, speed, turning = _follow(target, config.speed)
        knots = KNOT * np.arange(-2, len(tau) + 2)
        self._speed, self._turning = BSpline(knots, speed, 3), BSpline(knots, turning, 3)
        turned = self._turning.antiderivative()
        self._yaw: Callable[[np.ndarray], np.ndarray] = lambda t: heading + turned(t) - turned(0.0)
        fine = np.arange(0.0, config.duration + FINE, FINE)
        velocity, between = self._velocity(fine), self._velocity(fine[:-1] + 0.5 * FINE)
        step = FINE / 6.0 * (velocity[:-1] + 4.0 * between + velocity[1:])  # Simpson
        self._p = CubicHermiteSpline(
            fine, start + np.vstack([np.zeros((1, 2)), np.cumsum(step, axis=0)]), velocity
        )
        self._last = fine[-1]

    def _velocity(self, t: np.ndarray) -> np.ndarray:
        yaw = self._yaw(t)
        velocity: np.ndarray = self._speed(t)[:, None] * np.column_stack([np.cos(yaw), np.sin(yaw)])
        return velocity

    def motion(self, t: ArrayLike) -> ExactMotion:
        """Return the ExactMotion at stamps t, (n,) s."""
        t = np.clip(np.asarray(t, dtype=float), 0.0, self._last)
        zero, yaw = np.zeros(len(t)), self._yaw(t)
        speed, turning = self._speed(t), self._turning(t)
        ahead, aside = self._speed.derivative()(t), speed * turning
        cos, sin = np.cos(yaw), np.sin(yaw)
        return ExactMotion(
            p=np.column_stack([self._p(t), np.full(len(t), self._floor)]),
            v=np.column_stack([speed * cos, speed * sin, zero]),
            a=np.column_stack([ahead * cos - aside * sin, ahead * sin + aside * cos, zero]),
            q=np.column_stack([zero, zero, np.sin(0.5 * yaw), np.cos(0.5 * yaw)]),
            body_rates=np.column_stack([zero, zero, turning]),
            specific_force=np.column_stack([ahead, aside, np.full(len(t), GRAVITY)]),
        )

    def motors(self, t: ArrayLike) -> np.ndarray:
        """Return whether the wheels turn at stamps t: (n,) bool."""
        t = np.clip(np.asarray(t, dtype=float), 0.0, self._last)
        turns: np.ndarray = (self._speed(t) != 0.0) | (self._turning(t) != 0.0)
        return turns


def _path_rate(tau: np.ndarray, config: Complete, rng: np.random.Generator) -> np.ndarray:
    """Return the rate of path time at tau (n,) s: 0 at rest and at stops, 1 between them, smooth."""
    ends = [0.0, config.floor_time]
    last = config.duration - config.floor_time - SPEED_UP
    while ends[-1] < last:
        ends += [ends[-1] + rng.uniform(*DRIVES)]
        ends += [ends[-1] + rng.uniform(*STANDS)]
    out = np.zeros(len(tau))
    for begin, end in zip(ends[1::2], ends[2::2]):
        end = min(end, last)
        since, until = ((tau - begin) / SPEED_UP, (end - tau) / SPEED_UP)
        out += np.asarray(
            STEP(np.clip(since, 0.0, 1.0)) * STEP(np.clip(until, 0.0, 1.0)), dtype=float
        )
    return out


def _follow(target: np.ndarray, speed: float) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
    """Return how a rover follows a target (n, 2) m with `speed`, m/s, at steps of KNOT.

    Returns
    -------
    place (2,) m and heading rad at the start, speed (n,) m/s, turning rate (n,) rad/s.
    """
    away = target - target[0]
    # of the path's beginning; east if it goes nowhere
    ahead = away[np.argmax(np.hypot(*away.T) > 0.3)]
    heading = yaw = float(np.arctan2(ahead[1], ahead[0]))
    x, y = map(float, target[0])
    v = w = 0.0
    speeds, turnings = [], []
    for goal_x, goal_y in target.tolist():
        distance = np.hypot(goal_x - x, goal_y - y)
        bearing = (np.arctan2(goal_y - y, goal_x - x) - yaw + np.pi) % (2.0 * np.pi) - np.pi
        outside = distance > SLACK
        wanted = (
            min(PULL * (distance - SLACK) + SLOWEST, 1.5 * speed) * max(np.cos(bearing), 0.0)
            if outside
            else 0.0
        )
        turn = (
            float(np.clip(TURN * bearing, -FASTEST_TURN, FASTEST_TURN))
            * min(5.0 * (distance - SLACK), 1.0)
            if outside
            else 0.0
        )
        v += float(np.clip(wanted - v, -HARDEST * KNOT, HARDEST * KNOT))
        w += float(np.clip(turn - w, -HARDEST_TURN * KNOT, HARDEST_TURN * KNOT))
        middle = yaw + 0.5 * w * KNOT
        x, y, yaw = x + v * KNOT * np.cos(middle), y + v * KNOT * np.sin(middle), yaw + w * KNOT
        speeds.append(v)
        turnings.append(w)
    return target[0], heading, np.array(speeds), np.array(turnings)


class HandHeld:
    """A tag in the hand of a person who walks along the path of a config.

    It bobs with the steps, sways and tilts. The person stands for config.floor_time before and
    after.
    """

    def __init__(self, config: Complete, room: Room, rng: np.random.Generator) -> None:
        """Fit the splines to the path of a complete config in a room; `rng` draws the sway."""
        _check_time(config)
        tau = np.linspace(0.0, config.duration, max(int(np.ceil(config.duration / KNOT)), 8) + 1)
        s = path_time(tau, config.floor_time, config.duration)
        p = path_of(s, config, room, rng)
        if config.path is None:
            p[:, 2] = config.height
        yaw = yaw_along(s, p, config)
        pace = np.gradient(s, tau)
        phase, period = rng.uniform(0.0, 2.0 * np.pi, (5, 2)), rng.uniform(2.0, 7.0, (5, 2))
        slow = np.sin(2.0 * np.pi * tau[:, None, None] / period + phase).mean(axis=2)  # (n, 5)
        p += SWAY * slow[:, :3]
        p[:, 2] += BOB * pace * np.sin(2.0 * np.pi * STEPS * tau)
        self._p = make_interp_spline(tau, p, k=7)
        # roll, pitch, yaw
        self._angles = CubicSpline(tau, np.column_stack([TILT * slow[:, 3:], yaw]))

    def motion(self, t: ArrayLike) -> ExactMotion:
        """Return the ExactMotion at stamps t, (n,) s."""
        t = np.asarray(t, dtype=float)
        a = self._p.derivative(2)(t)
        roll, pitch, yaw = self._angles(t).T
        d_roll, d_pitch, d_yaw = self._angles.derivative()(t).T
        turn = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll]))
        rates = np.column_stack(
            [
                d_roll - d_yaw * np.sin(pitch),
                d_pitch * np.cos(roll) + d_yaw * np.sin(roll) * np.cos(pitch),
                d_yaw * np.cos(roll) * np.cos(pitch) - d_pitch * np.sin(roll),
            ]
        )
        return ExactMotion(
            self._p(t),
            self._p.derivative()(t),
            a,
            _without_sign_flips(turn.as_quat()),
            rates,
            turn.inv().apply(a + [0.0, 0.0, GRAVITY]),
        )

    def motors(self, t: ArrayLike) -> np.ndarray:
        """Return False for all stamps t: (n,) bool."""
        return np.zeros(len(np.asarray(t)), bool)


def _without_sign_flips(q: np.ndarray) -> np.ndarray:
    """Return quaternions (n, 4) whose signs are continuous."""
    signs = np.where(np.sum(q[1:] * q[:-1], axis=1) < 0.0, -1.0, 1.0)
    q[1:] *= np.cumprod(signs)[:, None]
    return q


def _check_time(config: Complete) -> None:
    shortest = 2.0 * (config.floor_time + SPEED_UP)
    if config.duration < shortest:
        raise InputError(
            f"duration: {config.duration:g} s is too short to start and stop; give "
            f"{shortest:g} s or more, or a shorter floor_time."
        )


Flyable = Trajectory | Rover | HandHeld  # what `simulate` moves
VEHICLES: dict[str, Callable[[Complete, Room, np.random.Generator], Flyable]] = {
    "quadrotor": Trajectory.of_config,
    "rover": Rover,
    "hand": HandHeld,
}
