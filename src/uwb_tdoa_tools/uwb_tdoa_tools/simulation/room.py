"""The room a flight takes place in: what the anchors span, and the part of it that is comfortable
to fly in.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from uwb_tdoa_bias.foundation.anchors import Anchors

CLEARANCE = 0.8  # m from the walls
FLOOR_CLEARANCE = 0.6  # m from floor and ceiling
REST_HEIGHT = 0.03  # m, height of the body frame when the vehicle stands on the floor


@dataclass(frozen=True)
class Room:
    """A box. lower, upper : (3,) corners in the world frame, metres; the floor is at lower[2]. area
    : ((x, y), (x, y)) m, lower and upper corner of the part that paths are sized to; None for all
    but a clearance.
    """

    lower: np.ndarray
    upper: np.ndarray
    area: tuple[tuple[float, ...], ...] | None = None

    @property
    def centre(self) -> np.ndarray:
        """(3,) metres: of the area, if there is one."""
        if self.area is None:
            return 0.5 * (self.lower + self.upper)
        return 0.5 * np.sum(self.flyable, axis=0)

    @property
    def flyable(self) -> tuple[np.ndarray, np.ndarray]:
        """The box that paths are sized to, (lower, upper), each (3,) metres: the area, or else the
        room less a clearance.
        """
        margin = np.minimum(
            [CLEARANCE, CLEARANCE, FLOOR_CLEARANCE], 0.25 * (self.upper - self.lower)
        )
        low, high = self.lower + margin, self.upper - margin
        if self.area is not None:
            low[:2], high[:2] = self.area
        return low, high

    def around(self, points: np.ndarray) -> Room:
        """The Room, grown to hold points (n, 2 or 3), m."""
        k = points.shape[1]
        lower, upper = self.lower.copy(), self.upper.copy()
        lower[:k], upper[:k] = (
            np.minimum(lower[:k], points.min(axis=0)),
            np.maximum(upper[:k], points.max(axis=0)),
        )
        return replace(self, lower=lower, upper=upper)


def room_of(anchors: Anchors) -> Room:
    """The room that Anchors stand in: the box around them, at least 4 x 4 x 2.5 m, floor at 0 or
    the lowest anchor.
    """
    lowest, highest = anchors.positions.min(axis=0), anchors.positions.max(axis=0)
    middle, half = 0.5 * (lowest + highest), np.maximum(0.5 * (highest - lowest), 2.0)
    floor = min(0.0, lowest[2])
    return Room(
        np.array([middle[0] - half[0], middle[1] - half[1], floor]),
        np.array([middle[0] + half[0], middle[1] + half[1], max(highest[2], floor + 2.5)]),
    )
