# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Correct raw TDOAs at earlier poses of the tag: the core of bias_node and of the offline filter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..common.anchors import Anchors
from ..common.compiled import compiled
from ..common.errors import InputError
from ..effects import EffectSet, Samples
from ..effects.base import counted, listed
from ..effects.samples import N_STATES, POSE_LAG, Motion, motion_at, precede
from .model import EFFECTS, FADED, NETWORK, PASSED, Model, Prediction

# rad. A yaw with a larger standard deviation is unknown: then the filter follows four yaws,
# 90 degrees apart.
LARGEST_YAW_STD = 1.0
POSE_NUMBERS, TWIST_NUMBERS = 3 + 4 + 36, 6 + 36  # of PoseWithCovariance and TwistWithCovariance
HISTORY = 4096  # poses kept at least
# s after the first pose. Earlier TDOAs are corrected without a pose, which costs accuracy.
START = 0.2
TILT = 0.5  # rad; with a larger tilt std the filter estimates no attitude


@dataclass(frozen=True)
class Correction:
    """Corrections of n TDOAs.

    Attributes
    ----------
    bias : (n,) m
    std : (n,) m, of the error that remains in `corrected`. Its square adds to the variance of the TDOA.
        It holds noise that effects add, what their domains leave, and the deviation of a bias from
        its linearization if the state is REACH off.
    corrected : (n,) m, d - bias
    status : (n,) of PASSED, EFFECTS, NETWORK, FADED
    slope : (n, 6), Jacobian of the bias by position and velocity of the tag, world; 1 and s
    state : (n, 6), position, m, and velocity, m/s, of the tag, world, at which bias and slope hold
    """

    bias: np.ndarray
    std: np.ndarray
    corrected: np.ndarray
    status: np.ndarray
    slope: np.ndarray
    state: np.ndarray

    @classmethod
    def none(cls, d: np.ndarray) -> Correction:
        """Return the Correction of raw d (n,) m without any known bias."""
        bias, std = np.zeros((2, len(d)))
        status = np.full(len(d), PASSED, dtype=np.uint8)
        return cls(bias, std, d - bias, status, *np.zeros((2, len(d), N_STATES)))


class Corrector:
    """Predict the bias of each TDOA at an earlier pose of the tag, and remove it.

    The pose of a measurement is the newest one stamped at least `lag` s before the preceding
    measurement. This choice has three advantages:

    - It depends on stamps alone, so a recording gives the same result at any speed.
    - The filter has `lag` s to report the pose.
    - The filter needs nothing later than the preceding measurement for it, even after a gap.
    """

    def __init__(
        self,
        anchors: Anchors,
        effects: EffectSet | None = None,
        model: Model | None = None,
        lag: float = POSE_LAG,
        poses: Poses | None = None,
    ) -> None:
        """Set effects and model.

        Effects with `is_hypothesis` (floor reflections) are not corrected here: the filter decides
        whether they act. They are in `left_to_filter`, all others in `effects`.

        Parameters
        ----------
        anchors : Anchors
        effects : EffectSet or None
        model : Model or None; an ONNX file with a learned network, with exported effects, or with
            both. Its effects must not be in `effects`, too.
        lag : s
        poses : Poses that other Correctors use, too; by default its own
        """
        self.anchors, self.model, self.lag = anchors, model, lag
        self._set_effects(EffectSet() if effects is None else effects)
        self._poses = Poses() if poses is None else poses
        self._begin()

    def _set_effects(self, effects: EffectSet) -> None:
        model = self.model
        self.effects = effects.where(lambda effect: not effect.is_hypothesis)
        self.left_to_filter = effects.where(lambda effect: effect.is_hypothesis)
        held = model.holds if model else ()
        twice = set(held) & {effect.label for effect in self.effects}
        if twice:
            raise InputError(
                f"effects: {min(twice)} is in the model too, which holds {', '.join(held)}; leave "
                "it out of the effects."
            )
        own = self.effects.name if len(self.effects) else ""
        self.model_name = _joined(own, model.name if model else "")
        of_effects = _joined(own, model.of_effects if model else "")
        self.name_of_status = {
            PASSED: "none",
            EFFECTS: of_effects,
            NETWORK: self.model_name,
            FADED: self.model_name,
        }

    def reset(self) -> None:
        """Delete all poses."""
        self._poses.clear()
        self._begin()

    def _begin(self) -> None:
        self._latest_samples: Samples | None = None  # of the latest batch
        # s, stamps of TDOAs, once there is one: the latest, and that of the first
        self._newest_stamp: float = None  # type: ignore[assignment]
        self._first_stamp = math.nan
        # stamp, s, and id of the second anchor of the last TDOA
        self._last_tdoa: tuple[float, int] | None = None

    def change_anchors(self, anchors: Anchors) -> None:
        """Continue with other Anchors and the known poses."""
        self.anchors, self._latest_samples, self._last_tdoa = anchors, None, None

    def change_effects(self, effects: EffectSet) -> None:
        """Continue with another EffectSet and the known poses. Raises InputError as at the start."""
        self._set_effects(effects)
        self._latest_samples = None

    @property
    def idle(self) -> bool:
        """True without effects and model."""
        return len(self.effects) == 0 and self.model is None

    @property
    def uses_pose(self) -> bool:
        """Return whether a correction depends on the pose of the tag, so it waits for poses."""
        return not self.idle and (self.model is not None or self.effects.uses_pose)

    @property
    def outside(self) -> list[str]:
        """Phrases on effects that faded by more than half for some of the latest TDOAs.

        Such TDOAs were measured outside of the domain of the effect.
        """
        samples = self._latest_samples
        return [] if samples is None else self.effects.outside(samples)

    def add_pose(
        self,
        t: ArrayLike,
        p: ArrayLike,
        q: ArrayLike,
        v: ArrayLike = np.nan,
        yaw_std: ArrayLike = 0.0,
    ) -> None:
        """Add one pose of the tag, or k poses; stamps must rise, others are ignored.

        Parameters
        ----------
        t : s, or (k,)
        p : (3,) m, world, or (k, 3)
        q : (4,) x y z w, body to world, or (k, 4)
        v : (3,) m/s, world, or (k, 3); NaN if unknown
        yaw_std : rad, or (k,); standard deviation of the rotation about the vertical
        """
        self._poses.add(
            t, p, q, np.broadcast_to(v, np.shape(p)), np.broadcast_to(yaw_std, np.shape(t))
        )

    def ready(self, preceding: float) -> bool:
        """Return whether no future pose can change the correction of a TDOA.

        preceding : s, stamp of the TDOA before it, as in `Poses.for_tdoas`
        """
        return (
            not self.uses_pose
            or self._poses.newest > preceding - self.lag
            or preceding < self._poses.begin < math.inf
        )

    def correct(self, t: np.ndarray, a: np.ndarray, b: np.ndarray, d: np.ndarray) -> Correction:
        """Return the Correction of a batch.

        Where no pose is known, only effects that need none contribute.

        Parameters
        ----------
        t : (n,) s
        a, b : (n,) rows of `anchors`
        d : (n,) m, raw d_ab
        """
        if self.idle or len(t) == 0:
            return Correction.none(d)
        self._latest_samples = samples = self.samples(t, a, b)
        bias, std, status, slope, state = self.prediction(samples)
        return Correction(bias, std, d - bias, status.astype(np.uint8), slope, state)

    def prediction(self, samples: Samples) -> Prediction:
        """Return the Prediction of Samples by effects and model."""
        bias, std, slope, state = self.contribution(samples)
        status = np.full(len(samples), float(EFFECTS if len(self.effects) else PASSED))
        known = Prediction(bias, std, status, slope, state)
        return known if self.model is None else self.model.possibly_added(samples, known)

    def contribution(
        self, samples: Samples
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return bias (n,) m, its std (n,) m, slope (n, 6) and state (n, 6) of the effects.

        Units as in Correction. While the yaw is unknown, bias and std are mean and scatter over four
        headings. Then effects that use the attitude have no slope.
        """
        slope: np.ndarray
        slope = state = np.zeros((len(samples), N_STATES))
        if not len(self.effects):
            return np.zeros(len(samples)), np.zeros(len(samples)), slope, state
        steep = self.effects.state_dependent
        bias, noise = self.effects.state_independent.bias(samples), self.effects.noise_std(samples)
        if len(steep):
            of_steep, slope, curvature_std = steep.bias_jacobian(samples)
            bias = bias + of_steep
            noise = np.hypot(noise, curvature_std)
            state = samples.linearization_point
        yaw_unknown: np.ndarray = np.zeros(len(samples), bool)
        if samples.yaw_std is not None:
            yaw_unknown = samples.yaw_std > LARGEST_YAW_STD
        of_attitude = self.effects.of_attitude
        if len(of_attitude) and yaw_unknown.any():
            # the estimated attitude, then four headings
            attitudes = np.concatenate(
                [samples.q, *(rotated_in_yaw(samples.q, k) for k in range(4))]
            )
            biases = of_attitude.bias(replace(samples.repeated(5), q=attitudes)).reshape(5, -1)
            estimated, headings = biases[0], biases[1:]
            bias = np.where(yaw_unknown, bias - estimated + headings.mean(axis=0), bias)
            noise = np.where(yaw_unknown, np.hypot(noise, headings.std(axis=0)), noise)
        if len(steep) and yaw_unknown.any():
            without_attitude = steep.where(lambda effect: not effect.uses_attitude)
            other_slope = without_attitude.bias_jacobian(samples)[1]
            slope = np.where(yaw_unknown[:, None], other_slope, slope)
        return bias, noise, slope, state

    def samples(self, t: np.ndarray, a: np.ndarray, b: np.ndarray) -> Samples:
        """Return the Samples of a batch at the poses known so far; parameters as for `correct`."""
        if self._newest_stamp is None:
            self._first_stamp = self._newest_stamp = t[0]
        rows, p, q, yaw_std = self._poses.for_tdoas(t, self._newest_stamp, self.lag)
        self._newest_stamp = max(self._newest_stamp, t.max())
        samples = Samples(t, a, b, p, q, self.anchors, self._first_stamp, yaw_std=yaw_std)
        if not (self.effects.needs_motion or (self.model and self.model.needs_motion)):
            return samples
        kept = self._poses.kept
        last_t, last_b = self._last_tdoa or (t[0], -1)
        self._last_tdoa = (t[-1], self.anchors.ids[b[-1]])
        return replace(
            samples,
            motion=motion_at(kept.t, kept.v, kept.q, rows),
            interval=t - np.concatenate([[last_t], t[:-1]]),
            previous=np.concatenate([[last_b], self.anchors.ids[b[:-1]]]),
        )


class FixedPoses:
    """The poses of an earlier run, and the Samples of a recording at them.

    Models that are tried at these poses share the Samples, and with them what their effects have in
    common: covariates, domains and basis functions.
    """

    def __init__(self, poses: Sequence[np.ndarray]) -> None:
        """Set the poses.

        poses : (t (k,) s, p (k, 3) m, q (k, 4), v (k, 3) m/s, yaw_std (k,) rad), as for
            `Corrector.add_pose`
        """
        self.poses = poses
        self._samples: list[Samples] = []

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the Samples: another process computes its own."""
        return {"poses": self.poses, "_samples": []}

    def shared(self, samples: Samples) -> Samples:
        """Return the Samples of an earlier model if they are equal, else these."""
        same = next((one for one in self._samples if _equal(one, samples)), None)
        if same is None:
            self._samples = [*self._samples[-1:], samples]  # with and without motion
        return samples if same is None else same


def _equal(one: Any, other: Any) -> bool:
    """Return whether two Samples, or fields of them, are equal."""
    if type(one) is not type(other):
        return False
    if isinstance(one, (Samples, Motion)):
        return all(
            _equal(getattr(one, each.name), getattr(other, each.name)) for each in fields(one)
        )
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    return bool(one is other or one == other)


class FixedPoseCorrector(Corrector):
    """Corrects a recording at the poses of an earlier run with another model."""

    uses_pose = False  # it has all poses, so it waits for none

    def __init__(self, anchors: Anchors, effects: EffectSet | None, fixed: FixedPoses) -> None:
        """Set the poses of the earlier run."""
        self._fixed = fixed
        super().__init__(anchors, effects, poses=Poses(max(len(fixed.poses[0]), 1)))
        self.reset()

    def reset(self) -> None:
        super().reset()
        self.add_pose(*self._fixed.poses)

    def samples(self, t: np.ndarray, a: np.ndarray, b: np.ndarray) -> Samples:
        return self._fixed.shared(super().samples(t, a, b))


def orientation_remarks(
    anchors: Anchors, effects: EffectSet | None, model: Model | None = None
) -> list[str]:
    """Return a sentence on what needs orientations that the Anchors lack; [] if nothing does."""
    parts = [*(effects or ()), *([model] if model else [])]
    names = sorted({part.name for part in parts if part.uses_orientations})
    lacking = np.isnan(anchors.orientations).any(axis=1)
    if not names or not lacking.any():
        return []
    need = f"{listed(names)} need{'s' if len(names) == 1 else ''}"
    of = "" if lacking.all() else f" of {counted(map(str, anchors.ids[lacking]), 'anchor')}"
    return [
        f"{need} orientations of anchors, and the survey has none{of}: what depends on them is not "
        "corrected. Survey the stands, or diagnose without it."
    ]


def _joined(*names: str) -> str:
    """Return names, joined by '+', or "none"."""
    return "+".join(filter(None, names)) or "none"


def warm_up(effects: EffectSet, model: Model | None, lag: float = POSE_LAG) -> Corrector:
    """Return a Corrector after one correction.

    The first correction compiles the functions, or loads them from numba's cache.
    """
    corrector = Corrector(Anchors.from_positions(np.eye(3)), effects, model, lag)
    corrector.add_pose(
        np.zeros(1), *parts_of(np.eye(1, POSE_NUMBERS, 6), np.zeros((1, TWIST_NUMBERS)))
    )
    corrector.correct(np.array([1.0]), np.array([0]), np.array([1]), np.array([0.0]))
    return corrector


class PoseArrays(NamedTuple):
    """Poses as arrays.

    Attributes
    ----------
    t : (m,) s
    p : (m, 3) m, world
    q : (m, 4) x y z w, body to world
    v : (m, 3) m/s, world; NaN if unknown
    yaw_std : (m,) rad
    """

    t: np.ndarray
    p: np.ndarray
    q: np.ndarray
    v: np.ndarray
    yaw_std: np.ndarray


class Poses:
    """Poses in the order of their stamps; at least the last `history` are kept.

    No pose is used in the first `start` s after the first pose. The first pose may arrive that much
    later than its stamp without changing a result.

    begin : stamp, s, from which poses are used: `start` s after the first pose; inf before it
    """

    def __init__(self, history: int = HISTORY, start: float = START) -> None:
        self._start = start
        self._columns = PoseArrays(
            *(np.empty((2 * history, *shape)) for shape in ((), (3,), (4,), (3,), ()))
        )
        self.clear()

    def clear(self) -> None:
        """Delete all poses."""
        self._count, self.begin = 0, math.inf

    @property
    def kept(self) -> PoseArrays:
        """All kept poses."""
        return PoseArrays(*(column[: self._count] for column in self._columns))

    @property
    def newest(self) -> float:
        """Stamp of the last pose, s; -inf if there is none."""
        return self._columns.t[self._count - 1] if self._count else -np.inf

    def add(
        self, t: ArrayLike, p: ArrayLike, q: ArrayLike, v: ArrayLike, yaw_std: ArrayLike
    ) -> None:
        """Append one pose, or k poses; poses not later than all before them are ignored.

        Parameters
        ----------
        t : (k,) s
        p : (k, 3) m
        q : (k, 4) x y z w
        v : (k, 3) m/s
        yaw_std : (k,) rad
        """
        parts: Any = (t, p, q, v, yaw_std) if np.ndim(t) else ([t], [p], [q], [v], [yaw_std])
        # copies, because numba compiles a function once more for arrays that cannot be written
        new = PoseArrays(*(np.array(part, dtype=float, order="C") for part in parts))
        self._count = _append(self._count, self._columns, new)
        if self._count and self.begin == math.inf:
            self.begin = float(self._columns.t[0]) + self._start

    def for_tdoas(
        self, t: np.ndarray, newest: float, lag: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the pose at which each TDOA is corrected: the newest that is old enough.

        It must be at least `lag` older than the newest earlier TDOA. If that TDOA is later than t, or
        there is none, t itself counts. While that stamp is before `begin`, there is no pose.

        Parameters
        ----------
        t : (n,) s, stamps of the TDOAs in order of arrival
        newest : s, latest stamp of all TDOAs before this batch; t[0] if there is none
        lag : s

        Returns
        -------
        rows : (n,) int, rows of `kept`; -1 if there is no pose
        p, q, yaw_std : (n, 3) m, (n, 4), (n,) rad; NaN if there is no pose
        """
        n = len(t)
        out = np.empty(n, dtype=np.int64), np.empty((n, 3)), np.empty((n, 4)), np.empty(n)
        _look_up(t, newest, (lag, self.begin), self._count, self._columns, out)
        return out


@compiled
def _append(count: int, kept: PoseArrays, new: PoseArrays) -> int:
    """Append poses that are later than all before them, and return the new count; compiled.

    A full array keeps its last half.
    """
    history = len(kept.t) // 2
    for i in range(len(new.t)):
        if not new.t[i] > (kept.t[count - 1] if count else -np.inf):
            continue
        if count == 2 * history:
            kept.t[:history] = kept.t[history:]
            kept.p[:history] = kept.p[history:]
            kept.q[:history] = kept.q[history:]
            kept.v[:history] = kept.v[history:]
            kept.yaw_std[:history] = kept.yaw_std[history:]
            count = history
        kept.t[count], kept.yaw_std[count] = new.t[i], new.yaw_std[i]
        kept.p[count], kept.q[count], kept.v[count] = new.p[i], new.q[i], new.v[i]
        count += 1
    return count


@compiled
def _look_up(
    t: np.ndarray,
    newest: float,
    limits: tuple[float, float],
    count: int,
    kept: PoseArrays,
    out: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Fill `out` with row, position, attitude and yaw deviation of the pose for each TDOA; compiled.

    t, newest, limits = (lag, begin), out : as in `Poses.for_tdoas`; count : number of poses in `kept`
    """
    rows, p, q, yaw_std = out[0], out[1], out[2], out[3]
    lag, begin = limits[0], limits[1]
    stamps = np.empty(len(t))  # s, of the TDOA before each
    precede(t, newest, stamps)
    for i in range(len(t)):
        row = -1
        if stamps[i] >= begin:
            row = np.searchsorted(kept.t[:count], stamps[i] - lag, side="right") - 1
        rows[i] = row
        if row >= 0:
            p[i], q[i], yaw_std[i] = kept.p[row], kept.q[row], kept.yaw_std[row]
        else:
            p[i], q[i], yaw_std[i] = np.nan, np.nan, np.nan


def known_yaw_std(std: np.ndarray) -> np.ndarray:
    """Return the standard deviation of the yaw, (n,) rad.

    It is 0 where the tilt is unknown: such a filter estimates no attitude, and means level at yaw 0.

    std : (n, 3) rad, of the attitude about the axes of the world
    """
    return np.where(np.maximum(std[:, 0], std[:, 1]) < TILT, std[:, 2], 0.0)


def parts_of(
    poses: np.ndarray, twists: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the input of a Corrector from numbers of nav_msgs/Odometry.

    Parameters
    ----------
    poses : (n, 43), PoseWithCovariance, in the order of the message
    twists : (n, 42), TwistWithCovariance, body, in the order of the message

    Returns
    -------
    p, q, v, yaw_std : (n, 3) m, (n, 4) x y z w, (n, 3) m/s, world, (n,) rad; q is NaN for the
        orientation (0, 0, 0, 0), which means unknown
    """
    p, q, v, std = (np.empty((len(poses), k)) for k in (3, 4, 3, 3))
    _part(poses, twists, p, q, v, std)
    return p, q, v, known_yaw_std(std)


@compiled
def _part(
    poses: np.ndarray,
    twists: np.ndarray,
    p: np.ndarray,
    q: np.ndarray,
    v: np.ndarray,
    std: np.ndarray,
) -> None:
    for n in range(len(poses)):
        p[n], q[n] = poses[n, :3], poses[n, 3:7]
        if not q[n].any():
            q[n] = np.nan
        x, y, z, w = q[n]
        a, b, c = twists[n, :3]
        # R(q) v = v + w d + (x, y, z) x d, with d = 2 (x, y, z) x v
        d, e, f = (2.0 * (y * c - z * b), 2.0 * (z * a - x * c), 2.0 * (x * b - y * a))
        v[n, 0], v[n, 1], v[n, 2] = (
            a + w * d + y * f - z * e,
            b + w * e + z * d - x * f,
            c + w * f + x * e - y * d,
        )
        for axis in range(3):
            std[n, axis] = math.sqrt(max(poses[n, 7 + 7 * (3 + axis)], 0.0))


def rotated_in_yaw(q: np.ndarray, quarters: int) -> np.ndarray:
    """Return attitudes turned about the vertical by some quarters of a turn.

    q : (n, 4) x y z w
    """
    s, c = np.sin(0.25 * np.pi * quarters), np.cos(0.25 * np.pi * quarters)
    x, y, z, w = q.T
    return np.stack([c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z], axis=1)
