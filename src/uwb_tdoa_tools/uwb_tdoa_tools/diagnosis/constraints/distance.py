"""A distance between two anchors, by laser or by radio."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np

if TYPE_CHECKING:
    from uwb_tdoa_bias.foundation.anchors import Anchors


@dataclass(frozen=True)
class Distance:
    """Anchors of ids a and b are `distance` apart +- std, m."""

    a: int
    b: int
    distance: float
    std: float
    flight: ClassVar[None] = None  # it is of the anchors

    def equations(self, anchors: Anchors, columns: int) -> tuple[np.ndarray, np.ndarray]:
        """The distance of two Anchors is off by what their shifts along the line between them tell.
        columns : number of parameters.
        """
        first, second = anchors.index(np.array([self.a, self.b]))
        line = anchors.positions[first] - anchors.positions[second]
        length = max(float(np.linalg.norm(line)), 1e-6)
        row = np.zeros(columns)
        row[3 * first : 3 * first + 3], row[3 * second : 3 * second + 3] = (
            line / length,
            -line / length,
        )
        return np.outer(row, row) / self.std**2, row * (self.distance - length) / self.std**2
