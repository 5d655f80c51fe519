"""The frame of the survey is not quite that of the ground truth."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..foundation.later import rotations
from .base import Effect
from .marks import Shift
from .samples import RADIO
from .wording import listed, measured

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..foundation.anchors import Anchors
    from .samples import Samples

KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
DEGREES = 180.0 / np.pi


class TruthFrame(Effect):
    """In the frame of the truth, an anchor surveyed at A stands at R A + (x, y, z), R of the
    rotation vector (roll, pitch, yaw). Which of the two frames is right is not observable, so that
    nodes are not given it. Where effects.yaml has it, correcting it moves the anchors, so that
    estimates come out in the frame of the truth.
    """

    name = "truth_frame"
    unit = "m, rad"
    bound = 5.0
    negligible = 0.01
    typical = 0.15
    example = "z"
    physics = (
        "survey and motion capture do not share one frame: all anchors are shifted and turned "
        "together"
    )
    confounded_with = ("tag_lever_arm", "anchor_position")
    reference = "rigid alignment of two coordinate frames"
    needs_reference = True
    portable = False
    usable = False
    channels = tuple(RADIO)
    unused = (
        "whether the survey or the ground truth is turned or shifted nobody can tell, so that "
        "nothing goes to the nodes"
    )

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        return [KEYS, KEYS[:3], KEYS[3:], *((key,) for key in KEYS)]

    @classmethod
    def bound_of(cls, key: str) -> float:
        return cls.bound if key in "xyz" else 0.5

    @classmethod
    def typical_of(cls, key: str) -> float:
        return cls.typical if key in "xyz" else 0.03

    def _moved(self, anchors: Anchors) -> np.ndarray:
        at = np.array([self.values.get(key, 0.0) for key in KEYS])
        return anchors.positions @ rotations.Rotation.from_rotvec(at[3:]).as_matrix().T + at[:3]

    def bias(self, samples: Samples) -> np.ndarray:
        return samples.true(positions=self._moved(samples.anchors)) - samples.true()

    def regressors(self, samples: Samples, keys: Sequence[str]) -> np.ndarray:
        out, step = np.empty((len(samples), len(keys))), 1e-5
        for column, key in enumerate(keys):
            here = self.values.get(key, 0.0)
            ends = [TruthFrame({**self.values, key: here + s}).bias(samples) for s in (-step, step)]
            out[:, column] = (ends[1] - ends[0]) / (2.0 * step)
        return out

    def advice(self) -> tuple[str, ...]:
        parts = []
        for key in (key for key in KEYS if key in self.significant()):
            factor, unit = (1.0, "m") if key in "xyz" else (DEGREES, "degrees")
            parts.append(
                f"{key} "
                f"{measured(self.values[key] * factor, self.std.get(key, 0.0) * factor, unit)}"
            )
        if not parts:
            return ()
        return (
            "Align the frames of the survey and of the ground truth anew: seen from the "
            "ground truth, all anchors are "
            f"shifted and turned together by {listed(parts)}.",
        )

    def marks(self, anchors: Anchors) -> tuple[Shift, ...]:
        by = self._moved(anchors) - anchors.positions
        return tuple(
            Shift(int(anchor), shift, np.full(3, np.nan)) for anchor, shift in zip(anchors.ids, by)
        )
