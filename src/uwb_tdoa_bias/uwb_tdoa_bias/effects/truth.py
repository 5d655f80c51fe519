# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Effects of the ground truth: its frame and its stamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..common.anchors import Anchors
from ..common.lazy import rotations
from ..common.sensors import DIAGNOSED
from .base import GeometryEffect, Row, Shift, central_differences
from .samples import Samples
from .stamps import STAMP, StampEffect

KEYS = ("x", "y", "z", "roll", "pitch", "yaw")
DEGREES = 180.0 / np.pi
STEP = 1e-5  # m and rad, of central differences
ANGLE_BOUND, ANGLE_PRIOR_STD = 0.5, 0.03  # rad


class TruthFrame(GeometryEffect):
    """In the frame of the truth, an anchor surveyed at A is at R A + (x, y, z).

    R turns by the rotation vector (roll, pitch, yaw). The data do not determine which of the two
    frames is right: `diagnose` gives this effect to no node. In an effects.yaml it moves the
    anchors, and estimates are in the frame of the truth.
    """

    row = Row(
        name="truth_frame",
        unit="m, rad",
        bound=5.0,
        negligible=0.01,
        prior_std=0.15,
        example="z",
        physics=(
            "survey and motion capture do not share one frame: all anchors are shifted and turned "
            "together"
        ),
        reference="rigid alignment of two coordinate frames",
        confounded_with=("tag_lever_arm", "anchor_position"),
        remedy=(
            "Align the frames of the survey and of the ground truth anew: seen from the "
            "ground truth, all anchors are shifted and turned together by {found}."
        ),
        phrase="{key} {value}",
    )
    other_units = dict.fromkeys(KEYS[3:], "rad")
    needs_reference = True
    portable = False
    usable = False
    why_unusable = (
        "whether the survey or the ground truth is turned or shifted nobody can tell, so that "
        "nothing goes to the nodes"
    )

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        return [KEYS, KEYS[:3], KEYS[3:], *((key,) for key in KEYS)]

    @classmethod
    def bound_of(cls, key: str) -> float:
        return cls.bound if key in "xyz" else ANGLE_BOUND

    @classmethod
    def prior_std_of(cls, key: str) -> float:
        return cls.prior_std if key in "xyz" else ANGLE_PRIOR_STD

    def shown_in(self, key: str) -> tuple[str, float]:
        return ("m", 1.0) if key in "xyz" else ("degrees", DEGREES)

    def antennas(self, samples: Samples) -> dict[str, np.ndarray]:
        return {"positions": self._positions(samples.anchors)}

    def _positions(self, anchors: Anchors) -> np.ndarray:
        at = np.array([self.values.get(key, 0.0) for key in KEYS])
        return anchors.positions @ rotations.Rotation.from_rotvec(at[3:]).as_matrix().T + at[:3]

    def regressors(self, samples: Samples, keys: Sequence[str]) -> np.ndarray:
        return central_differences(
            lambda values: TruthFrame(values).bias(samples), self.values, keys, STEP
        )

    def marks(self, anchors: Anchors) -> tuple[Shift, ...]:
        shifts = self._positions(anchors) - anchors.positions
        unknown = np.full(3, np.nan)
        return tuple(Shift(int(i), by, unknown) for i, by in zip(anchors.ids, shifts))


class TruthTimeOffset(StampEffect):
    """Poses of the ground truth are stamped `offset` seconds after their instant.

    Its correction changes the reference, not the estimate.
    """

    row = replace(
        STAMP,
        name="truth_time_offset",
        physics="motion-capture poses reach the log late, over a radio link",
        reference=(
            "UTIL web page: motion-capture poses logged on board have about 10 ms of radio latency"
        ),
        confounded_with=("tdoa_time_offset", "range_delay"),
        remedy=(
            "Correct the stamps of the ground truth, which are {found}: that changes what the "
            "estimate is compared with, not the estimate."
        ),
    )
    stream = "truth"
    needs_reference = True
    portable = False
    channels = ("tdoa", "gyro", *DIAGNOSED)  # vibration hides it on the accelerometer

    def regressors(self, samples: Any, keys: Sequence[str]) -> np.ndarray:
        return -super().regressors(samples, keys)  # at its stamp the tag is farther than the truth
