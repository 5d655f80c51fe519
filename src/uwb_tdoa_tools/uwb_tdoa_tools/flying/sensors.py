# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Simulate radio, inertial sensor and further sensors of one flight.

Errors that do not depend on the path are drawn in advance, by seed.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.compiled import compiled
from uwb_tdoa_bias.common.radio import arrival_bias
from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_bias.common.sensors.pressure import SITE, pressure_at
from uwb_tdoa_bias.common.sensors.sensor import RATE
from uwb_tdoa_bias.common.sensors.velocity import LEAST_STD
from uwb_tdoa_bias.effects import Samples
from uwb_tdoa_bias.effects.floor import FloorMultipath

from ..simulation.tdoas import make_schedule, outliers, tag_link, tdoa_noise
from .vehicle import IMU_RATE
from .world import World

NEAR_FLOOR = 0.5  # m, largest height at which the floor acts
FLOOR_DELAY, FLOOR_HEIGHT = (3.0, 3.9), (0.06, 0.2)  # m, of low anchors, and up to which height
CHANGED_DELAY = 0.3  # m, of an anchor that becomes late
LOW = 1.0  # m, largest height of a low anchor
GUST_TIME = 1.0  # s, correlation time of gusts
PERSON = 0.25, 1.8, 1.0  # m, radius and height of a person; m/s
# m, delay behind a person; s, between draws of it
BLOCKED, BLOCK_TIME = ((0.2, 2.0), 0.5)
STD = {name: sensor.noise[2] for name, sensor in SENSORS.items()}  # of the noise of each sensor
HIGHEST = 4.0  # m, largest distance of the range finder
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
        self._link = tag_link(seed) if world.antennas else None
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

    def measured(self, rows: slice, p: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return TDOAs (k,), m, with NaN where no TDOA is received.

        Parameters
        ----------
        rows : slice
            Rows of `t`.
        p, q : numpy.ndarray
            Tag positions (k, 3), m, and attitudes (k, 4), x y z w.
        """
        t, a, b, d = self.t[rows], self.a[rows], self.b[rows], np.empty(len(p))
        _measure(p, a, b, self.positions, self.constants, d)
        d += self._error[rows]
        if self._link is not None:
            both = np.stack([b, a])
            late = arrival_bias(
                p, q, self.positions[both], self._anchors.orientations[both], self._link
            )
            d += late[0] - late[1]
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
    """Simulate a further sensor of one flight.

    Attributes
    ----------
    t : numpy.ndarray
        Stamps (n,), s.
    """

    rate, width = RATE, 1  # Hz; numbers per measurement

    def __init__(self, world: World, seed: int, duration: float) -> None:
        """Draw stamps and noise for `duration`, s."""
        self.world = world
        self.t = np.arange(0.5, duration * self.rate) / self.rate
        self.noise = random(seed, type(self).__name__).standard_normal((len(self.t), self.width))

    def measured(
        self, rows: slice, p: np.ndarray, q: np.ndarray, v: np.ndarray, height: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """Return the columns of the measurements in a slice of rows.

        Parameters
        ----------
        rows : slice
            Rows of `t`.
        p, q, v : numpy.ndarray
            Position (k, 3) m, attitude (k, 4) x y z w, and velocity (k, 3) m/s in the body frame.
        height : numpy.ndarray
            Height above the ground or table (k,), m.
        """
        raise NotImplementedError


class RangeFinder(AuxiliarySensor):
    """Simulate a range finder along -z of the body, m, with inf beyond its range."""

    rate = 20.0

    def measured(
        self, rows: slice, p: np.ndarray, q: np.ndarray, v: np.ndarray, height: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        up = 1.0 - 2.0 * (q[:, 0] ** 2 + q[:, 1] ** 2)
        seen = height / np.maximum(up, 1e-3) + STD["height"] * self.noise[rows, 0]
        return (np.where((up > 0.0) & (seen <= HIGHEST), np.maximum(seen, 0.0), np.inf),)


class Barometer(AuxiliarySensor):
    """Simulate a barometer, Pa."""

    def measured(
        self, rows: slice, p: np.ndarray, q: np.ndarray, v: np.ndarray, height: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        return (pressure_at(SITE + p[:, 2] + STD["pressure"] * self.noise[rows, 0]),)


class Speedometer(AuxiliarySensor):
    """Simulate a velocity sensor: velocity in the body frame and its standard deviation, m/s."""

    width = 3

    def measured(
        self, rows: slice, p: np.ndarray, q: np.ndarray, v: np.ndarray, height: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        std = STD["velocity"]
        return v + std * self.noise[rows], np.full(v.shape, max(std, LEAST_STD))


class TwoWayRanging(AuxiliarySensor):
    """Simulate distances to the anchors in turn: ids, m, and an unknown variance of 0.

    No obstacle blocks them.
    """

    rate = SENSORS["range"].rate

    def measured(
        self, rows: slice, p: np.ndarray, q: np.ndarray, v: np.ndarray, height: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        anchors = self.world.anchors
        row = np.arange(rows.start, rows.stop) % len(anchors)
        d = np.linalg.norm(p - anchors.positions[row], axis=1) + STD["range"] * self.noise[rows, 0]
        return anchors.ids[row], np.maximum(d, 0.0), np.zeros(len(d))


class OtherSensor(AuxiliarySensor):
    """Simulate any other sensor of SENSORS by the simulation of its record."""

    def __init__(self, name: str, world: World, seed: int, duration: float) -> None:
        """Draw stamps for `duration`, s; `name` is that of the sensor."""
        self.rate = SENSORS[name].rate
        super().__init__(world, seed, duration)
        self._simulated, self._random = SENSORS[name].simulated, random(seed, name)
        noises: dict[str, Any] = {f"{each}_noise": std for each, std in STD.items()}
        self._config = SimpleNamespace(anchors=world.anchors, tag_lever_arm=np.zeros(3), **noises)

    def measured(
        self, rows: slice, p: np.ndarray, q: np.ndarray, v: np.ndarray, height: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        n = len(p)
        if not n:  # the columns of one measurement, without it
            one = np.zeros((1, 3))
            columns = self._columns(one, np.array([[0.0, 0.0, 0.0, 1.0]]), one, np.zeros(1))
            return tuple(column[:0] for column in columns)
        return self._columns(p, q, v, height)

    def _columns(
        self, p: np.ndarray, q: np.ndarray, v: np.ndarray, height: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        turn = Rotation.from_quat(q)
        motion = SimpleNamespace(p=p, v=turn.apply(v), q=q)
        room = SimpleNamespace(lower=np.array([-np.inf, -np.inf, p[0, 2] - height[0]]))
        columns: tuple[np.ndarray, ...] = self._simulated(
            self._config,
            room,
            motion,
            turn,
            lambda *shape: self._random.standard_normal((len(p), *shape)),
        )
        return columns


_OWN: dict[str, Callable[..., AuxiliarySensor]] = {
    "height": RangeFinder,
    "pressure": Barometer,
    "velocity": Speedometer,
    "range": TwoWayRanging,
}
SENSOR_NAMES = {name: _OWN.get(name, partial(OtherSensor, name)) for name in SENSORS}
