"""Corrections of a whole recording at the poses of an earlier run: what another model would change,
without finding the poses anew, one batch after the other.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .corrector import EFFECTS, Correction, Corrector

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..common.anchors import Anchors
    from ..effects.effect_set import EffectSet


class FixedPoseCorrector(Corrector):
    """Corrects a recording at the poses that a run with another model has had."""

    idle = True  # nothing of this run is waited for

    def __init__(
        self, anchors: Anchors, effects: EffectSet | None, poses: Sequence[np.ndarray]
    ) -> None:
        """poses : (t (k,) s, p (k, 3) m, q (k, 4), v (k, 3) m/s, yaw_std (k,) rad) of the other
        run, as `add_pose` takes them.
        """
        self._known = poses
        super().__init__(anchors, effects, history=max(len(poses[0]), 1))

    def reset(self) -> None:
        super().reset()
        self.add_pose(*self._known)

    def correct(self, t: np.ndarray, a: np.ndarray, b: np.ndarray, d: np.ndarray) -> Correction:
        if len(t) == 0:
            return Correction.none(d)
        bias, noise, slope, state = self.contribution(self.samples(t, a, b))
        return Correction(
            bias, noise, d - bias, np.full(len(t), EFFECTS, dtype=np.uint8), slope, state
        )
