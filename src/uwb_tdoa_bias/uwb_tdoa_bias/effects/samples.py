# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Samples: batches of measurements with the motion of the tag, the input of effects.

Covariates are quantities of them by name that a systematic error may depend on, with their domains.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, fields, replace
from functools import cached_property
import math
from typing import Any, ClassVar, Protocol, TypeVar, cast

import numpy as np

from ..common.anchors import Anchors
from ..common.arrays import Stamped, filled, floats, numbers_of, rotations
from ..common.compiled import compiled
from ..common.errors import InputError
from ..common.flight import Flight
from ..common.geometry import ranges, tdoa_each
from ..common.radio import into_frame
from ..common.sensors import COMPARED
from ..common.vibration import VIBRATION_CORNER, low_pass, track_vibration

Made = TypeVar("Made")

STEP = 0.1  # s, interval of the central difference that gives a velocity
SPAN = 0.2  # s, interval of the backward differences of Motion
POSE_LAG = 0.05  # s, age of the pose of a correction at the stamp of the TDOA before
N_STATES = 6  # position and velocity of the tag, world


@dataclass(frozen=True)
class Motion:
    """Motion of the tag, NaN where unknown.

    velocity : (n, 3) m/s, world; acceleration : (n, 3) m/s^2, world; rate : (n, 3) rad/s, body
    """

    velocity: np.ndarray
    acceleration: np.ndarray
    rate: np.ndarray


def motion_at(t: np.ndarray, v: np.ndarray, q: np.ndarray, rows: np.ndarray) -> Motion:
    """Return the Motion at some states of a history, from earlier states alone.

    Acceleration and rate are backward differences over SPAN: a node can compute the same.

    t : (m,) s, rising; v : (m, 3) m/s, world; q : (m, 4) x y z w
    rows : (n,) rows of the history, -1 for none
    """
    out = np.full((3, len(rows), 3), np.nan)
    _differences(t, v, q, rows, out)
    return Motion(*out)


def preceding(t: np.ndarray, newest: float | None = None) -> np.ndarray:
    """Return the stamp of the TDOA before each TDOA, (n,) s.

    The first TDOA precedes itself. A stamp that falls back counts as its own.

    t : (n,) s, in order of arrival; newest : latest stamp of all earlier TDOAs, s
    """
    out = np.empty(len(t))
    precede(t, t[0] if newest is None else newest, out)
    return out


@compiled
def precede(t: np.ndarray, newest: float, out: np.ndarray) -> None:
    """Write the result of `preceding` to out (n,), compiled."""
    for i in range(len(t)):
        out[i] = min(newest, t[i])
        newest = max(newest, t[i])


@compiled
def _differences(
    t: np.ndarray, v: np.ndarray, q: np.ndarray, rows: np.ndarray, out: np.ndarray
) -> None:
    for i in range(len(rows)):
        k = rows[i]
        if k < 0:
            continue
        out[0, i] = v[k]
        near = np.searchsorted(t, t[k] - SPAN, side="right") - 1
        if near < 0:
            continue
        dt = t[k] - t[near]
        for axis in range(3):
            out[1, i, axis] = (v[k, axis] - v[near, axis]) / dt
        # Rotation vector from the earlier to the later attitude, body.
        ax, ay, az, aw = -q[near, 0], -q[near, 1], -q[near, 2], q[near, 3]
        bx, by, bz, bw = q[k, 0], q[k, 1], q[k, 2], q[k, 3]
        x = aw * bx + ax * bw + ay * bz - az * by
        y = aw * by - ax * bz + ay * bw + az * bx
        z = aw * bz + ax * by - ay * bx + az * bw
        w = aw * bw - ax * bx - ay * by - az * bz
        sine = math.sqrt(x * x + y * y + z * z)
        angle = 2.0 * math.atan2(sine, abs(w))
        scale = (angle / sine if sine > 1e-12 else 2.0) * (1.0 if w >= 0.0 else -1.0) / dt
        out[2, i, 0], out[2, i, 1], out[2, i, 2] = scale * x, scale * y, scale * z


@dataclass(frozen=True)
class Samples(Stamped):
    """A batch of n TDOAs and the true, or estimated, poses of the tag.

    t : (n,) s
    a, b : (n,) rows of `anchors`
    p : (n, 3) m, world; q : (n, 4) x y z w, body to world, NaN if unknown
    start : s, stamp of the first TDOA of the recording, origin of drifts
    velocity : (n, 3) m/s, world, of the body at t, if the truth gives it
    motion : Motion up to the pose that a node corrects at
    interval : (n,) s since the TDOA before; previous : (n,) id of its second anchor
    vibration : (n,) m/s^2, root of the power of the high-passed accelerometer
    extra : {name: (n,)}, further columns of a recording
    yaw_std : (n,) rad, standard deviation of the yaw in q; None for a known yaw

    All fields from `velocity` on may be None.
    """

    t: np.ndarray
    a: np.ndarray
    b: np.ndarray
    p: np.ndarray
    q: np.ndarray
    anchors: Anchors
    start: float = 0.0
    velocity: np.ndarray | None = None
    motion: Motion | None = None
    interval: np.ndarray | None = None
    previous: np.ndarray | None = None
    vibration: np.ndarray | None = None
    extra: dict[str, np.ndarray] | None = None
    yaw_std: np.ndarray | None = None

    channel: ClassVar[str] = "tdoa"
    ends: ClassVar[int] = 2  # anchors of one measurement

    @cached_property
    def _kept(self) -> dict[Hashable, Any]:
        return {}

    def kept(self, key: Hashable, make: Callable[[], Made]) -> Made:
        """Return make(), which is called once for each key.

        Effects on the same samples share it, so it must not be changed.
        """
        if key not in self._kept:
            self._kept[key] = make()
        return cast("Made", self._kept[key])

    def repeated(self, times: int) -> Samples:
        """Return the whole batch `times` times, one after the other."""
        kept = "anchors", "start"
        names = (one.name for one in fields(self) if one.name not in kept)
        return replace(
            self,
            **{name: _repeated(getattr(self, name), times) for name in names},
        )

    @classmethod
    def measured(cls, flight: Flight) -> tuple[Any, np.ndarray, np.ndarray]:
        """Return (stream of a Flight, rows of first anchors (n,), rows of second anchors (n,)).

        A row is -1 where an anchor is unknown or both anchors are the same.
        """
        tdoa, anchors = flight.tdoa, flight.anchors
        a, b = anchors.index(tdoa.a), anchors.index(tdoa.b)
        return tdoa, np.where(a == b, -1, a), b

    @property
    def rows(self) -> np.ndarray:
        """Return the rows of the anchors of all arrivals, (ends * n,): first ones, then second."""
        return np.concatenate([self.a, self.b])

    def difference(self, of_arrivals: np.ndarray) -> np.ndarray:
        """Return the error of measurements, (n, ...), for errors of arrivals, (ends * n, ...)."""
        return of_arrivals[len(self) :] - of_arrivals[: len(self)]

    def predicted(
        self, p: np.ndarray | None = None, positions: np.ndarray | None = None
    ) -> np.ndarray:
        """Return the measurement by geometry alone, (n,) m.

        p : (n, 3) m, antenna of the tag, instead of its position
        positions : (N, 3) m, antennas of the anchors, instead of the survey
        """
        at = floats(self.p if p is None else p)
        positions = self.anchors.positions if positions is None else positions
        return filled(tdoa_each, (len(self),), at, positions[self.a], positions[self.b])

    def position_jacobian(self, p: np.ndarray | None = None) -> np.ndarray:
        """Return the derivative of `predicted` by the antenna of the tag, (n, 3)."""
        p = self.p if p is None else p
        return self.difference(ranges(tile(self, p), self.anchors.positions[self.rows])[1])

    @property
    def time_derivative(self) -> np.ndarray:
        """Return the derivative of `predicted` by time, (n,) m/s, where the velocity is known."""
        return np.sum(self.position_jacobian() * self.velocity, axis=1)

    @property
    def linearization_point(self) -> np.ndarray:
        """Return position and velocity, (n, 6) m and m/s, world; 0 where unknown."""
        velocity = np.zeros_like(self.p) if self.motion is None else self.motion.velocity
        return np.nan_to_num(np.hstack([self.p, velocity]))

    @property
    def position_a(self) -> np.ndarray:
        """Return the antennas of the first anchors, (n, 3) m."""
        return self.anchors.positions[self.a]

    @property
    def position_b(self) -> np.ndarray:
        """Return the antennas of the second anchors, (n, 3) m."""
        return self.anchors.positions[self.b]


@dataclass(frozen=True)
class RangeSamples(Samples):
    """A batch of distances to anchors in rows b; a is the same.

    There is no `interval` and no `previous`.
    """

    channel: ClassVar[str] = "range"
    ends: ClassVar[int] = 1

    @classmethod
    def measured(cls, flight: Flight) -> tuple[Any, np.ndarray, np.ndarray]:
        stream = getattr(flight, cls.channel)
        b = flight.anchors.index(stream.anchor)
        return stream, b, b

    @property
    def rows(self) -> np.ndarray:
        return self.b

    def difference(self, of_arrivals: np.ndarray) -> np.ndarray:
        return of_arrivals

    def predicted(
        self, p: np.ndarray | None = None, positions: np.ndarray | None = None
    ) -> np.ndarray:
        positions = self.anchors.positions if positions is None else positions
        return np.linalg.norm((self.p if p is None else p) - positions[self.b], axis=1)


# Channels between the tag and anchors
RADIO: dict[str, type[Samples]] = {kind.channel: kind for kind in (Samples, RangeSamples)}


def tile(samples: Samples, values: np.ndarray) -> np.ndarray:
    """Return values of samples, (n, ...), repeated for each of their arrivals, (ends * n, ...)."""
    return np.concatenate([values] * samples.ends)


def _repeated(value: Any, times: int) -> Any:
    """Repeat a field of Samples: an array, a Motion, a dict of arrays or None."""
    if value is None:
        return None
    if isinstance(value, dict):
        return {name: _repeated(part, times) for name, part in value.items()}
    if isinstance(value, Motion):
        return Motion(*(_repeated(part, times) for part in vars(value).values()))
    return np.concatenate([value] * times)


@dataclass(frozen=True)
class AxesSamples(Stamped):
    """A batch of n measurements of a sensor of the vehicle, with k axes.

    channel : name of the stream, or of one of its parts
    t : (n,) s; p : (n, 3) m, world; start : s, as of Samples
    reading : (n, k) value that effects are functions of
    time_derivative : (n, k) derivative of the reading by time, per s, or None
    up : the vertical of the world, body; motion : Motion
    """

    channel: str
    t: np.ndarray
    p: np.ndarray
    start: float
    reading: np.ndarray
    time_derivative: np.ndarray | None
    up: np.ndarray
    motion: Motion


@dataclass(frozen=True)
class ImuSamples(AxesSamples):
    """Means of an inertial sensor over n short cells; its channel is "gyro" or "accel".

    reading : (n, 3), body: the measured rate, which is less noisy than the true one, or a force
        whose noise the residual does not share
    up : (n, 3)
    features : (n, len(OF_IMU)) covariates
    extra : {name: (n,)}, further columns of a recording, or None
    """

    features: np.ndarray
    extra: dict[str, np.ndarray] | None = None


@dataclass(frozen=True)
class SensorSamples(AxesSamples):
    """A batch of n measurements of an auxiliary sensor.

    reading : (n, k) true value: range to the ground at z = 0, m; height for a barometer, m;
        velocity, m/s, body; yaw rate, rad/s, body
    up : (n,) cosine of the tilt, NaN if the attitude is unknown
    vibration : (n,) as of Samples, or None
    """

    time_derivative: np.ndarray
    vibration: np.ndarray | None = None


class PoseColumns(Protocol):
    """Poses: t (m,) s; p (m, 3) m, world; q (m, 4) x y z w, body to world, NaN if unknown."""

    @property
    def t(self) -> np.ndarray: ...

    @property
    def p(self) -> np.ndarray: ...

    @property
    def q(self) -> np.ndarray: ...


class Track:
    """Interpolated poses: positions linearly, attitudes on the great circle."""

    def __init__(self, poses: PoseColumns) -> None:
        """Sort poses, such as a Truth; beyond their ends the nearest pose counts."""
        self.t, first = np.unique(poses.t, return_index=True)
        self.p, self.q = poses.p[first], poses.q[first]
        known = np.isfinite(self.q).all(axis=1)
        self._turn, self._ends = None, (0.0, 0.0)
        if known.sum() > 1:
            self._turn = rotations.Slerp(self.t[known], rotations.Rotation.from_quat(self.q[known]))
            self._ends = self.t[known][0], self.t[known][-1]

    def positions(self, t: np.ndarray) -> np.ndarray:
        """Return positions, (n, 3) m, at stamps t (n,), s."""
        return np.stack([np.interp(t, self.t, self.p[:, k]) for k in range(3)], axis=1)

    def attitudes(self, t: np.ndarray) -> np.ndarray:
        """Return attitudes, (n, 4) x y z w, body to world, at stamps t (n,), s; NaN if unknown."""
        if self._turn is None:
            return np.full((len(t), 4), np.nan)
        return self._turn(np.clip(t, *self._ends)).as_quat()

    def velocities(self, t: np.ndarray) -> np.ndarray:
        """Return velocities, (n, 3) m/s, world, at stamps t (n,), s."""
        return (self.positions(t + 0.5 * STEP) - self.positions(t - 0.5 * STEP)) / STEP

    def motion(self, t: np.ndarray) -> Motion:
        """Return the Motion at the last pose not later than t (n,), s."""
        return motion_at(
            self.t, self._own_velocities, self.q, np.searchsorted(self.t, t, side="right") - 1
        )

    @cached_property
    def _own_velocities(self) -> np.ndarray:
        return self.velocities(self.t)


def samples_at(
    t: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    poses: PoseColumns,
    anchors: Anchors,
    start: float = 0.0,
    lag: float | None = POSE_LAG,
) -> Samples:
    """Return Samples of TDOAs at interpolated poses.

    t, a, b : as in Samples, in order of arrival
    lag : s, age of the pose of a node; the Motion is that of this pose. None omits velocity and
        motion.
    """
    track = Track(poses)
    samples = Samples(t, a, b, track.positions(t), track.attitudes(t), anchors, start)
    if lag is None or not len(t):
        return samples
    return replace(samples, velocity=track.velocities(t), motion=track.motion(preceding(t) - lag))


def true_samples(flight: Flight, kind: type[Samples] = Samples) -> tuple[Samples, np.ndarray]:
    """Return (Samples, rows of the stream) of the usable measurements of a Flight with truth.

    kind : Samples for TDOAs, RangeSamples for ranges
    """
    stream, a, b = kind.measured(flight)
    rows = np.flatnonzero((a >= 0) & (b >= 0) & np.isfinite(stream.d) & np.isfinite(stream.t))
    truth: Any = flight.truth  # the caller has checked it
    samples = samples_at(stream.t[rows], a[rows], b[rows], truth, flight.anchors, flight.start)
    return kind(**vars(samples)), rows


def sensor_samples(
    channel: str,
    t: np.ndarray,
    track: Track,
    start: float = 0.0,
    vibration: np.ndarray | None = None,
) -> SensorSamples:
    """Return SensorSamples of a channel at stamps t (n,), s, of a Track."""
    before, reading, after = (
        COMPARED[channel].reading(track, t + late) for late in (-0.5 * STEP, 0.0, 0.5 * STEP)
    )
    rate, q = (after - before) / STEP, track.attitudes(t)
    up = 1.0 - 2.0 * (q[:, 0] ** 2 + q[:, 1] ** 2)
    p, motion = track.positions(t), track.motion(t)
    return SensorSamples(channel, t, p, start, reading, rate, up, motion, vibration)


FADE = 0.5  # share of the width of a domain; this far beyond it, exp(-1/2) of an effect is left
CATEGORIES = ("previous_anchor",)  # values are names, not sizes
UPWARDS = ("height", "elevation")  # change at take-off
# of a history of poses
OF_MOTION = (
    "speed",
    "climb_rate",
    "acceleration",
    "turning_rate",
    "interval",
    "previous_anchor",
    "range_rate",
)
ONLY_TDOA = (*OF_MOTION, "range_difference")  # ranges do not have these


def _norm(v: np.ndarray) -> np.ndarray:
    return np.linalg.norm(v, axis=1)


# One value per TDOA of Samples, (n,); None if the samples lack it
OF_TDOA: dict[str, Callable[[Any], np.ndarray | None]] = {
    "time": lambda s: s.t - s.start,
    "x": lambda s: s.p[:, 0],
    "y": lambda s: s.p[:, 1],
    "height": lambda s: s.p[:, 2],
    "speed": lambda s: None if s.motion is None else _norm(s.motion.velocity),
    "climb_rate": lambda s: None if s.motion is None else s.motion.velocity[:, 2],
    "acceleration": lambda s: None if s.motion is None else _norm(s.motion.acceleration),
    "turning_rate": lambda s: None if s.motion is None else _norm(s.motion.rate),
    "tilt": lambda s: 2.0 * np.arcsin(np.minimum(np.hypot(s.q[:, 0], s.q[:, 1]), 1.0)),
    "yaw": lambda s: _yaw(*s.q.T),
    "interval": lambda s: s.interval,
    "previous_anchor": lambda s: s.previous,
    "vibration": lambda s: s.vibration,
}


def _yaw(x: Any, y: Any, z: Any, w: Any) -> Any:
    return np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


def _to_anchor(samples: Samples, rows: np.ndarray) -> np.ndarray:
    return samples.anchors.positions[rows] - tile(samples, samples.p)


def _bearing(v: np.ndarray) -> np.ndarray:
    return np.arctan2(v[:, 1], v[:, 0])


def _range_difference(samples: Samples, rows: np.ndarray) -> np.ndarray:
    """Return how much farther each arrival is than the other one, (2 * n,) m."""
    of_a, of_b = _norm(_to_anchor(samples, rows)).reshape(2, -1)
    return np.concatenate([of_a - of_b, of_b - of_a])


def _range_rate(samples: Samples, rows: np.ndarray) -> np.ndarray:
    if samples.motion is None:
        return np.full(len(rows), np.nan)
    away, velocity = -_to_anchor(samples, rows), tile(samples, samples.motion.velocity)
    return np.sum(away * velocity, axis=1) / _norm(away)


def _elevation(v: np.ndarray) -> np.ndarray:
    return np.arctan2(v[:, 2], np.hypot(v[:, 0], v[:, 1]))


# One value per arrival at anchors in rows (ends * n,), with the samples repeated
OF_ARRIVAL: dict[str, Callable[[Samples, np.ndarray], np.ndarray]] = {
    "range": lambda s, rows: np.linalg.norm(_to_anchor(s, rows), axis=1),
    "range_difference": _range_difference,
    "range_rate": _range_rate,
    "bearing": lambda s, rows: _bearing(_to_anchor(s, rows)),
    "elevation": lambda s, rows: _elevation(_to_anchor(s, rows)),
    "bearing_in_tag": lambda s, rows: _bearing(into_frame(tile(s, s.q), _to_anchor(s, rows))),
    "elevation_in_tag": lambda s, rows: _elevation(into_frame(tile(s, s.q), _to_anchor(s, rows))),
    "bearing_in_anchor": lambda s, rows: _bearing(
        into_frame(s.anchors.orientations[rows], -_to_anchor(s, rows))
    ),
    "elevation_in_anchor": lambda s, rows: _elevation(
        into_frame(s.anchors.orientations[rows], -_to_anchor(s, rows))
    ),
}

# Columns of ImuFeatures, one value per inertial sample
OF_IMU = (
    "time",
    "vibration",
    "turning_rate",
    "rate_x",
    "rate_y",
    "rate_z",
    "accel",
    "accel_x",
    "accel_y",
    "accel_z",
)

# Names of OF_TDOA that SensorSamples have too
OF_SENSORS = (
    "time",
    "x",
    "y",
    "height",
    "speed",
    "climb_rate",
    "acceleration",
    "turning_rate",
    "vibration",
)

# States by which the filter differentiates a function of a covariate: position (0, 1, 2) and
# velocity (3, 4, 5). Not the speed: the direction of a slow motion is unknown, and its Jacobian
# made estimates worse.
STATES = {
    **dict.fromkeys(("x", "y", "height", *OF_ARRIVAL), (0, 1, 2)),
    "climb_rate": (5,),
    "range_rate": (0, 1, 2, 3, 4, 5),
}

# Covariates of inertial sensors that are states of the filter
OF_STATE = ("x", "y", "height", "speed", "climb_rate")

UNITS = {
    "time": "s",
    "x": "m",
    "y": "m",
    "height": "m",
    "speed": "m/s",
    "climb_rate": "m/s",
    "acceleration": "m/s^2",
    "turning_rate": "rad/s",
    "tilt": "rad",
    "yaw": "rad",
    "interval": "s",
    "previous_anchor": "id",
    "vibration": "m/s^2",
    **dict.fromkeys(OF_ARRIVAL, "rad"),
    "range": "m",
    "range_difference": "m",
    "range_rate": "m/s",
    **dict.fromkeys((name for name in OF_IMU if name.startswith("rate_")), "rad/s"),
    **dict.fromkeys((name for name in OF_IMU if name.startswith("accel")), "m/s^2"),
}
DEGREES = math.degrees(1.0)  # degrees per radian
EXTRA = "extra."  # prefix of further columns of a log: "extra.STREAM.COLUMN"
OF_ACCEL = ("accel", "accel_x", "accel_y", "accel_z")  # specific force, m/s^2


def shown_in(covariate: str, unknown: str = "") -> tuple[str, float]:
    """Return (unit, factor from its unit) in which people read a covariate: angles in degrees.

    unknown : unit of columns of logs
    """
    unit = UNITS.get(covariate, unknown)
    return ("degrees", DEGREES) if unit == "rad" else (unit, 1.0)


def sensor_covariate(name: str, samples: AxesSamples) -> np.ndarray | None:
    """Return a covariate of ImuSamples or SensorSamples, (n,); None if the samples lack it.

    name : of OF_SENSORS; for ImuSamples also of OF_IMU, or "extra.NAME"
    """
    if name.startswith(EXTRA):
        if not isinstance(samples, ImuSamples):
            return None
        return (samples.extra or {}).get(name.removeprefix(EXTRA))
    if samples.channel == "accel" and name in OF_ACCEL:
        # of the cell of the residual; the features are of the past
        reading = samples.reading
        return _norm(reading) if name == "accel" else reading[:, "xyz".index(name[-1])]
    if name in OF_IMU and isinstance(samples, ImuSamples):
        return samples.features[:, OF_IMU.index(name)]
    return OF_TDOA[name](samples)


def covariate_of(samples: Samples, name: str) -> Any:
    """Return a covariate of OF_TDOA, (n,) or None, or of OF_ARRIVAL, (ends * n,).

    Effects on the same samples share it; it is computed once, and must not be changed.
    """
    of_arrival = OF_ARRIVAL.get(name)
    if of_arrival is None:
        return samples.kept(name, lambda: OF_TDOA[name](samples))
    return samples.kept(name, lambda: of_arrival(samples, samples.rows))


def has_domain(name: str) -> bool:
    """Return whether a covariate has a domain: a number that nodes can compute."""
    return name not in CATEGORIES and not name.startswith(EXTRA)


def checked_domain(effect: str, domain: Any) -> dict[str, tuple[float, float]]:
    """Return a domain of effects.yaml as {covariate: (low, high)}; raise InputError.

    effect : its name, for messages
    """
    out = {}
    known = (*OF_TDOA, *OF_ARRIVAL, *OF_IMU)
    for covariate, limits in (domain or {}).items():
        name = str(covariate)
        found = numbers_of(limits)
        low, high = found.tolist() if found.shape == (2,) else (np.nan, np.nan)
        if name not in known or not has_domain(name) or not -np.inf < low <= high < np.inf:
            raise InputError(
                f"effects: {effect}: domain: {covariate}: {limits!r}; expected a covariate "
                "with the least and the largest value seen, as time: [0, 60]."
            )
        out[name] = low, high
    return out


def fade_weight(values: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """Return the weight of an effect at values (n,) of a covariate with a domain, (n,).

    It is 1 within the limits, and 1 for an unknown value.
    """
    low, high = limits
    beyond = np.maximum(np.maximum(low - values, values - high), 0.0)
    if isinstance(beyond, np.ndarray) and not beyond.any():
        return np.ones(beyond.shape)  # the usual case
    return np.exp(-0.5 * (np.nan_to_num(beyond) / (FADE * max(high - low, 1e-6))) ** 2)


class ImuFeatures:
    """The covariates OF_IMU along a stream of inertial samples, from its past alone."""

    def __init__(self) -> None:
        # Rows: last and first stamp; low-passed rate; low-passed force; power of the vibration.
        self._state = np.zeros((4, 3))
        self._state[0, :2] = np.nan

    def __call__(self, t: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> np.ndarray:
        """Return features (n, len(OF_IMU)) of t (n,) s, gyro (n, 3) rad/s, accel (n, 3) m/s^2."""
        out = np.empty((len(t), len(OF_IMU)))
        t, gyro, accel = (np.ascontiguousarray(column) for column in (t, gyro, accel))
        _features(self._state, t, gyro, accel, out)
        return out


@compiled
def _features(
    state: np.ndarray, t: np.ndarray, gyro: np.ndarray, accel: np.ndarray, out: np.ndarray
) -> None:
    rate, force, power = state[1], state[2], state[3]
    for i in range(len(t)):
        dt = t[i] - state[0, 0]
        if not 0.0 <= dt < 1.0:  # first sample, or after a gap
            if not (state[0, 1] <= t[i]):
                state[0, 1] = t[i]
            rate[:], force[:], power[:] = gyro[i], accel[i], 0.0
            dt = 0.0
        state[0, 0] = t[i]
        track_vibration(force, power, accel[i], dt)
        for k in range(3):
            rate[k] = low_pass(rate[k], gyro[i, k], dt, VIBRATION_CORNER)
            out[i, 3 + k] = rate[k]
            out[i, 7 + k] = force[k]
        out[i, 0] = t[i] - state[0, 1]
        out[i, 1] = math.sqrt(power[0] + power[1] + power[2])
        out[i, 2] = math.sqrt(rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2)
        out[i, 6] = math.sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
