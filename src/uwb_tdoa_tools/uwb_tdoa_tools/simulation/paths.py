# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Paths: trajectory families and waypoints.

A family gives positions over "path time" s. Path time runs with the clock at cruise; vehicles slow
it down at both ends.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.polynomial import Polynomial
from scipy.interpolate import CubicSpline

from uwb_tdoa_bias.common.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .config import Complete
    from .rooms import Room


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
    if config.trajectory not in TRAJECTORIES:
        raise InputError(
            f"trajectory: {config.trajectory!r} is not known; choose {', '.join(TRAJECTORIES)}."
        )
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
