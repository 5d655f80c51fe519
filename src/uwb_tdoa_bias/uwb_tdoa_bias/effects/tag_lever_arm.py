"""The tag's antenna is not at the origin of the body frame."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ..foundation.geometry import rotate_each
from .base import Effect
from .samples import RADIO
from .wording import listed

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..foundation.anchors import Anchors
    from .samples import Samples


class TagLeverArm(Effect):
    """The antenna sits at p + R(q) l, with the arm l = (x, y, z) in the body frame."""

    name = "tag_lever_arm"
    unit = "m"
    bound = 2.0
    negligible = 0.01
    typical = 0.15
    example = "z"
    physics = (
        "the tag's antenna is off the origin of the body frame, by an arm that turns with the body"
    )
    confounded_with = ("truth_frame", "anchor_position")
    distinguished_by = {
        "truth_frame": (
            "a flight that turns through all headings: the arm turns with the body, the frame "
            "does not"
        ),
    }
    reference = "any text on strapdown navigation: lever arm compensation"
    uses_attitude = True
    channels = tuple(RADIO)

    @classmethod
    def groups(cls, anchors: Anchors | None, pairs: np.ndarray | None) -> list[tuple[str, ...]]:
        return [("x", "y", "z"), ("x",), ("y",), ("z",)]

    def _arm(self) -> np.ndarray:
        return np.array([self.values.get(key, 0.0) for key in "xyz"])

    def bias(self, samples: Samples) -> np.ndarray:
        return samples.true(samples.p + _rotate(samples.q, self._arm())) - samples.true()

    def regressors(self, samples: Samples, keys: Sequence[str]) -> np.ndarray:
        jacobian = samples.direction(samples.p + _rotate(samples.q, self._arm()))
        axes = np.eye(3)[["xyz".index(key) for key in keys]]
        return np.stack(
            [np.sum(jacobian * _rotate(samples.q, axis), axis=1) for axis in axes], axis=1
        )

    def advice(self) -> tuple[str, ...]:
        arm = {
            key: f"{self.size(key)} towards {'+' if v > 0.0 else '-'}{key}"
            for key, v in self.significant().items()
        }
        if not arm:
            return ()
        parts = listed(arm[key] for key in sorted(arm))
        return (
            (
                f"Measure where the tag's antenna sits on the vehicle: it is {parts} from the "
                "origin of the body frame."
            ),
        )


def _rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """R(q) v for (n, 4) quaternions x y z w, NaN where q is NaN; (n, 3)."""
    out = np.empty((len(q), 3))
    rotate_each(np.ascontiguousarray(q, dtype=float), v, out)
    return out
