# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Correct raw TDOAs: the core of bias_node and of the offline filter."""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
from typing import TYPE_CHECKING

import numpy as np

from ..common.anchors import Anchors
from ..common.errors import InputError
from ..effects import EffectSet, Samples
from ..effects.samples import N_STATES, POSE_LAG, motion_at
from .model import EFFECTS, FADED, NETWORK, PASSED, Prediction
from .poses import POSE_NUMBERS, TWIST_NUMBERS, Poses, parts_of, rotated_in_yaw

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from ..common.anchors import Anchors
    from ..effects.effect_set import EffectSet
    from .model import Model


# rad. A yaw with a larger standard deviation is unknown: then the filter follows four yaws,
# 90 degrees apart.
LARGEST_YAW_STD = 1.0


@dataclass(frozen=True)
class Correction:
    """Corrections of n TDOAs.

    Attributes
    ----------
    bias, std : (n,) m
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
    def flat(
        cls, d: np.ndarray, bias: np.ndarray, std: np.ndarray, status: np.ndarray
    ) -> Correction:
        """Return the Correction of raw d (n,) m by a bias (n,) m that is constant in the state."""
        return cls(bias, std, d - bias, status, *np.zeros((2, len(d), N_STATES)))

    @classmethod
    def none(cls, d: np.ndarray) -> Correction:
        """Return the Correction of raw d (n,) m without any known bias."""
        bias, std = np.zeros((2, len(d)))
        return cls.flat(d, bias, std, np.full(len(d), PASSED, dtype=np.uint8))


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
        network: Model | None = None,
        lag: float = POSE_LAG,
        poses: Poses | None = None,
    ) -> None:
        """Set the bias model.

        Parameters
        ----------
        anchors : Anchors
        effects : EffectSet or None; hypotheses, which the filter weighs, are not corrected: see `weighed`
        network : Model or None
        lag : s
        poses : Poses that other Correctors use, too; by default its own
        """
        self.anchors = anchors
        effects = EffectSet() if effects is None else effects
        self.effects = effects.where(lambda effect: not effect.is_hypothesis)
        self.weighed = effects.where(lambda effect: effect.is_hypothesis)
        self.network = network
        held = network.holds if network else ()
        twice = set(held) & {effect.label for effect in self.effects}
        if twice:
            raise InputError(
                f"effects: {min(twice)} is in the model too, which holds {', '.join(held)}; leave "
                "it out of the effects."
            )
        self.lag = lag
        own = self.effects.name if len(self.effects) else ""
        self.model = _joined(own, network.name if network else "")
        of_effects = _joined(own, network.of_effects if network else "")
        self.models = {PASSED: "none", EFFECTS: of_effects, NETWORK: self.model, FADED: self.model}
        self._poses = Poses() if poses is None else poses
        self._begin()

    def reset(self) -> None:
        """Delete all poses."""
        self._poses.clear()
        self._begin()

    def _begin(self) -> None:
        self._latest: Samples | None = None  # of the latest TDOAs
        self._newest: float = None  # type: ignore[assignment]  # latest stamp of a TDOA, once there is one
        self._first = math.nan  # stamp of the first TDOA, once there is one
        self._last: tuple[float, int] | None = None  # stamp and later anchor of the last one

    def change_anchors(self, anchors: Anchors) -> None:
        """Continue with other Anchors and the known poses."""
        self.anchors, self._latest, self._last = anchors, None, None

    @property
    def _has_model(self) -> bool:
        return len(self.effects) > 0 or self.network is not None

    @property
    def idle(self) -> bool:
        """True without effects and network."""
        return not self._has_model

    @property
    def outside(self) -> list[str]:
        """Phrases on effects that faded by more than half for some of the latest TDOAs.

        Such TDOAs were measured outside of the domain of the effect.
        """
        return [] if self._latest is None else self.effects.outside(self._latest)

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

    def ready(self, before: float) -> bool:
        """Return whether no future pose can change the correction of a TDOA.

        before : stamp of the TDOA that precedes it, s
        """
        return (
            self.idle
            or self._poses.newest > before - self.lag
            or before < self._poses.begin < math.inf
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
        if not self._has_model or len(t) == 0:
            return Correction.none(d)
        self._latest = samples = self.samples(t, a, b)
        bias, std, status, slope, state = self.prediction(samples)
        return Correction(bias, std, d - bias, status.astype(np.uint8), slope, state)

    def prediction(self, samples: Samples) -> Prediction:
        """Return the Prediction of Samples by effects and network."""
        bias, std, slope, state = self.contribution(samples)
        status = np.full(len(samples), float(EFFECTS if len(self.effects) else PASSED))
        known = Prediction(bias, std, status, slope, state)
        return known if self.network is None else self.network.added(samples, known)

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
            of_steep, slope, curved = steep.bias_jacobian(samples)
            bias = bias + of_steep
            noise = np.hypot(noise, curved)
            state = samples.linearization_point
        unknown: np.ndarray = np.zeros(len(samples), bool)
        if samples.yaw_std is not None:
            unknown = samples.yaw_std > LARGEST_YAW_STD
        turning = self.effects.of_attitude
        if len(turning) and unknown.any():
            headings = np.concatenate(
                [samples.q, *(rotated_in_yaw(samples.q, k) for k in range(4))]
            )
            headed = turning.bias(replace(samples.repeated(5), q=headings)).reshape(5, -1)
            known, each = headed[0], headed[1:]
            bias = np.where(unknown, bias - known + each.mean(axis=0), bias)
            noise = np.where(unknown, np.hypot(noise, each.std(axis=0)), noise)
        if len(steep) and unknown.any():
            level = steep.where(lambda effect: not effect.uses_attitude).bias_jacobian(samples)[1]
            slope = np.where(unknown[:, None], level, slope)
        return bias, noise, slope, state

    def samples(self, t: np.ndarray, a: np.ndarray, b: np.ndarray) -> Samples:
        """Return the Samples of a batch at the poses known so far; parameters as for `correct`."""
        if self._newest is None:
            self._first = self._newest = t[0]
        places, p, q, yaw_std = self._poses.before(t, self._newest, self.lag)
        self._newest = max(self._newest, t.max())
        samples = Samples(t, a, b, p, q, self.anchors, self._first, yaw_std=yaw_std)
        if not (self.effects.needs_motion or (self.network and self.network.needs_motion)):
            return samples
        kept = self._poses.kept
        last_t, last_b = self._last or (t[0], -1)
        self._last = (t[-1], self.anchors.ids[b[-1]])
        return replace(
            samples,
            motion=motion_at(kept.t, kept.v, kept.q, places),
            interval=t - np.concatenate([[last_t], t[:-1]]),
            previous=np.concatenate([[last_b], self.anchors.ids[b[:-1]]]),
        )


def _joined(*names: str) -> str:
    """Return names, joined by '+', or "none"."""
    return "+".join(filter(None, names)) or "none"


def warm_up(effects: EffectSet, network: Model | None, lag: float = POSE_LAG) -> Corrector:
    """Return a Corrector after one correction.

    The first correction compiles the functions, or loads them from numba's cache.
    """
    corrector = Corrector(Anchors.from_positions(np.eye(3)), effects, network, lag)
    corrector.add_pose(
        np.zeros(1), *parts_of(np.eye(1, POSE_NUMBERS, 6), np.zeros((1, TWIST_NUMBERS)))
    )
    corrector.correct(np.array([1.0]), np.array([0]), np.array([1]), np.array([0.0]))
    return corrector


class FixedPoseCorrector(Corrector):
    """Corrects a recording at the poses of an earlier run with another model."""

    idle = True  # no waiting for poses

    def __init__(
        self, anchors: Anchors, effects: EffectSet | None, poses: Sequence[np.ndarray]
    ) -> None:
        """Set the poses of the earlier run.

        poses : (t (k,) s, p (k, 3) m, q (k, 4), v (k, 3) m/s, yaw_std (k,) rad), as for `add_pose`
        """
        self._known = poses
        super().__init__(anchors, effects, poses=Poses(max(len(poses[0]), 1)))
        self.reset()

    def reset(self) -> None:
        super().reset()
        self.add_pose(*self._known)
