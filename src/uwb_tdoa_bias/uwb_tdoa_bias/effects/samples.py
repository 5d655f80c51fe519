"""A batch of measurements with the motion of the tag, as effects see it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from ..foundation.anchors import Anchors
from ..foundation.geometry import ranges, tdoa_each
from ..foundation.later import rotations
from ..foundation.sensors import COMPARED
from .motion import POSE_LAG, Motion, motion_at, preceding

if TYPE_CHECKING:
    from ..foundation.flight import Flight

STEP = 0.1  # s over which the velocity at an instant is taken


@dataclass(frozen=True)
class Samples:
    """A batch of TDOAs and the pose the tag had, or was believed to have, when they were taken.

    t : (n,) s; a, b : (n,) rows of `anchors`; p : (n, 3) m, world; q : (n, 4) x y z w, body to
        world, NaN if unknown.
    start : s, stamp of the first TDOA of the recording, from which slow changes count.
    velocity : (n, 3) m/s, world, of the body at that very instant, where the truth gives it; motion
        : Motion up to the pose that
    a node corrects at; each None if nobody asked.
    interval : (n,) s since the TDOA before; previous : (n,) id of the later anchor of that;
        vibration : (n,) m/s^2,
    root of the power of the high-passed accelerometer; None if unknown.
    extra : {name: (n,)}, anything else that a recording holds; None if nobody asked.
    yaw_std : (n,) rad, standard deviation of the yaw in q; None for a known one.
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
    ends: ClassVar[int] = 2  # anchors that each is measured to

    def __len__(self) -> int:
        return len(self.t)

    def repeated(self, times: int) -> Samples:
        """Samples of the same measurements, all of them so many times one after the other."""
        kept = "anchors", "start"
        return replace(
            self,
            **{
                name: _repeated(value, times)
                for name, value in vars(self).items()
                if name not in kept
            },
        )

    def until(self, t: float) -> Samples:
        """Samples as if none were later than t, s."""
        return replace(self, t=np.minimum(self.t, t))

    @classmethod
    def measured(cls, flight: Flight) -> tuple[Any, np.ndarray, np.ndarray]:
        """(stream of a Flight, a (n,), b (n,)): what is measured, and rows of its anchors, -1 for
        what is no measurement between them.
        """
        tdoa, anchors = flight.tdoa, flight.anchors
        a, b = anchors.index(tdoa.a), anchors.index(tdoa.b)
        return tdoa, np.where(a == b, -1, a), b

    @property
    def rows(self) -> np.ndarray:
        """(ends * n,) rows of `anchors`: of all arrivals, those from the first anchors, then those
        from the second.
        """
        return np.concatenate([self.a, self.b])

    def difference(self, of_arrivals: np.ndarray) -> np.ndarray:
        """(n, ...): what arrivals (ends * n, ...) that are late by so much add to what is measured."""
        return of_arrivals[len(self) :] - of_arrivals[: len(self)]

    def true(self, p: np.ndarray | None = None, positions: np.ndarray | None = None) -> np.ndarray:
        """What is measured when nothing is wrong, (n,) m; with the antenna at p (n, 3) m, or
        anchors at positions (N, 3) m instead.
        """
        out, at = np.empty(len(self)), np.ascontiguousarray(self.p if p is None else p, dtype=float)
        positions = self.anchors.positions if positions is None else positions
        tdoa_each(at, positions[self.a], positions[self.b], out)
        return out

    def direction(self, p: np.ndarray | None = None) -> np.ndarray:
        """Derivative of `true` by the place of the antenna, (n, 3)."""
        p = self.p if p is None else p
        return self.difference(ranges(tile(self, p), self.anchors.positions[self.rows])[1])

    @property
    def change(self) -> np.ndarray:
        """How fast `true` changes as the tag moves, (n,) m/s, where its velocity is known."""
        return np.sum(self.direction() * self.velocity, axis=1)

    @property
    def position_a(self) -> np.ndarray:
        """(n, 3) antennas of the first anchors, m."""
        return self.anchors.positions[self.a]

    @property
    def position_b(self) -> np.ndarray:
        """(n, 3) antennas of the second anchors, m."""
        return self.anchors.positions[self.b]


@dataclass(frozen=True)
class RangeSamples(Samples):
    """A batch of distances to anchors in rows b, as effects see them; a is the same. start : s, as
    of a Flight; no `interval`, no `previous`.
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

    def true(self, p: np.ndarray | None = None, positions: np.ndarray | None = None) -> np.ndarray:
        positions = self.anchors.positions if positions is None else positions
        return np.linalg.norm((self.p if p is None else p) - positions[self.b], axis=1)


RADIO: dict[str, type[Samples]] = {
    kind.channel: kind for kind in (Samples, RangeSamples)
}  # measured between the tag and anchors


def tile(samples: Samples, values: np.ndarray) -> np.ndarray:
    """Per-sample values (n, ...) repeated for all anchors that each is measured to: (ends * n,
    ...).
    """
    return np.concatenate([values] * samples.ends)


def _repeated(value: Any, times: int) -> Any:
    """A field of Samples, an array, a Motion, a dict of arrays or None, as of repeated ones."""
    if value is None:
        return None
    if isinstance(value, dict):
        return {name: _repeated(one, times) for name, one in value.items()}
    if isinstance(value, Motion):
        return Motion(*(_repeated(one, times) for one in vars(value).values()))
    return np.concatenate([value] * times)


@dataclass(frozen=True)
class ImuSamples:
    """An inertial sensor over short cells, as effects see it.

    channel : "gyro" or "accel"; t (n,) s, of the cells; p (n, 3) m, world; start : s, as of
        Samples.
    reading (n, 3): what it should have read, body axes: of the gyroscope what it did read, which is
    less noisy there. Noise in a regressor shrinks what is fitted. change (n, 3): how fast the
    reading changes, per s, None if nobody knows; up (n, 3): the world's vertical, body axes.
    features (n, len(OF_IMU)): covariates; motion : Motion; extra : {name: (n,)}, anything else that
    a recording holds, None if nobody asked.
    """

    channel: str
    t: np.ndarray
    p: np.ndarray
    start: float
    reading: np.ndarray
    change: np.ndarray | None
    up: np.ndarray
    features: np.ndarray
    motion: Motion
    extra: dict[str, np.ndarray] | None = None

    def __len__(self) -> int:
        return len(self.t)


@dataclass(frozen=True)
class AidSamples:
    """Measurements of a sensor, as effects see them.

    channel : name of the stream, or of one of its parts; t (n,) s; p (n, 3) m, world; start : s, as
    of Samples. reading (n, k): what it should have read: of a range finder over the ground at
    z = 0, m; of a barometer the height, m; of a velocity that in the body frame, m/s; of a yaw rate
    that about the body's z, rad/s. change (n, k): how fast that changes, per s. up (n,): cosine of
    the tilt, NaN where the attitude is not known; motion : Motion; vibration (n,) as of Samples, or
    None.
    """

    channel: str
    t: np.ndarray
    p: np.ndarray
    start: float
    reading: np.ndarray
    change: np.ndarray
    up: np.ndarray
    motion: Motion
    vibration: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.t)


class PoseColumns(Protocol):
    """t : (m,) s; p : (m, 3) m, world; q : (m, 4) x y z w, body to world, NaN where not known."""

    @property
    def t(self) -> np.ndarray: ...

    @property
    def p(self) -> np.ndarray: ...

    @property
    def q(self) -> np.ndarray: ...


class Track:
    """Poses, to be asked at any stamp: positions interpolated linearly, attitudes on the great
    circle.
    """

    def __init__(self, poses: PoseColumns) -> None:
        """poses : a Truth, say. Beyond its ends the nearest pose counts."""
        self.t, first = np.unique(poses.t, return_index=True)
        self.p, self.q = poses.p[first], poses.q[first]
        known = np.isfinite(self.q).all(axis=1)
        self._turn, self._ends = None, (0.0, 0.0)
        if known.sum() > 1:
            self._turn = rotations.Slerp(self.t[known], rotations.Rotation.from_quat(self.q[known]))
            self._ends = self.t[known][0], self.t[known][-1]

    def positions(self, t: np.ndarray) -> np.ndarray:
        """(n, 3) m at stamps t (n,), s."""
        return np.stack([np.interp(t, self.t, self.p[:, k]) for k in range(3)], axis=1)

    def attitudes(self, t: np.ndarray) -> np.ndarray:
        """(n, 4) x y z w, body to world, at stamps t (n,), s; NaN where none is known."""
        return (
            np.full((len(t), 4), np.nan)
            if self._turn is None
            else self._turn(np.clip(t, *self._ends)).as_quat()
        )

    def velocities(self, t: np.ndarray) -> np.ndarray:
        """(n, 3) m/s, world, at stamps t (n,), s."""
        return (self.positions(t + 0.5 * STEP) - self.positions(t - 0.5 * STEP)) / STEP

    def motion(self, t: np.ndarray) -> Motion:
        """Motion up to the last pose no later than t (n,), s."""
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
    """Samples of TDOAs (t, a, b as in Samples, t in the order of arrival) at poses, as of a Track.

    With velocity and motion, the latter up to the pose that a node would have, `lag` s old; without
    both where `lag` is None.
    """
    track = Track(poses)
    samples = Samples(t, a, b, track.positions(t), track.attitudes(t), anchors, start)
    if lag is None or not len(t):
        return samples
    return replace(samples, velocity=track.velocities(t), motion=track.motion(preceding(t) - lag))


def true_samples(flight: Flight, kind: type[Samples] = Samples) -> tuple[Samples, np.ndarray]:
    """(Samples, rows): the usable measurements of a kind in a Flight at its ground truth, and which
    rows of their stream they are.
    """
    stream, a, b = kind.measured(flight)
    rows = np.flatnonzero((a >= 0) & (b >= 0) & np.isfinite(stream.d) & np.isfinite(stream.t))
    truth: Any = flight.truth  # who asks has seen that there is one
    return kind(
        **vars(samples_at(stream.t[rows], a[rows], b[rows], truth, flight.anchors, flight.start))
    ), rows


def aid_samples(
    channel: str,
    t: np.ndarray,
    track: Track,
    start: float = 0.0,
    vibration: np.ndarray | None = None,
) -> AidSamples:
    """AidSamples of a channel at stamps t (n,), s, of a Track. start, vibration : see there."""
    before, reading, after = (
        COMPARED[channel].reading(track, t + late) for late in (-0.5 * STEP, 0.0, 0.5 * STEP)
    )
    change = (after - before) / STEP
    return AidSamples(
        channel,
        t,
        track.positions(t),
        start,
        reading,
        change,
        _up(track, t),
        track.motion(t),
        vibration,
    )


def _up(track: Track, t: np.ndarray) -> np.ndarray:
    q = track.attitudes(t)
    return 1.0 - 2.0 * (q[:, 0] ** 2 + q[:, 1] ** 2)
