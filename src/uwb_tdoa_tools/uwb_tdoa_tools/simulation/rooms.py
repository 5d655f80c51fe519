# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Anchors, walls, and the room that they span."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
import re
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.safe_yaml import read_yaml

LOW = 0.18  # m, height of an anchor on its stand on the floor
CLEARANCE = 0.8  # m from the walls
FLOOR_CLEARANCE = 0.6  # m from floor and ceiling
REST_HEIGHT = 0.03  # m, height of the body frame when the vehicle stands on the floor
WALLS_FORM = (
    "write walls: [[x0, y0, x1, y1], ...], in metres, and after these the height of a wall over "
    "which signals go"
)
AT_ONCE = 200_000  # straight lines that are compared with all walls at once


def facing(
    positions: ArrayLike, target: ArrayLike, level: bool = True, inverted: ArrayLike | None = None
) -> Anchors:
    """Return Anchors whose front (antenna x) faces a point.

    Parameters
    ----------
    positions : (N, 3) m.
    target : (3,) m.
    level : rotate about the vertical only, so that the antenna axis (z) stays upright.
    inverted : (N,) bool, stands that hang upside down (z down); default none.
    """
    positions = np.asarray(positions, dtype=float)
    inverted = np.zeros(len(positions), bool) if inverted is None else np.asarray(inverted, bool)
    front = np.asarray(target, dtype=float) - positions
    if level:
        front[:, 2] = 0.0
    length = np.linalg.norm(front, axis=1, keepdims=True)
    front = np.where(length > 1e-9, front / np.maximum(length, 1e-9), [1.0, 0.0, 0.0])
    left = np.cross([0.0, 0.0, 1.0], front)
    left /= np.maximum(np.linalg.norm(left, axis=1, keepdims=True), 1e-9)
    # straight up or down: left is ours to choose
    left[np.abs(front[:, 2]) > 1.0 - 1e-9] = [0.0, 1.0, 0.0]
    left[inverted] *= -1.0
    axes = np.stack([front, left, np.cross(front, left)], axis=2)
    return Anchors(np.arange(len(positions)), positions, Rotation.from_matrix(axes).as_quat())


def corners(x: float = 7.0, y: float = 8.0, z: float = 3.0, level: bool = True) -> Anchors:
    """Place a low and a high anchor in each corner of x by y by z metres.

    The order is that in the Toronto surveys: neighbours in the TDOA2 ring are far apart. 4 anchors
    stand on the floor and 4 hang upside down under the ceiling.
    """
    a, b = 0.5 * x, 0.5 * y
    positions = [
        (-a, -b, LOW),
        (-a, b, z),
        (a, b, LOW),
        (a, -b, z),
        (-a, -b, z),
        (a, -b, LOW),
        (a, b, z),
        (-a, b, LOW),
    ]
    return _around(positions, 0.5 * z, 0.5 * z, level)


def _around(
    positions: ArrayLike, height: float, inverted_above: float = np.inf, level: bool = True
) -> Anchors:
    """Return Anchors that face the point at a height, m, in the middle.

    inverted_above : m, anchors higher than this hang upside down
    """
    positions = np.asarray(positions, dtype=float)
    return facing(positions, (0.0, 0.0, height), level, positions[:, 2] > inverted_above)


def random(seed: int, count: int = 8) -> Anchors:
    """Place `count` anchors (4 to 64) on the walls of a random room, low and high in turn.

    The room has 5 - 9 x 5 - 9 x 2.5 - 3.5 m. Anchors are at least 0.5 m apart and face the centre
    to within 20 degrees.
    """
    if not 4 <= count <= 64:
        raise InputError(
            f"constellation: random-{seed}-{count} asks for {count} anchors; choose 4 to 64."
        )
    rng = np.random.default_rng([seed, count])
    size = np.array([*rng.uniform(5.0, 9.0, 2), rng.uniform(2.5, 3.5)])
    positions = np.empty((0, 3))
    while len(positions) < count:
        place = rng.uniform(-0.5, 0.5, 3) * size
        wall = rng.integers(2)
        place[wall] = np.copysign(0.5 * size[wall], place[wall])
        low = len(positions) % 2 == 0
        place[2] = rng.uniform(LOW, 0.4 * size[2]) if low else rng.uniform(0.6, 1.0) * size[2]
        if len(positions) == 0 or np.linalg.norm(positions - place, axis=1).min() > 0.5:
            positions = np.vstack([positions, place])
    straight = facing(positions, (0.0, 0.0, 0.5 * size[2]), inverted=np.arange(count) % 2 == 1)
    wobble = Rotation.from_rotvec(np.deg2rad(12.0) * rng.standard_normal((count, 3)))
    return Anchors(
        straight.ids, positions, (wobble * Rotation.from_quat(straight.orientations)).as_quat()
    )


_FEET = [(-2.8, -2.6), (2.5, -3.2), (2.9, 2.7), (-2.4, 3.3)]  # of pillars
_RIM = [(-7, -10), (-7, -5), (-7, 0), (-7, 5), (-7, 10), (-3.5, 10), (0, 10), (3.5, 10)]
_SIX = np.deg2rad([90, 270, 210, 30, 330, 150])  # directions from the middle
CONSTELLATIONS: dict[str, Callable[[], Anchors]] = {
    "corners": corners,
    "tilted": partial(corners, level=False),
    "low_ceiling": partial(corners, 6.0, 7.0, 2.4),
    "small_room": partial(corners, 5.0, 4.5, 2.6),
    # four low anchors at the middles of the walls, four high ones in the corners, 7 x 8 x 3 m
    "wall_middles": partial(
        _around,
        [
            (-3.5, 0, LOW),
            (3.5, 4, 3),
            (0, -4, LOW),
            (-3.5, 4, 3),
            (3.5, 0, LOW),
            (-3.5, -4, 3),
            (0, 4, LOW),
            (3.5, -4, 3),
        ],
        1.5,
        1.5,
    ),
    # eight upright anchors around the walls of 7 x 8 x 3 m, each higher than the previous one
    "staircase": partial(
        _around,
        np.column_stack(
            [
                [-3.5, 0.0, 3.5, 3.5, 3.5, 0.0, -3.5, -3.5],
                [-4.0, -4.0, -4.0, 0.0, 4.0, 4.0, 4.0, 0.0],
                np.linspace(LOW, 3.0, 8)[[0, 4, 1, 5, 2, 6, 3, 7]],
            ]
        ),
        1.5,
    ),
    # anchors at three heights on each of four pillars inside 7 x 8 x 3 m
    "pillars": partial(_around, [(*at, z) for z in (0.3, 1.6, 2.9) for at in _FEET], 1.5, 2.0),
    # three low and three high anchors on two opposite triangles in 6 x 6 x 2.8 m
    "six": partial(
        _around,
        np.column_stack([3 * np.cos(_SIX), 3 * np.sin(_SIX), np.tile([LOW, 2.8], 3)]),
        1.4,
        1.0,
    ),
    # six anchors on the walls of 12 x 8 m, at 0.8 and 2.8 m in turn, for rovers
    "six_wide": partial(
        _around,
        np.column_stack(
            [[-6.0, 0.0, 6.0, 6.0, 0.0, -6.0], np.repeat([-4.0, 4.0], 3), np.tile([0.8, 2.8], 3)]
        ),
        1.0,
        1.0,
    ),
    # sixteen anchors along the walls of a hall of 14 x 20 x 5 m, low and high in turn
    "hall": partial(
        _around,
        np.column_stack([[*_RIM, *((-x, -y) for x, y in _RIM)], np.tile([0.3, 5.0], 8)]),
        2.5,
        1.0,
    ),
    # four anchors at the corners of 4 x 4 m: Grasso et al. (Sensors 2022), section 2.1
    "planar": partial(_around, [(-2, -2, 0.2), (2, -2, 0.2), (2, 2, 0.2), (-2, 2, 0.2)], 0.2),
    # two anchors 4.5 m apart at 1.25 m, facing each other. The default place of hovering is half-way
    # between them: the bench of Zhao et al. (RA-L 2021), figure 4.
    "pair": partial(_around, [(-2.25, 0, 1.25), (2.25, 0, 1.25)], 1.25),
}


def constellation(name: str) -> Anchors:
    """Return the Anchors of a named constellation, `random-SEED` or `random-SEED-COUNT`.

    Raises InputError.
    """
    if name in CONSTELLATIONS:
        return CONSTELLATIONS[name]()
    if match := re.fullmatch(r"random-(\d{1,9})(?:-(\d{1,5}))?", str(name)):
        return random(int(match[1]), int(match[2] or 8))
    choices = ", ".join(CONSTELLATIONS)
    raise InputError(
        f"constellation: {name!r} is not known; choose {choices} or random-SEED[-COUNT]."
    )


@dataclass(frozen=True)
class Room:
    """A box in the world frame.

    Attributes
    ----------
    lower, upper : (3,) m, corners; the floor is at lower[2].
    area : ((x, y), (x, y)) m, lower and upper corner of the part for paths; None for all but a
        clearance.
    """

    lower: np.ndarray
    upper: np.ndarray
    area: tuple[tuple[float, ...], ...] | None = None

    @classmethod
    def of_numbers(cls, name: str, numbers: Sequence[float]) -> Room:
        """Return the Room of X0 X1 Y0 Y1 Z0 Z1, m. Raise InputError if it is empty.

        name : option that gives the numbers
        """
        lower, upper = np.array(numbers[0::2]), np.array(numbers[1::2])
        if not (upper > lower).all():
            raise InputError(
                f"{name}: {list(numbers)} is empty; give X0 X1 Y0 Y1 Z0 Z1, each pair rising."
            )
        return cls(lower, upper)

    @property
    def centre(self) -> np.ndarray:
        """Return the centre of the room, or of the area, if there is one: (3,) m."""
        if self.area is None:
            return 0.5 * (self.lower + self.upper)
        return 0.5 * np.sum(self.path_box, axis=0)

    @property
    def path_box(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the box for paths of vehicles, (lower, upper), (3,) m each.

        It is the room less a clearance, at most a quarter of the size on each side. The area
        replaces x and y, and has no clearance.
        """
        margin = np.minimum(
            [CLEARANCE, CLEARANCE, FLOOR_CLEARANCE], 0.25 * (self.upper - self.lower)
        )
        low, high = self.lower + margin, self.upper - margin
        if self.area is not None:
            low[:2], high[:2] = self.area
        return low, high

    def around(self, points: np.ndarray) -> Room:
        """Return the Room, extended to points (n, 2 or 3) m."""
        k = points.shape[1]
        lower, upper = self.lower.copy(), self.upper.copy()
        lower[:k] = np.minimum(lower[:k], points.min(axis=0))
        upper[:k] = np.maximum(upper[:k], points.max(axis=0))
        return replace(self, lower=lower, upper=upper)


def room_of(anchors: Anchors) -> Room:
    """Return the Room of Anchors: the box around them, at least 4 x 4 x 2.5 m.

    The floor is at 0 or at the lowest anchor.
    """
    lowest, highest = anchors.positions.min(axis=0), anchors.positions.max(axis=0)
    middle, half = 0.5 * (lowest + highest), np.maximum(0.5 * (highest - lowest), 2.0)
    floor = min(0.0, lowest[2])
    return Room(
        np.array([middle[0] - half[0], middle[1] - half[1], floor]),
        np.array([middle[0] + half[0], middle[1] + half[1], max(highest[2], floor + 2.5)]),
    )


@dataclass(frozen=True)
class Walls:
    """Upright walls between two points seen from above.

    Attributes
    ----------
    segments : ((x0, y0, x1, y1, height), ...) m, in the frame of the anchors. Signals pass above
        the height; inf for none.
    """

    segments: tuple[tuple[float, ...], ...]

    @classmethod
    def from_yaml(cls, path: str | Path) -> Walls:
        """Read `walls: [[x0, y0, x1, y1], [x0, y0, x1, y1, height], ...]`. Raise InputError."""
        content = read_yaml(path)
        entries = content.get("walls") if isinstance(content, dict) else None
        if not isinstance(entries, list) or not entries:
            raise InputError(f"{path}: has no list 'walls'; {WALLS_FORM}.")
        return cls(
            tuple(_segment(path, number, entry) for number, entry in enumerate(entries, start=1))
        )

    def between(self, starts: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """Return whether a wall stands between pairs of points, (n, 3) m each: (n,) bool.

        The points are not on a wall.
        """
        line, out = ends - starts, np.zeros(len(starts), bool)
        with np.errstate(
            divide="ignore", invalid="ignore"
        ):  # lines along a wall, which cross it nowhere
            for x0, y0, x1, y1, height in self.segments:
                wall, to_wall = (x1 - x0, y1 - y0), (x0 - starts[:, 0], y0 - starts[:, 1])
                crossed = line[:, 0] * wall[1] - line[:, 1] * wall[0]
                along_line = (to_wall[0] * wall[1] - to_wall[1] * wall[0]) / crossed
                along_wall = (to_wall[0] * line[:, 1] - to_wall[1] * line[:, 0]) / crossed
                out |= (
                    (along_line > 0.0)
                    & (along_line < 1.0)
                    & (along_wall >= 0.0)
                    & (along_wall <= 1.0)
                    & (starts[:, 2] + along_line * line[:, 2] < height)
                )
        return out


def heard_at(
    p: np.ndarray, positions: np.ndarray, reach: float, walls: Walls | None = None
) -> list[np.ndarray]:
    """Return the rows of the anchors that are heard at each point.

    Parameters
    ----------
    p : (n, 3) m, points that are not on a wall.
    positions : (N, 3) m, of the anchors.
    reach : m, largest distance of an anchor that is heard.
    walls : Walls that hide anchors; None for no walls.

    Returns
    -------
    List of n arrays (k,).
    """
    near = cKDTree(positions).query_ball_point(p, reach, return_sorted=True)
    if walls is None or not len(p):
        return [np.array(rows, int) for rows in near]
    out: list[np.ndarray] = []
    counts = np.array([len(rows) for rows in near], int)
    ends = np.cumsum(counts)
    for some in np.split(np.arange(len(p)), np.flatnonzero(np.diff(ends // AT_ONCE)) + 1):
        rows = np.concatenate([np.empty(0, int), *(np.array(near[k], int) for k in some)])
        free = ~walls.between(np.repeat(p[some], counts[some], axis=0), positions[rows])
        out += [
            part[kept]
            for part, kept in zip(
                *(np.split(each, np.cumsum(counts[some])[:-1]) for each in (rows, free))
            )
        ]
    return out


def _segment(path: str | Path, number: int, entry: Any) -> tuple[float, ...]:
    good = (
        isinstance(entry, list)
        and len(entry) in (4, 5)
        and all(type(value) in (int, float) for value in entry)
    )
    if not good or entry[:2] == entry[2:4]:
        raise InputError(
            f"{path}: walls: number {number} is {entry!r}, which is no wall from one point to "
            f"another; {WALLS_FORM}."
        )
    return (*map(float, entry[:4]), float(entry[4]) if len(entry) == 5 else np.inf)
