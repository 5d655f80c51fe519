# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulate a small quadrotor: rigid body, motors, drag, wind, and ground contact.

The rigid body follows Newton and Euler. Thrust and yaw moment grow with the square of the rotor
speed. Rotor drag grows with the rotor speed and the air speed. The values are from Foerster, System
Identification of the Crazyflie 2.0 Nano Quadrocopter, ETH 2015, as in rotorpy. Motors are first-order
lags. The ground effect follows Cheeseman and Bennett (ARC R&M 3021, 1955). Feet are springs with
dampers and Coulomb friction.

Frames: world z up; body x forward, y left, z up. Quaternions are x y z w, body to world.

The World of a flight has radio, inertial sensor and further sensors. Their errors that do not depend on the path
are drawn in advance, by seed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from functools import cached_property
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.compiled import Record, compiled
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.geometry import rotate
from uwb_tdoa_bias.common.sensors import SENSORS, Stream
from uwb_tdoa_bias.effects import EFFECTS, EffectSet, Samples
from uwb_tdoa_bias.effects.floor import FloorMultipath
from uwb_tdoa_ekf.results import rows_of

from ..choices import MOMENTS
from ..simulation.config import ImuErrors, corners
from ..simulation.inject import parse_effect
from ..simulation.sensors import make_schedule, outliers, tdoa_noise

GRAVITY = 9.81  # m/s^2
STEP = 0.625e-3  # s, of the integration (midpoint)
IMU_RATE = 400.0  # Hz
ROTORS = 4
POSITION, VELOCITY, ATTITUDE, RATE, SPEED = (
    slice(0, 3),
    slice(3, 6),
    slice(6, 10),
    slice(10, 13),
    slice(13, 17),
)  # of a state
STATE = 17  # numbers in it: m, m/s, x y z w, rad/s in the body frame, rad/s of each rotor
# directions of arms, body frame
CORNERS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]]) * math.sqrt(0.5)
SPIN = np.array([1.0, -1.0, 1.0, -1.0])  # sign of the yaw moment on the body


@dataclass(frozen=True)
class Vehicle:
    """Describe a Crazyflie 2.x with its deck.

    Parameters
    ----------
    mass : float
        kg.
    inertia_xy, inertia_z : float
        kg m^2.
    arm : float
        From the center to each rotor, m.
    thrust, moment : float
        Thrust, N/(rad/s)^2, and yaw moment, Nm/(rad/s)^2, of a rotor.
    rotor_drag, inflow : float
        Drag of a rotor across and along the z axis of the body, N/(rad/s)/(m/s).
    motor_time, top_speed : float
        Time constant, s, and largest speed, rad/s, of a motor.
    radius : float
        Of a rotor for the ground effect, m. 0 switches the effect off.
    leg : float
        From the center down to the feet, m.
    stiffness, damping, friction_damping : float
        Of a foot, N/m, N/(m/s) and N/(m/s).
    friction : float
        Coefficient of friction.
    table, table_x, table_y, table_radius : float
        Height above the floor, place and radius of a round table, m. A radius of 0 means no table.
    """

    mass: float = 0.030
    inertia_xy: float = 1.43e-5
    inertia_z: float = 2.89e-5
    arm: float = 0.043
    thrust: float = 2.3e-8
    moment: float = 7.8e-10
    rotor_drag: float = 10.2506e-7
    inflow: float = 7.553e-7
    motor_time: float = 0.072
    top_speed: float = 2500.0
    radius: float = 0.023
    leg: float = 0.03
    stiffness: float = 60.0
    damping: float = 0.6
    friction_damping: float = 0.5
    friction: float = 0.6
    table: float = 0.0
    table_x: float = 0.0
    table_y: float = 0.0
    table_radius: float = 0.0

    def record(self) -> Record:
        """Return the parameters as a record for compiled code."""
        return np.array([tuple(asdict(self).values())], RECORD)[0]

    def at_rest(self, x: float, y: float, yaw: float) -> np.ndarray:
        """Return the state (17,) of a vehicle that stands on the ground or the table.

        Parameters
        ----------
        x, y : float
            Place, m.
        yaw : float
            rad.
        """
        state = np.zeros(STATE)
        sag = self.mass * GRAVITY / (ROTORS * self.stiffness)
        state[POSITION] = x, y, ground_at(self.record(), x, y) + self.leg - sag
        state[ATTITUDE] = 0.0, 0.0, math.sin(0.5 * yaw), math.cos(0.5 * yaw)
        return state


RECORD = np.dtype([(field.name, float) for field in fields(Vehicle)], align=True)


@compiled
def ground_at(record: Record, x: float, y: float) -> float:
    """Return the height of the ground or the table at (x, y), m."""
    if (
        record.table_radius > 0.0
        and math.hypot(x - record.table_x, y - record.table_y) <= record.table_radius
    ):
        return record.table
    return 0.0


@compiled
def step(
    state: np.ndarray,
    speeds: np.ndarray,
    wind: np.ndarray,
    dt: float,
    record: Record,
    scratch: np.ndarray,
) -> int:
    """Integrate the state over one time step and return the number of feet on the ground.

    Parameters
    ----------
    state : numpy.ndarray
        State (17,), updated in place.
    speeds : numpy.ndarray
        Commanded rotor speeds (4,), rad/s.
    wind : numpy.ndarray
        Wind (3,), m/s, world frame.
    dt : float
        Time step, s.
    record : Record
        Record of a Vehicle.
    scratch : numpy.ndarray
        Working memory (2, 17).
    """
    _derivative(state, speeds, wind, record, scratch[0])
    for k in range(STATE):
        scratch[1, k] = state[k] + 0.5 * dt * scratch[0, k]
    feet = _derivative(scratch[1], speeds, wind, record, scratch[0])
    for k in range(STATE):
        state[k] += dt * scratch[0, k]
    length = math.sqrt(state[6] ** 2 + state[7] ** 2 + state[8] ** 2 + state[9] ** 2)
    for k in range(6, 10):
        state[k] /= length
    return feet


@compiled
def _derivative(
    state: np.ndarray, speeds: np.ndarray, wind: np.ndarray, record: Record, out: np.ndarray
) -> int:
    """Write the time derivative of a state to `out` (17,) and return the number of feet on the ground."""
    q, w = state[6:10], state[10:13]
    # columns of the rotation matrix: axes of the body in the world frame
    x, y, z, s = q[0], q[1], q[2], q[3]
    r00, r01, r02 = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * s), 2.0 * (x * z + y * s)
    r10, r11, r12 = 2.0 * (x * y + z * s), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * s)
    r20, r21, r22 = 2.0 * (x * z - y * s), 2.0 * (y * z + x * s), 1.0 - 2.0 * (x * x + y * y)
    ax, ay, az = state[3] - wind[0], state[4] - wind[1], state[5] - wind[2]
    air_x, air_y, air_z = (
        r00 * ax + r10 * ay + r20 * az,
        r01 * ax + r11 * ay + r21 * az,
        r02 * ax + r12 * ay + r22 * az,
    )
    fx, fy, fz = 0.0, 0.0, 0.0  # force and moment, body frame
    mx, my, mz = 0.0, 0.0, 0.0
    world_x, world_y, world_z = 0.0, 0.0, -GRAVITY * record.mass  # force, world frame
    feet = 0
    for k in range(ROTORS):
        px, py = record.arm * CORNERS[k, 0], record.arm * CORNERS[k, 1]
        speed = state[13 + k]
        lift = record.thrust * speed * speed
        height = state[2] + r20 * px + r21 * py - ground_at(record, state[0], state[1])
        if record.radius > 0.0:
            share = record.radius / (4.0 * max(height, record.radius))
            lift /= 1.0 - share * share
        hx = -record.rotor_drag * speed * (air_x - w[2] * py)
        hy = -record.rotor_drag * speed * (air_y + w[2] * px)
        hz = -record.inflow * speed * (air_z + w[0] * py - w[1] * px)
        fx += hx
        fy += hy
        fz += lift + hz
        mx += py * (lift + hz)
        my -= px * (lift + hz)
        mz += px * hy - py * hx + SPIN[k] * record.moment * speed * speed
        out[13 + k] = (min(max(speeds[k], 0.0), record.top_speed) - speed) / record.motor_time

        foot_z = height - r22 * record.leg
        if foot_z < 0.0:
            feet += 1
            # velocity of the foot: v + R (w x foot), foot = (px, py, -leg)
            bx, by, bz = (
                -w[1] * record.leg - w[2] * py,
                w[2] * px + w[0] * record.leg,
                w[0] * py - w[1] * px,
            )
            vx = state[3] + r00 * bx + r01 * by + r02 * bz
            vy = state[4] + r10 * bx + r11 * by + r12 * bz
            vz = state[5] + r20 * bx + r21 * by + r22 * bz
            normal = max(0.0, -record.stiffness * foot_z - record.damping * vz)
            slip = math.hypot(vx, vy)
            rub = min(record.friction_damping, record.friction * normal / max(slip, 1e-9))
            gx, gy, gz = -rub * vx, -rub * vy, normal
            world_x += gx
            world_y += gy
            world_z += gz
            cx, cy, cz = (
                r00 * gx + r10 * gy + r20 * gz,
                r01 * gx + r11 * gy + r21 * gz,
                r02 * gx + r12 * gy + r22 * gz,
            )
            mx += py * cz + record.leg * cy
            my += -record.leg * cx - px * cz
            mz += px * cy - py * cx
    out[0], out[1], out[2] = state[3], state[4], state[5]
    out[3] = (world_x + r00 * fx + r01 * fy + r02 * fz) / record.mass
    out[4] = (world_y + r10 * fx + r11 * fy + r12 * fz) / record.mass
    out[5] = (world_z + r20 * fx + r21 * fy + r22 * fz) / record.mass
    out[6] = 0.5 * (s * w[0] + y * w[2] - z * w[1])
    out[7] = 0.5 * (s * w[1] + z * w[0] - x * w[2])
    out[8] = 0.5 * (s * w[2] + x * w[1] - y * w[0])
    out[9] = 0.5 * (-x * w[0] - y * w[1] - z * w[2])
    ixy, iz = record.inertia_xy, record.inertia_z
    out[10] = (mx - (iz - ixy) * w[1] * w[2]) / ixy
    out[11] = (my - (ixy - iz) * w[2] * w[0]) / ixy
    out[12] = mz / iz
    return feet


@compiled
def specific_force(before: np.ndarray, after: np.ndarray, dt: float, out: np.ndarray) -> None:
    """Compute the mean specific force between two states.

    Parameters
    ----------
    before, after : numpy.ndarray
        States (17,).
    dt : float
        Time between them, s.
    out : numpy.ndarray
        Specific force (3,), m/s^2, body frame of `after`. It is written.
    """
    back = np.array([-after[6], -after[7], -after[8], after[9]])
    a = (after[3:6] - before[3:6]) / dt
    a[2] += GRAVITY
    rotate(back, a, out)


# of a flight; a circle of no radius is hovering
LONGEST_SILENCE = 60.0  # s


@dataclass(frozen=True)
class World:
    """Describe a hall, its radio, its air and the sensors of the vehicle.

    Lengths are in m, times in s and rates in Hz unless stated otherwise.

    Parameters
    ----------
    size : tuple
        Size of the hall. Low anchors are at 0.18 m.
    low_first : bool
        Ids 0 to 3 are the low anchors. Otherwise low and high alternate, as in the measured flights.
    floor_effect : bool
        Low anchors are late while the tag is near the floor (effect floor_multipath).
    protocol, rate
        Of the TDOAs.
    noise : float
        Standard deviation of a TDOA.
    outlier_share, outlier_size : float
        Share and largest size of wrong TDOAs. A size of 0 draws the three kinds of physics.
    installation : int, optional
        Seed of the hall: delays, biases, floor. None takes the seed of the flight.
    delay : float
        Standard deviation of the constant delays of anchors.
    bearing_bias : float
        Largest amplitude of a bias over the bearing, with two waves per turn.
    silence : tuple, optional
        (one of MOMENTS, duration) of a gap in the TDOAs.
    person : bool
        A person walks through the hall and blocks signals.
    change : str
        "silent" or "late": change of one random anchor from the middle of the path. "" for none.
    effects : EffectSet
        Further effects, added as by `inject`.
    latency, jitter : float
        Least delay of all messages, and mean of an additional delay.
    imu : ImuErrors
    vibration : tuple
        Root mean square of the accelerometer vibration per axis while rotors turn, m/s^2.
    vibration_band : float
        Largest frequency of the vibration. 0 means white noise.
    rectified : float
        Accelerometer offset while rotors turn, in units of the vibration.
    gust : float
        Standard deviation of the wind along each axis, m/s.
    table : float
        Height of a round table of 0.4 m radius at the start. 0 for none.
    sensors : tuple of str
        Further sensors, names of SENSORS, e.g. "height" (a range finder along -z of the body).
    """

    size: tuple[float, float, float] = (6.4, 6.2, 3.0)
    low_first: bool = False
    floor_effect: bool = True
    protocol: str = "tdoa2"
    rate: float = 360.0
    noise: float = 0.08
    outlier_share: float = 0.03
    outlier_size: float = 2.5
    installation: int | None = None
    delay: float = 0.1
    bearing_bias: float = 0.12
    silence: tuple[str, float] | None = None
    person: bool = False
    change: str = ""
    effects: EffectSet = EffectSet()
    latency: float = 0.0
    jitter: float = 0.0
    imu: ImuErrors = field(default_factory=ImuErrors)
    vibration: tuple[float, float, float] = (0.6, 0.6, 0.6)
    vibration_band: float = 0.0
    rectified: float = 0.0
    gust: float = 0.0
    table: float = 0.0
    sensors: tuple[str, ...] = ()

    @cached_property
    def anchors(self) -> Anchors:
        """Return the anchors: a low and a high one in each corner."""
        made = corners(*self.size)
        if not self.low_first:
            return made
        order = np.argsort(made.positions[:, 2], kind="stable")
        return Anchors(made.ids, made.positions[order], made.orientations[order], made.frame)


HALL = World()
WORLDS = {
    "hall": HALL,
    "no-floor-effect": replace(HALL, floor_effect=False),
    "low-first": replace(HALL, low_first=True),
    "outliers": replace(HALL, outlier_share=0.1),
    "three-kinds": replace(HALL, outlier_share=0.1, outlier_size=0.0),
    "person": replace(HALL, person=True),
    "anchor-silent": replace(HALL, change="silent"),
    "anchor-late": replace(HALL, change="late"),
    "silence-1s": replace(HALL, silence=("anywhere", 1.0)),
    "silence-3s": replace(HALL, silence=("circle", 3.0)),
    "latency": replace(HALL, latency=0.05),
    "jitter": replace(HALL, latency=0.01, jitter=0.01),
    "tdoa3": replace(HALL, protocol="tdoa3", rate=240.0),
    "gusts": replace(HALL, gust=0.5),
    # values of the flights of 0426
    "measured-vibration": replace(HALL, vibration=(0.4, 0.5, 0.35), vibration_band=30.0),
    # values of the flights of 0425
    "rectifying": replace(HALL, vibration=(3.4, 2.0, 0.55), vibration_band=30.0, rectified=1.0),
    "table": replace(HALL, table=0.75),
}


def world_of(
    name: str,
    floor_effect: bool | None = None,
    sensors: Iterable[str] = (),
    silence: str | None = None,
    injected: Iterable[Sequence[str]] = (),
    installation: int | None = None,
) -> World:
    """Return a world of WORLDS with the changes that options ask for.

    Parameters
    ----------
    name : str
    floor_effect : bool, optional
    sensors : iterable of str
    silence : str, optional
        "MOMENT:S".
    injected : iterable
        Lists of an effect and its "KEY=NUMBER" texts.
    installation : int, optional

    Raises
    ------
    InputError
        If `silence` or `injected` cannot be read.
    """
    changed: dict[str, Any] = {
        "sensors": tuple(dict.fromkeys(sensors)),
        "installation": installation,
    }
    if floor_effect is not None:
        changed["floor_effect"] = floor_effect
    if silence is not None:
        changed["silence"] = _moment(silence)
    effects = []
    for effect, *values in injected:
        if effect not in EFFECTS or not values:
            raise InputError(
                f"--inject: {effect!r} needs the name of an effect and KEY=NUMBER; inject "
                "--list shows them."
            )
        effects.append(parse_effect(effect, values))
    return replace(WORLDS[name], effects=EffectSet(tuple(effects)), **changed)


def _moment(text: str) -> tuple[str, float]:
    """Return (moment, duration in s) of "MOMENT:S"."""
    moment, _, seconds = text.partition(":")
    try:
        length = float(seconds)
    except ValueError:
        length = math.nan
    if moment not in MOMENTS or not 0.0 < length <= LONGEST_SILENCE:
        raise InputError(
            f"--silence: {text!r} is not MOMENT:S, where MOMENT is one of "
            f"{', '.join(MOMENTS)}, and S at most {LONGEST_SILENCE:g} s."
        )
    return moment, length


NEAR_FLOOR = 0.5  # m, largest height at which the floor acts
FLOOR_DELAY, FLOOR_HEIGHT = (3.0, 3.9), (0.06, 0.2)  # m, of low anchors, and up to which height
CHANGED_DELAY = 0.3  # m, of an anchor that becomes late
LOW = 1.0  # m, largest height of a low anchor
GUST_TIME = 1.0  # s, correlation time of gusts
PERSON = 0.25, 1.8, 1.0  # m, radius and height of a person; m/s
# m, delay behind a person; s, between draws of it
BLOCKED, BLOCK_TIME = ((0.2, 2.0), 0.5)
NEVER = np.inf, np.inf


def random(seed: int, part: str) -> np.random.Generator:
    """Return the random generator of one named part of a flight."""
    return np.random.default_rng([seed, *part.encode()])


class Radio:
    """Simulate the TDOAs of one flight.

    Attributes
    ----------
    t, a, b : numpy.ndarray
        Stamps (n,), s, and rows of both anchors (n,).
    silent : tuple
        Begin and end of a gap, s.
    changed, other
        Time, s, from which anchor row `other` is silent or late.
    """

    def __init__(self, world: World, seed: int, duration: float) -> None:
        """Draw schedule, noise, delays and outliers.

        Parameters
        ----------
        world : World
        seed : int
        duration : float
            s.
        """
        anchors = world.anchors
        self.positions, n = anchors.positions, len(anchors)
        schedule = make_schedule(world.protocol, n, duration, random(seed, "schedule"), world.rate)
        self.t, self.a, self.b = schedule.t, schedule.a, schedule.b
        self.silent = NEVER
        self.changed = np.inf
        self.other = int(random(seed, "change").integers(n))
        self._world = world
        rng = random(seed if world.installation is None else world.installation, "anchors")
        self._error = tdoa_noise(
            schedule, np.full(n, world.noise / math.sqrt(2.0)), False, random(seed, "tdoa noise")
        )
        self._error += _outliers(world, len(self.t), random(seed, "outliers"))
        # per anchor: constant delay; amplitude and phase of the bearing bias
        self.constants = np.stack(
            [
                world.delay * rng.standard_normal(n),
                world.bearing_bias * rng.random(n),
                2.0 * np.pi * rng.random(n),
            ],
            axis=1,
        )
        late, height = rng.uniform(*FLOOR_DELAY, n), rng.uniform(*FLOOR_HEIGHT, n)
        low = anchors.ids[self.positions[:, 2] < LOW].tolist() if world.floor_effect else ()
        self.floor = FloorMultipath(
            {
                f"{i}.{part}": of[anchors.index(i)]
                for i in low
                for part, of in (("delay", late), ("height", height))
            }
        )
        self._anchors, self._at_times = anchors, random(seed, "floor").random((len(self.t), 2))
        self._way = (
            _person_path(world, duration, random(seed, "person"))
            if world.person
            else np.empty((0, 2))
        )
        self._blocked = random(seed, "blocked").uniform(
            *BLOCKED, (int(duration / BLOCK_TIME) + 1, n)
        )

    def schedule_faults(self, silent: float, changed: float) -> None:
        """Set the begin of the gap and of the anchor change.

        Parameters
        ----------
        silent, changed : float
            s.
        """
        self.silent = (silent, silent + self._world.silence[1]) if self._world.silence else NEVER
        self.changed = changed

    def measured(self, rows: slice, p: np.ndarray) -> np.ndarray:
        """Return TDOAs (k,), m, with NaN where no TDOA is received.

        Parameters
        ----------
        rows : slice
            Rows of `t`.
        p : numpy.ndarray
            Tag positions (k, 3), m.
        """
        t, a, b, d = self.t[rows], self.a[rows], self.b[rows], np.empty(len(p))
        _measure(p, a, b, self.positions, self.constants, d)
        d += self._error[rows]
        if self.floor.values and p[:, 2].min(initial=NEAR_FLOOR) < NEAR_FLOOR:
            d += self._near_floor(rows, p)
        if len(self._way):
            late = self._blocked[(t / BLOCK_TIME).astype(int)]
            person = self._way[(t * IMU_RATE).astype(int)]
            for anchor, sign in ((b, 1.0), (a, -1.0)):
                through = _blocked(p, self.positions[anchor], person)
                d += sign * np.where(through, late[np.arange(len(t)), anchor], 0.0)
        mine = (t >= self.changed) & ((a == self.other) | (b == self.other))
        if self._world.change == "late":
            d += np.where(mine, np.where(b == self.other, 1.0, -1.0) * CHANGED_DELAY, 0.0)
        elif self._world.change == "silent":
            d[mine] = np.nan
        d[(t >= self.silent[0]) & (t < self.silent[1])] = np.nan
        return d

    def _near_floor(self, rows: slice, p: np.ndarray) -> np.ndarray:
        """Return the error (k,), m, near the floor. Each anchor is late with the probability of FloorMultipath."""
        t, a, b = self.t[rows], self.a[rows], self.b[rows]
        samples = Samples(t, a, b, p, np.full((len(p), 4), np.nan), self._anchors)
        both = np.concatenate([a, b])
        late = self.floor.of_each(self._anchors)[0][both]
        late = np.where(
            self._at_times[rows].T.ravel() * late < self.floor.delays(samples, both), late, 0.0
        )
        return late[len(p) :] - late[: len(p)]


@compiled
def _measure(
    p: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    positions: np.ndarray,
    constants: np.ndarray,
    out: np.ndarray,
) -> None:
    """Write TDOAs (k,), m, from geometry, constant delays and bearing biases `constants` (n, 3)."""
    for i in range(len(p)):
        out[i] = _apparent_distance(p[i], positions[b[i]], constants[b[i]]) - _apparent_distance(
            p[i], positions[a[i]], constants[a[i]]
        )


@compiled
def _apparent_distance(p: np.ndarray, anchor: np.ndarray, late: np.ndarray) -> float:
    """Return the distance to an anchor, m, with its delay and its bearing bias."""
    x, y, z = p[0] - anchor[0], p[1] - anchor[1], p[2] - anchor[2]
    return (
        math.sqrt(x * x + y * y + z * z)
        + late[0]
        + late[1] * math.sin(2.0 * math.atan2(y, x) + late[2])
    )


def _outliers(world: World, n: int, rng: np.random.Generator) -> np.ndarray:
    """Return the outliers (n,), m, and zero elsewhere."""
    if not world.outlier_size:
        return outliers(n, world.outlier_share, rng)
    return np.where(
        rng.random(n) < world.outlier_share,
        rng.uniform(-world.outlier_size, world.outlier_size, n),
        0.0,
    )


def _person_path(world: World, duration: float, rng: np.random.Generator) -> np.ndarray:
    """Return the path (n, 2), m, of a person who walks from wall to wall.

    There is one row per inertial sample.
    """
    half, stamps = 0.5 * np.array(world.size[:2]), [0.0]
    places: list[np.ndarray] = []
    while stamps[-1] <= duration:
        place = rng.uniform(-half, half)
        wall = rng.integers(2)
        place[wall] = math.copysign(half[wall], rng.standard_normal())
        if places:
            stamps.append(stamps[-1] + float(np.linalg.norm(place - places[-1])) / PERSON[2])
        places.append(place)
    t = np.arange(int(duration * IMU_RATE) + 2) / IMU_RATE
    return np.stack([np.interp(t, stamps, column) for column in np.transpose(places)], axis=1)


def _blocked(p: np.ndarray, anchor: np.ndarray, person: np.ndarray) -> np.ndarray:
    """Return whether a person at (k, 2) blocks the signal from an anchor (k, 3) to p (k, 3): (k,) bool."""
    way = anchor - p
    share = np.sum((person - p[:, :2]) * way[:, :2], axis=1) / np.maximum(
        np.sum(way[:, :2] ** 2, axis=1), 1e-9
    )
    nearest = p + np.clip(share, 0.0, 1.0)[:, None] * way
    return (np.linalg.norm(nearest[:, :2] - person, axis=1) < PERSON[0]) & (
        nearest[:, 2] < PERSON[1]
    )


class InertialErrors:
    """Draw the errors of the inertial sensor.

    Attributes
    ----------
    errors : numpy.ndarray
        Errors (n, 6) of rates, rad/s, and specific force, m/s^2.
    shaking : numpy.ndarray
        Vibration (n, 3), m/s^2, while rotors turn.
    """

    def __init__(self, world: World, seed: int, duration: float) -> None:
        """Draw biases, their random walks, noise and vibration for `duration`, s."""
        of, n, dt = world.imu, int(duration * IMU_RATE) + 1, 1.0 / IMU_RATE
        self.errors = np.empty((n, 6))
        for columns, name, start, walk, noise in (
            (slice(0, 3), "gyro", of.gyro_bias, of.gyro_bias_walk, of.gyro_noise),
            (slice(3, 6), "accel", of.accel_bias, of.accel_bias_walk, of.accel_noise),
        ):
            rng = random(seed, name)
            bias = start * rng.standard_normal(3) + np.cumsum(
                walk * math.sqrt(dt) * rng.standard_normal((n, 3)), axis=0
            )
            self.errors[:, columns] = bias + noise / math.sqrt(dt) * rng.standard_normal((n, 3))
        rng, band = random(seed, "vibration"), world.vibration_band
        self.shaking = rng.standard_normal((n, 3))
        if band:
            from scipy.signal import butter, lfilter  # takes a second to import

            self.shaking = lfilter(*butter(2, band, fs=IMU_RATE), self.shaking, axis=0)
            self.shaking /= self.shaking.std(axis=0)
        self.shaking = np.array(world.vibration) * (
            self.shaking + world.rectified * np.sign(rng.standard_normal(3))
        )


def gusts(world: World, seed: int, duration: float) -> np.ndarray:
    """Return the wind (n, 3), m/s, at each inertial sample.

    The wind is exponentially correlated over GUST_TIME.
    """
    from scipy.signal import lfilter  # takes a second to import

    n = int(duration * IMU_RATE) + 1
    decay = math.exp(-1.0 / (IMU_RATE * GUST_TIME))
    white = random(seed, "wind").standard_normal((n, 3))
    white[1:] *= math.sqrt(1.0 - decay**2)
    return world.gust * lfilter([1.0], [1.0, -decay], white, axis=0)


class AuxiliarySensor:
    """Simulate a further sensor of one flight by the simulation of its record in SENSORS.

    Attributes
    ----------
    t : numpy.ndarray
        Stamps (n,), s.
    """

    def __init__(self, name: str, world: World, seed: int, duration: float) -> None:
        """Draw stamps for `duration`, s; `name` is that of the sensor."""
        self._sensor, self._anchors = SENSORS[name], world.anchors
        self.t = np.arange(0.5, duration * self._sensor.rate) / self._sensor.rate
        self._random = random(seed, name)

    def measured(
        self, rows: slice, p: np.ndarray, q: np.ndarray, v: np.ndarray, ground: float
    ) -> Stream:
        """Return the measurements in a slice of rows.

        Parameters
        ----------
        rows : slice
            Rows of `t`.
        p, q, v : numpy.ndarray
            Position (k, 3) m, attitude (k, 4) x y z w, and velocity (k, 3) m/s, world frame.
        ground : float
            Height of the ground or table, m.
        """
        if rows.start == rows.stop:  # the stream of one measurement, without it
            one = np.zeros((1, 3))
            whole = self._stream(slice(0, 1), one, np.array([[0.0, 0.0, 0.0, 1.0]]), one, ground)
            empty: Stream = rows_of(whole, slice(0, 0))
            return empty
        return self._stream(rows, p, q, v, ground)

    def _stream(
        self, rows: slice, p: np.ndarray, q: np.ndarray, v: np.ndarray, ground: float
    ) -> Stream:
        in_turn = np.roll(np.arange(len(self._anchors)), -rows.start)  # distances go on in turn
        config = SimpleNamespace(
            anchors=self._anchors.only(in_turn),
            tag_lever_arm=np.zeros(3),
            **{f"{self._sensor.name}_noise": self._sensor.noise[2]},
        )
        columns = self._sensor.simulated(
            config,
            SimpleNamespace(lower=np.array([-np.inf, -np.inf, ground])),
            SimpleNamespace(p=p, v=v, q=q),
            Rotation.from_quat(q),
            lambda *shape: self._random.standard_normal((len(p), *shape)),
        )
        stream: Stream = self._sensor.stream(self.t[rows], *columns)
        return stream
