# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What a simulated flight is: one frozen record."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, make_dataclass, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors import SENSORS

from ..choices import PROTOCOLS, YAW_PROFILES
from .rooms import Room, Walls, constellation, room_of

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
            if getattr(self, name) not in choices:
                raise InputError(
                    f"{name}: {getattr(self, name)!r} is not known; choose {', '.join(choices)}."
                )
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
        if self.path is not None and not (
            _are_points(self.path, (2, 3)) and len({*self.path}) >= 2
        ):
            raise InputError(
                f"path: {self.path!r} is not two different points or more, each x, y or x, y, "
                "z in metres."
            )
        if self.poses is not None and not (
            _are_points(self.poses, (5,))
            and len(self.poses) >= 2
            and (np.diff([pose[0] for pose in self.poses]) > 0.0).all()
        ):
            raise InputError(
                "poses: expected two or more rows t, x, y, z, yaw (s, m, rad) with rising t."
            )
        if self.area is not None:
            good = _are_points(self.area, (2,)) and len(self.area) == 2
            if not good or not all(low < high for low, high in zip(*self.area)):
                raise InputError(
                    f"area: {self.area!r} is not a lower and an upper corner, each x, y in metres."
                )

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
    try:
        array = np.array(points, dtype=float)
    except (TypeError, ValueError):
        return False
    return array.ndim == 2 and array.shape[1] in lengths and bool((np.abs(array) < FARTHEST).all())
