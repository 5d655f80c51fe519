# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a simulated flight is, one frozen record; its anchors, walls, and the room that they span."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, make_dataclass, replace
from functools import partial
from pathlib import Path
import re
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.arrays import numbers_of
from uwb_tdoa_bias.common.errors import InputError, refuse_others
from uwb_tdoa_bias.common.safe_yaml import read_yaml
from uwb_tdoa_bias.common.sensors import SENSORS

from ..choices import PROTOCOLS, YAW_PROFILES

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


MOST_HEARD = 64  # largest number of anchors that a tag hears at once
WHEELS_RATE = 50.0  # Hz
FARTHEST = 1e5  # m, of a point of a path
VEHICLE_DEFAULTS = MappingProxyType(
    {  # the usual configuration of each vehicle
        "quadrotor": {},
        "rover": {
            "constellation": "six_wide",
            "speed": 0.8,
            "protocol": "tdoa3",
            "tdoa_rate": 100.0,
            "imu_rate": 100.0,
            "truth_rate": 50.0,
            "tag_lever_arm": (0.1, 0.0, 0.4),
            "velocity_noise": 0.02,
            "wheel_scale": 0.02,
            "wheel_slip": 0.2,
        },
        "hand": {"height": 1.1, "imu_rate": 100.0, "truth_rate": 50.0, "yaw": "along_track"},
    }
)
# A SimulationConfig as `complete` returns it: place, height, radius and anchors are not None
Complete = Any
NOISES = tuple(f"{name}_noise" for name in SENSORS)


@dataclass(frozen=True)
class ImuErrors:
    """Errors of an inertial sensor: white noise, a bias with a random walk, and vibration.

    This is the error model of the filter. Defaults fit the MEMS sensor of a small quadrotor (BMI088
    data sheet, rounded up).

    Attributes
    ----------
    gyro_noise : white noise density, rad/s/sqrt(Hz) (default 3e-4)
    accel_noise : white noise density, m/s^2/sqrt(Hz) (default 2e-3)
    gyro_bias_walk : random walk density of the bias, rad/s^2/sqrt(Hz) (default 1e-5)
    accel_bias_walk : random walk density of the bias, m/s^3/sqrt(Hz) (default 2e-4)
    gyro_bias : standard deviation of each axis of the initial bias, rad/s (default 5e-3)
    accel_bias : standard deviation of each axis of the initial bias, m/s^2 (default 5e-2)
    vibration : standard deviation of a further white noise on the accelerometer while the motors
        run, m/s^2 (default 0: off)
    """

    gyro_noise: float = 3e-4
    accel_noise: float = 2e-3
    gyro_bias_walk: float = 1e-5
    accel_bias_walk: float = 2e-4
    gyro_bias: float = 5e-3
    accel_bias: float = 5e-2
    vibration: float = 0.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (np.isfinite(value) and value >= 0.0):
                raise InputError(
                    f"imu_errors: {name}: {value!r} is not a finite number of at least 0."
                )


NO_IMU_ERRORS = ImuErrors(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


_Noises: Any = make_dataclass(  # one attribute per sensor
    "_Noises", [(name, float | None, None) for name in NOISES], frozen=True
)


@dataclass(frozen=True)
class SimulationConfig(_Noises):
    """One simulated flight.

    The same config gives the same flight, bit for bit. Every part draws from a stream of random
    numbers, so switching an error off leaves the others unchanged. Raises InputError for values
    that cannot be simulated.

    The room and the path
    ---------------------
    seed : of all random streams, 0 or more (default 0)
    vehicle : "quadrotor" takes off, flies and lands; "rover" drives on the floor, x ahead, with
        stops; "hand": a person carries the tag, and stands still before and after. `of` gives each
        its usual sensors (default "quadrotor")
    path : ((x, y), ...) or ((x, y, z), ...) m, waypoints, instead of a trajectory (default None)
    poses : ((t, x, y, z, yaw), ...) s, m, rad, a timed path instead of a trajectory, as `diagnose`
        plans it (default None)
    area : ((x, y), (x, y)) m, lower and upper corner of the area for trajectories (default None:
        the room less a clearance)
    constellation : name of an anchor constellation, or random-SEED[-COUNT] (default "corners": 8 in
        7 x 8 x 3 m)
    anchors : Anchors to use instead of a named constellation (default None)
    trajectory : "circle", "rising_circle", "sines", "square", "line_x", "line_y", "hover" or "spin"
        (default "sines")
    duration : of the recording, s (default 60)
    speed : along the path at cruise, m/s; root mean square for sines (default 1)
    place : (x, y) of the middle of the path, m (default None: the middle of the room or the area)
    height : of the path, m; not used by sines of a quadrotor (default None: half the flyable
        height)
    radius : of the circle, or half the side of the square or the line, m (default None: 70 % of the
        largest)
    yaw : "fixed", "along_track" or "rotating"; spin always rotates; a rover has no choice (default
        "fixed")
    yaw_angle : yaw at the start, or added to the track, rad (default 0)
    yaw_rate : while rotating, rad/s (default 0.5)
    floor_time : at rest on the floor before take-off and after landing, s (default 3)
    start_in_air : start and end on the path, in the air (default False: take off and land)

    The inertial sensor and the truth
    ---------------------------------
    imu_rate : samples per second, Hz (default 1000)
    imu_errors : ImuErrors; NO_IMU_ERRORS for a perfect sensor (default: a small quadrotor's MEMS
        sensor)
    truth_rate : ground-truth poses per second, Hz (default 250)

    The TDOA measurements
    ---------------------
    protocol : "tdoa2" (ring, about 475 per second) or "tdoa3" (any pair, about 240 per second)
        (default "tdoa2")
    tdoa_rate : TDOAs per second (default None: as the protocol)
    radio_reach : m; the tag does not hear anchors farther away (default None: all are heard)
    walls : Walls that block signals, with radio_reach (default None)
    cell_ids : anchors with the same id // cell_ids form a cell with a common clock. A TDOA needs
        two anchors of a cell; with radio_reach (default None: all anchors have one clock)
    noise_std : standard deviation of the white noise of one TDOA, m; 0 for none (default 0.06)
    anchor_noise_std : standard deviation of the arrival noise of each anchor, m, in the order of
        the anchors. A TDOA has the root of the summed squares of its two (default None: noise_std /
        sqrt(2) for every anchor)
    shared_noise : two TDOAs made from the same reception share its noise, as in Grasso et al.
        (Sensors 2022, 22, 9136), eqs. 4 - 5 (default False: independent noise)
    bias : received-power and antenna errors, which depend on the poses, and the anchors' delays
        (default True)
    anchor_delay_std : spread of the constant delays of the anchors after calibration, m (default
        0.05)
    tag_unit : specimen of the tag. 0 is nominal; other specimens have seeded small differences in
        gain (0.7 dB) and mounting (2 degrees) (default 0)
    tag_lever_arm : tag antenna in the body frame, m (default (0, 0, 0))
    multipath : late arrivals near the floor (default True)
    outlier_probability : share of TDOAs that are outliers, 0 for none (default 0.01)

    Other sensors
    -------------
    <name>_noise : for each of SENSORS, standard deviation in its unit (default None: no sensor)
    wheel_scale : of a rover, relative excess of its velocities and yaw rates (default 0)
    wheel_slip : of a rover, relative excess while its wheels slip, for half a second every ten
        (default 0)
    """

    seed: int = 0
    vehicle: str = "quadrotor"
    path: tuple[tuple[float, ...], ...] | None = None
    poses: tuple[tuple[float, ...], ...] | None = None
    area: tuple[tuple[float, ...], ...] | None = None
    constellation: str = "corners"
    anchors: Anchors | None = None
    trajectory: str = "sines"
    duration: float = 60.0
    speed: float = 1.0
    place: tuple[float, float] | None = None
    height: float | None = None
    radius: float | None = None
    yaw: str = "fixed"
    yaw_angle: float = 0.0
    yaw_rate: float = 0.5
    floor_time: float = 3.0
    start_in_air: bool = False
    imu_rate: float = 1000.0
    imu_errors: ImuErrors = field(default_factory=ImuErrors)
    truth_rate: float = 250.0
    protocol: str = "tdoa2"
    tdoa_rate: float | None = None
    radio_reach: float | None = None
    walls: Walls | None = None
    cell_ids: int | None = None
    noise_std: float = 0.06
    anchor_noise_std: tuple[float, ...] | None = None
    shared_noise: bool = False
    bias: bool = True
    anchor_delay_std: float = 0.05
    tag_unit: int = 0
    tag_lever_arm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    multipath: bool = True
    outlier_probability: float = 0.01
    wheel_scale: float = 0.0
    wheel_slip: float = 0.0

    @classmethod
    def of(cls, vehicle: str, **given: Any) -> SimulationConfig:
        """Return the usual config of a vehicle with the given changes."""
        return cls(vehicle=vehicle, **{**VEHICLE_DEFAULTS.get(vehicle, {}), **given})

    def __post_init__(self) -> None:
        for name, choices in (
            ("vehicle", tuple(VEHICLE_DEFAULTS)),
            ("yaw", YAW_PROFILES),
            ("protocol", PROTOCOLS),
        ):
            refuse_others(name, [getattr(self, name)], choices)
        for name in ("seed", "tag_unit"):
            value = getattr(self, name)
            if not (isinstance(value, (int, np.integer)) and 0 <= value < 2**32):
                raise InputError(f"{name}: {value!r} is not a whole number from 0 to 4294967295.")
        if self.cell_ids is not None and not (
            isinstance(self.cell_ids, (int, np.integer)) and self.cell_ids >= 2
        ):
            raise InputError(
                f"cell_ids: {self.cell_ids!r} is not a whole number of at least 2; give how "
                "many ids each cell may use, e.g. 256."
            )
        for name in ("walls", "cell_ids"):
            if getattr(self, name) is not None and self.radio_reach is None:
                raise InputError(
                    f"{name}: says which anchors are heard together where not all are; give "
                    "radio_reach too."
                )
        for name, lowest, highest in (
            ("duration", 1.0, 3600.0),
            ("speed", 0.01, 20.0),
            ("radius", 0.05, 1000.0),
            ("height", -1000.0, 1000.0),
            ("yaw_angle", -1000.0, 1000.0),
            ("yaw_rate", -10.0, 10.0),
            ("floor_time", 0.0, 3600.0),
            ("imu_rate", 50.0, 10000.0),
            ("truth_rate", 1.0, 10000.0),
            ("tdoa_rate", 1.0, 500.0),
            ("radio_reach", 0.1, 10000.0),
            ("noise_std", 0.0, 100.0),
            ("anchor_delay_std", 0.0, 100.0),
            ("outlier_probability", 0.0, 1.0),
            ("wheel_scale", -0.5, 0.5),
            ("wheel_slip", 0.0, 10.0),
            *((noise, 0.0, 100.0) for noise in NOISES),
        ):
            value = getattr(self, name)
            if value is not None and not lowest <= value <= highest:
                raise InputError(f"{name}: {value!r} is outside {lowest:g} ... {highest:g}.")
        for name, length in (("place", 2), ("tag_lever_arm", 3)):
            value = getattr(self, name)
            if value is not None and not (
                np.shape(value) == (length,) and np.isfinite(value).all()
            ):
                raise InputError(f"{name}: {value!r} is not {length} finite numbers of metres.")
        for wrong, said in (
            (
                self.path is not None
                and not (_are_points(self.path, (2, 3)) and len({*self.path}) >= 2),
                f"path: {self.path!r} is not two different points or more, each x, y or x, y, "
                "z in metres.",
            ),
            (
                self.poses is not None
                and not (
                    _are_points(self.poses, (5,))
                    and len(self.poses) >= 2
                    and (np.diff([pose[0] for pose in self.poses]) > 0.0).all()
                ),
                "poses: expected two or more rows t, x, y, z, yaw (s, m, rad) with rising t.",
            ),
            (
                self.area is not None
                and not (
                    _are_points(self.area, (2,))
                    and len(self.area) == 2
                    and all(low < high for low, high in zip(*self.area))
                ),
                f"area: {self.area!r} is not a lower and an upper corner, each x, y in metres.",
            ),
        ):
            if wrong:
                raise InputError(said)

    def complete(self) -> tuple[Complete, Room]:
        """Return (config, Room); place, height, radius, anchors and anchor_noise_std are filled in."""
        anchors = self.anchors if self.anchors is not None else constellation(self.constellation)
        if len(anchors) < 2:
            raise InputError(f"anchors: {len(anchors)} was given; the simulation takes 2 or more.")
        if len(anchors) > MOST_HEARD and self.radio_reach is None:
            raise InputError(
                f"anchors: {len(anchors)} were given, and each is heard everywhere; give "
                f"radio_reach, m, or at most {MOST_HEARD} of them."
            )
        if self.bias and not np.isfinite(anchors.orientations).all():
            lost = anchors.ids[~np.isfinite(anchors.orientations).all(axis=1)][0]
            raise InputError(
                f"anchors: anchor {lost} has no orientation, on which its bias depends; add "
                "it or switch bias off."
            )
        given = self.anchor_noise_std
        std = (
            np.full(len(anchors), self.noise_std / np.sqrt(2.0))
            if given is None
            else np.asarray(given, dtype=float)
        )
        if std.shape != (len(anchors),) or not (np.isfinite(std).all() and (std >= 0.0).all()):
            raise InputError(
                f"anchor_noise_std: {self.anchor_noise_std!r} is not {len(anchors)} numbers "
                "of at least 0, in metres."
            )
        room = room_of(anchors)
        if self.area is not None:
            room = replace(room.around(np.array(self.area)), area=self.area)
        height = self.height
        if self.path is not None:
            room = room.around(np.array(self.path))
            height = self.path[0][2] if height is None and len(self.path[0]) == 3 else height
        if self.poses is not None:
            room = room.around(np.array(self.poses)[:, 1:4])
            height = self.poses[0][3] if height is None else height
        low, high = room.path_box
        x, y = room.centre[:2] if self.place is None else self.place
        place = float(x), float(y)
        reach = min(np.min(high[:2] - place), np.min(np.asarray(place) - low[:2]))
        filled = replace(
            self,
            anchors=anchors,
            place=place,
            height=float(0.5 * (low[2] + high[2])) if height is None else height,
            radius=float(max(0.7 * reach, 0.05)) if self.radius is None else self.radius,
            anchor_noise_std=tuple(std.tolist()),
        )
        return filled, room

    def random(self, part: str) -> np.random.Generator:
        """Return the numpy Generator of the named part of the simulation."""
        return np.random.default_rng([self.seed, *part.encode()])

    def as_dict(self) -> dict[str, Any]:
        """Return plain values for Flight.meta and JSON; anchors by their ids."""
        content = asdict(replace(self, anchors=None))
        content["anchors"] = None if self.anchors is None else self.anchors.ids.tolist()
        content["walls"] = (
            None
            if self.walls is None
            else [[x for x in wall if x < np.inf] for wall in self.walls.segments]
        )
        return content


def _are_points(points: Any, lengths: tuple[int, ...]) -> bool:
    """Return whether these are points with equally many finite coordinates."""
    array = numbers_of(points)
    return array.ndim == 2 and array.shape[1] in lengths and bool((np.abs(array) < FARTHEST).all())
