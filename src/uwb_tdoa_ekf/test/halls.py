# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulated halls and a room, for tests and tables.

In a hall, a tag hears the anchors within the reach of the radio. In the room, it hears few TDOAs.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas, Truth
from uwb_tdoa_bias.common.geometry import tdoa

RATE = 100.0  # Hz, rate of inertial samples and ground truth
HEIGHT = 1.2  # m, height of the tag above its floor
OUTLIERS, OUTLIER_SIZE = 0.05, 2.0  # share, and mean of the exponential size in m, of either sign
NOISE, DELAY = 0.1, 0.1  # m, standard deviation of a TDOA, and delay of an anchor
FLOOR = 8.0  # m between two floors
# size in m, number of anchors along each side, reach in m
HALLS = {
    "100 x 60 m, 77 anchors": ((100.0, 60.0), (11, 7), 18.0),
    "200 x 100 m, 231 anchors": ((200.0, 100.0), (21, 11), 18.0),
    "300 x 200 m, 294 anchors": ((300.0, 200.0), (21, 14), 27.0),
    "300 x 200 m, 988 anchors": ((300.0, 200.0), (38, 26), 18.0),
    "1000 x 640 m, 10000 anchors": ((1000.0, 640.0), (125, 80), 18.0),
}
ROOM = (8.0, 6.0)
# positions of the anchors in a room of 8 x 6 m
ROOMS = {
    "corners": [(x, y, z) for x in (0.0, 8.0) for y in (0.0, 6.0) for z in (0.2, 2.5)],
    "ceiling, 4": [(x, y, 2.5) for x in (0.0, 8.0) for y in (0.0, 6.0)],
    "ceiling, 8": [(x, y, 2.5) for x in (0.0, 4.0, 8.0) for y in (0.0, 3.0, 6.0)][:8],
    "wall, 8": [(0.0, y, z) for y in (0.0, 2.0, 4.0, 6.0) for z in (0.5, 2.5)],
    "line, 5": [(x, 0.0, 2.5) for x in (0.0, 2.0, 4.0, 6.0, 8.0)],
}


@dataclass(frozen=True)
class Hall:
    """Anchors of a hall with one or more floors.

    anchors : Anchors.
    size : (x, y), in m.
    reach : reach of the radio, in m.
    floor : (N,) floor of each anchor. A tag hears only the anchors of its floor.
    """

    anchors: Anchors
    size: tuple
    reach: float
    floor: np.ndarray


def hall(name, floors=1, seed=7):
    """Return a Hall of HALLS with the given number of floors above each other.

    The anchors form a grid. Two thirds hang at 2.5 to 6 m, one third at 0.4 to 1.2 m.
    """
    size, counts, reach = HALLS[name]
    rng, n, parts = np.random.default_rng(seed), counts[0] * counts[1], []
    x, y = np.meshgrid(
        *((np.arange(count) + 0.5) * length / count for count, length in zip(counts, size))
    )
    for floor in range(floors):
        z = (
            np.where(rng.random(n) < 1.0 / 3.0, rng.uniform(0.4, 1.2, n), rng.uniform(2.5, 6.0, n))
            + floor * FLOOR
        )
        parts.append(
            np.column_stack([x.ravel(), y.ravel(), z])
            + np.append(rng.uniform(-1.0, 1.0, (n, 2)), np.zeros((n, 1)), axis=1)
        )
    return Hall(
        Anchors.from_positions(np.concatenate(parts)), size, reach, np.repeat(np.arange(floors), n)
    )


def room(name):
    """Return the Hall of a room of ROOMS. A tag hears every anchor."""
    return Hall(
        Anchors.from_positions(np.array(ROOMS[name])), ROOM, 100.0, np.zeros(len(ROOMS[name]))
    )


def walk(size, duration, rng, speed):
    """Return a level path that turns smoothly from one random goal to the next.

    Returns positions (n, 2), in m, and headings (n,), in rad, every 1 / RATE s.
    """
    n, dt = int(duration * RATE) + 1, 1.0 / RATE
    margin = np.minimum(3.0, 0.2 * np.array(size))
    p = rng.uniform(margin, np.array(size) - margin)
    places, headings, heading, turning, goal = (
        np.empty((n, 2)),
        np.empty(n),
        rng.uniform(-np.pi, np.pi),
        0.0,
        p,
    )
    for k in range(n):
        places[k], headings[k] = p, heading
        if np.hypot(*(goal - p)) < 3.0:
            goal = np.clip(p + rng.uniform(-25.0, 25.0, 2), margin, np.array(size) - margin)
        off = (np.arctan2(*(goal - p)[::-1]) - heading + np.pi) % (2.0 * np.pi) - np.pi
        turning += np.clip(np.clip(1.5 * off, -1.0, 1.0) - turning, -3.0 * dt, 3.0 * dt)
        heading += turning * dt
        p = p + speed * dt * np.array([np.cos(heading), np.sin(heading)])
    return places, headings


def fly(where, seed, duration=20.0, rate=200.0, blinks=0.0, speed=1.5, dead=(), lift=None):
    """Simulate a flight of a tag that walks in a Hall.

    Parameters
    ----------
    rate : float
        TDOAs per second, between random pairs of the anchors in reach.
    blinks : float
        Blinks per second instead. Each gives the TDOAs of all anchors in reach with the first one.
    dead : list of (begin, end)
        Times without TDOAs, in s.
    lift : float, optional
        Time at which the tag is carried one floor up, in s. This takes 10 s without TDOAs.
    """
    rng = np.random.default_rng([seed, 5])
    places, heading = walk(where.size, duration, rng, speed)
    t = np.arange(len(places)) / RATE
    up = np.zeros(len(t)) if lift is None else np.clip((t - lift) / 10.0, 0.0, 1.0)
    p = np.column_stack([places, HEIGHT + FLOOR * up * up * (3.0 - 2.0 * up)])
    v, turning = np.gradient(p, 1.0 / RATE, axis=0), np.gradient(heading, 1.0 / RATE)
    attitude = Rotation.from_euler("z", heading)
    accel = attitude.inv().apply(np.gradient(v, 1.0 / RATE, axis=0) + [0.0, 0.0, 9.81])
    accel += rng.normal(0.0, 0.3, p.shape) + rng.normal(0.0, 0.05, 3)
    gyro = np.column_stack([np.zeros((len(t), 2)), turning]) + rng.normal(0.0, 0.01, p.shape)

    dead = [*dead, *([(lift, lift + 10.0)] if lift is not None else [])]
    at = (
        np.arange(0.05, duration, 1.0 / blinks)
        if blinks
        else np.arange(0.5 / rate, duration, 1.0 / rate)
    )
    at = at[~np.any([(begin <= at) & (at < end) for begin, end in dead], axis=0)] if dead else at
    row = np.minimum(np.rint(at * RATE).astype(int), len(t) - 1)
    trees = [
        cKDTree(where.anchors.positions[where.floor == floor]) for floor in np.unique(where.floor)
    ]
    first = [np.flatnonzero(where.floor == floor)[0] for floor in np.unique(where.floor)]
    stamps, a, b = [], [], []
    for s, k in zip(at, row):
        floor = int(up[k] >= 1.0)
        heard = first[floor] + np.array(
            trees[floor].query_ball_point(p[k], where.reach, return_sorted=True), int
        )
        if len(heard) < 2:
            continue
        pairs = (
            [(heard[0], other) for other in heard[1:]]
            if blinks
            else [rng.choice(heard, 2, replace=False)]
        )
        for one, other in pairs:
            stamps.append(s), a.append(one), b.append(other)
    stamps, a, b = np.array(stamps), np.array(a), np.array(b)
    delay, n = DELAY * rng.standard_normal(len(where.anchors)), len(stamps)
    there = np.column_stack([np.interp(stamps, t, column) for column in p.T])
    d = (
        tdoa(there, where.anchors.positions[a], where.anchors.positions[b])
        + delay[b]
        - delay[a]
        + NOISE * rng.standard_normal(n)
    )
    d += np.where(
        rng.random(n) < OUTLIERS, rng.exponential(OUTLIER_SIZE, n) * rng.choice([-1.0, 1.0], n), 0.0
    )
    ids = where.anchors.ids
    return Flight(
        name=f"hall-{seed}",
        anchors=where.anchors,
        tdoa=Tdoas(stamps, ids[a], ids[b], d),
        imu=Imu(t[1:], gyro[1:], accel[1:]),
        truth=Truth(t, p, attitude.as_quat()),
    )
