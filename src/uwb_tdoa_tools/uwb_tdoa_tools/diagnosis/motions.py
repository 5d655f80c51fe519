# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Motions of a flight to come: timed paths in a box, within limits of speed and turning.

A motion begins and ends at rest. A planned flight joins motions by the straight ways between them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight

from ..choices import PLAN_SPEED, PLAN_TIME
from ..simulation.config import Room
from ..simulation.vehicles import SPEED_UP, STEP

RATE = 20.0  # Hz, of planned poses
ANCHOR_CLEARANCE = 0.8  # m, smallest distance of the path to an anchor
STEEPEST = 315.0 / 128.0  # largest derivative of STEP
SLOW = 0.3  # share of the speed in a slow pass
NEAR_ANCHORS = 16  # anchors that motions approach


@dataclass(frozen=True)
class Limits:
    """Limits of a planned flight: s, m/s, m/s^2 and rad/s."""

    time: float = PLAN_TIME
    speed: float = PLAN_SPEED
    acceleration: float = 1.5
    turning: float = 0.8

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 < value < np.inf:
                raise InputError(f"--plan-{name}: {value!r} is not a finite number above 0.")


@dataclass(frozen=True, eq=False)
class TimedPath:
    """Timed poses at RATE, at rest at both ends.

    p : (n, 3) m, world; yaw : (n,) rad, without jumps; what : the motion, in words
    stops : rows at rest, the first and the last among them
    """

    p: np.ndarray
    yaw: np.ndarray
    what: str
    stops: tuple[int, ...]

    @property
    def t(self) -> np.ndarray:
        """Return the stamps, (n,) s from 0."""
        return np.arange(len(self.p)) / RATE

    @property
    def duration(self) -> float:
        """Return the duration, s."""
        return (len(self.p) - 1) / RATE

    def then(self, other: TimedPath) -> TimedPath:
        """Return this and another that starts at its end; whole turns of the yaw are undone."""
        turns = np.round((other.yaw[0] - self.yaw[-1]) / (2.0 * np.pi))
        yaw = np.concatenate([self.yaw, other.yaw[1:] - 2.0 * np.pi * turns])
        p, last = np.concatenate([self.p, other.p[1:]]), len(self.p) - 1
        stops = (*self.stops, *(last + stop for stop in other.stops[1:]))
        return TimedPath(p, yaw, f"{self.what}, {other.what}", stops)


class Library(NamedTuple):
    """Motions that a planned flight can consist of, the anchors, and its limits."""

    paths: tuple[TimedPath, ...]
    anchors: Anchors
    limits: Limits


def motions(room: Room, flights: Sequence[Flight], limits: Limits) -> Library:
    """Return the Library of motions in a Room: lines, circles, turns, and passes at anchors.

    They keep the clearance of `Room.path_box` to walls, floor and ceiling, and ANCHOR_CLEARANCE to
    anchors. Raises InputError if none fits, or if a Flight lacks TDOAs.
    """
    anchors = flights[0].anchors
    if not all(len(flight.tdoa) for flight in flights):
        raise InputError("--plan-flight: needs TDOAs in each flight; leave it out.")
    every = _everywhere(room, anchors, limits)
    out = [path for path in every if path.duration <= limits.time and is_clear(path, anchors)]
    if not out:
        raise InputError(
            "--plan-flight: no motion fits into this box, this time and the distance of "
            f"{ANCHOR_CLEARANCE:g} m to anchors; give a larger box or more time."
        )
    return Library(tuple(out), anchors, limits)


def _everywhere(room: Room, anchors: Anchors, limits: Limits) -> list[TimedPath]:
    """Return the motions in a Room, whether they fit or not."""
    low, high = room.path_box
    centre, half = 0.5 * (low + high), 0.5 * (high - low)
    levels = {"low": low[2], "middle": centre[2], "high": high[2]}
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    slow = replace(limits, speed=SLOW * limits.speed)
    out = []
    for name, z in levels.items():
        at = np.array([*centre[:2], z])
        for k, axis in enumerate("xy"):
            reach = half * np.eye(3)[k]
            for turn, how in ((0.0, ""), (2.0 * np.pi, ", turning once")):
                words = f"line along {axis}, {name}{how}"
                out.append(_line(at - reach, at + reach, (0.0, turn), limits, words))
        for share, size in ((1.0, "wide"), (0.5, "narrow")):
            radius = share * min(half[:2])
            for yaw_follows, how in ((False, "yaw kept"), (True, "yaw along the track")):
                words = f"{size} circle, {name}, {how}"
                out.append(_circle(at, radius, yaw_follows, limits, words))
    for corner in corners[:2]:
        reach = half * [*corner, -1.0]
        out.append(_line(centre + reach, centre - reach, (0.0, 0.0), limits, "rising diagonal"))
    reach = half * [1.0, 1.0, 0.0]
    for each, how in ((slow, "slowly"), (limits, "fast")):
        there = _line(centre - reach, centre + reach, (0.0, 0.0), each, f"diagonal, {how}")
        back = _line(centre + reach, centre - reach, (0.0, 0.0), each, "back")
        out.append(there.then(back))
    for place, name in (
        (centre, "in the middle"),
        *((centre + half * [*c, 0], "in a corner") for c in corners),
    ):
        out.append(_line(place, place, (0.0, 2.0 * np.pi), limits, f"full turn {name}"))
    for anchor in np.argsort(np.linalg.norm(anchors.positions - centre, axis=1))[:NEAR_ANCHORS]:
        near = _beside(anchors.positions[anchor], low, high)
        number = anchors.ids[anchor]
        to = _line(centre, near, (0.0, 0.0), limits, f"to anchor {number}")
        out.append(to.then(_line(near, centre, (0.0, 0.0), limits, "back")))
        foot, top = np.array([*near[:2], low[2]]), np.array([*near[:2], high[2]])
        up = _line(foot, top, (0.0, 0.0), limits, f"up at anchor {number}")
        out.append(up.then(_line(top, foot, (0.0, 0.0), limits, "down")))
    return out


def continued(path: TimedPath | None, motion: TimedPath, limits: Limits) -> tuple[TimedPath, float]:
    """Return (the path, the way to a motion and the motion; when the motion starts, s)."""
    if path is None:
        return motion, 0.0
    turn = float(np.angle(np.exp(1j * (motion.yaw[0] - path.yaw[-1]))))
    if max(float(np.linalg.norm(motion.p[0] - path.p[-1])), abs(turn)) > 1e-6:
        ends = path.yaw[-1], path.yaw[-1] + turn
        path = path.then(_line(path.p[-1], motion.p[0], ends, limits, "way"))
    return path.then(motion), path.duration


def _beside(anchor: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return a place in a box near an anchor, (3,) m, ANCHOR_CLEARANCE away if there is one."""
    near = np.clip(anchor, low, high)
    away = np.linalg.norm(near - anchor)
    if away >= ANCHOR_CLEARANCE:
        return near
    inwards = 0.5 * (low + high) - anchor
    step = 1.01 * ANCHOR_CLEARANCE / max(float(np.linalg.norm(inwards)), 1e-9)
    out: np.ndarray = np.clip(anchor + min(1.0, step) * inwards, low, high)
    return out


def is_clear(path: TimedPath, anchors: Anchors) -> bool:
    """Return whether a TimedPath keeps its distance to all anchors."""
    away = np.linalg.norm(path.p[::5, None] - anchors.positions, axis=2)
    return bool(away.min() >= ANCHOR_CLEARANCE)


def _line(
    start: np.ndarray, end: np.ndarray, yaw: tuple[float, float], limits: Limits, what: str
) -> TimedPath:
    """Return the straight TimedPath between two places, from rest to rest, while the yaw turns."""
    s = _progress(float(np.linalg.norm(end - start)), abs(yaw[1] - yaw[0]), limits)
    p, turned = start + s[:, None] * (end - start), yaw[0] + s * (yaw[1] - yaw[0])
    return TimedPath(p, turned, what, (0, len(s) - 1))


def _circle(
    centre: np.ndarray, radius: float, yaw_follows: bool, limits: Limits, what: str
) -> TimedPath:
    """Return a level circle, from rest to rest.

    yaw_follows : whether the yaw follows the track; otherwise it stays 0
    """
    # The centripetal acceleration limits the speed, too.
    speed = min(limits.speed, np.sqrt(limits.acceleration * radius))
    turn = 2.0 * np.pi if yaw_follows else 0.0
    s = _progress(2.0 * np.pi * radius, turn, replace(limits, speed=speed))
    angle = 2.0 * np.pi * s
    around = radius * np.column_stack([np.cos(angle), np.sin(angle), np.zeros(len(s))])
    yaw = 0.5 * np.pi + angle if yaw_follows else np.zeros(len(s))
    return TimedPath(centre + around, yaw, what, (0, len(s) - 1))


def _progress(length: float, turn: float, limits: Limits) -> np.ndarray:
    """Return the progress, 0 to 1, at RATE on the way over a length, m, with a turn, rad.

    Speed and turning rate rise and fall smoothly, within the limits.
    """
    speed = min(limits.speed, np.sqrt(max(length, 1e-6) * limits.acceleration / STEEPEST))
    ramp = max(STEEPEST * speed / limits.acceleration, min(SPEED_UP, turn / limits.turning), 0.5)
    cruise = max(length / speed, turn / limits.turning, ramp)
    t = np.arange(np.ceil((cruise + ramp) * RATE) + 1) / RATE
    scale = (cruise + ramp) / t[-1]  # the last sample is at the end

    def since(x: np.ndarray) -> np.ndarray:
        inside = np.clip(x, 0.0, 1.0)
        return STEP.integ()(inside) + np.maximum(x - 1.0, 0.0)

    t = t * scale
    out: np.ndarray = ramp * (since(t / ramp) - since((t - cruise) / ramp)) / cruise
    return out
