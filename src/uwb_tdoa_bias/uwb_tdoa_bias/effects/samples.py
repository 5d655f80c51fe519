# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Samples: batches of measurements with the motion of the tag, the input of effects."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, fields, replace
from functools import cached_property
import math
from typing import Any, ClassVar, Protocol, TypeVar, cast

import numpy as np

from ..common.anchors import Anchors
from ..common.arrays import filled, floats
from ..common.compiled import compiled
from ..common.flight import Flight
from ..common.geometry import ranges, tdoa_each
from ..common.lazy import rotations
from ..common.sensors import COMPARED

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
class Samples:
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

    def __len__(self) -> int:
        return len(self.t)

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
class ImuSamples:
    """Means of an inertial sensor over n short cells.

    channel : "gyro" or "accel"
    t : (n,) s; p : (n, 3) m, world; start : s, as of Samples
    reading : (n, 3) true value, body. For the gyroscope it is the measured one, which is less
        noisy: noise in a regressor shrinks the estimate.
    time_derivative : (n, 3) derivative of the reading by time, per s, or None
    up : (n, 3) vertical of the world, body
    features : (n, len(OF_IMU)) covariates; motion : Motion
    extra : {name: (n,)}, further columns of a recording, or None
    """

    channel: str
    t: np.ndarray
    p: np.ndarray
    start: float
    reading: np.ndarray
    time_derivative: np.ndarray | None
    up: np.ndarray
    features: np.ndarray
    motion: Motion
    extra: dict[str, np.ndarray] | None = None

    def __len__(self) -> int:
        return len(self.t)


@dataclass(frozen=True)
class SensorSamples:
    """A batch of n measurements of an auxiliary sensor.

    channel : name of the stream, or of one of its parts
    t : (n,) s; p : (n, 3) m, world; start : s, as of Samples
    reading : (n, k) true value: range to the ground at z = 0, m; height for a barometer, m;
        velocity, m/s, body; yaw rate, rad/s, body
    time_derivative : (n, k) derivative of the reading by time, per s
    up : (n,) cosine of the tilt, NaN if the attitude is unknown
    motion : Motion; vibration : (n,) as of Samples, or None
    """

    channel: str
    t: np.ndarray
    p: np.ndarray
    start: float
    reading: np.ndarray
    time_derivative: np.ndarray
    up: np.ndarray
    motion: Motion
    vibration: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.t)


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
