"""What is planned with: anchors, their radio, which TDOAs they give, and whether height is known."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import ConvexHull, Delaunay

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError

from ..checking.coverage import sides_of, to_copy
from .noise import RadioNoise
from .pairing import Pairing, ring

if TYPE_CHECKING:
    from .noise import FixedNoise

SAME_PLACE = 0.01  # m; two anchors nearer than this are one
# of the largest distance: anchors this close to one plane (line) cannot tell its two sides apart
FLAT = 0.01


@dataclass(frozen=True)
class Installation:
    """Anchors and all that decides how well they locate a tag. Raises InputError for anchors that
    cannot.

    Attributes
    ----------
    anchors : Anchors
    noise : RadioNoise or FixedNoise: how well a reception is timed
    pairing : Pairing, the TDOAs of one round (default: the ring of TDOA2)
    link_std : m, error that every TDOA has of its own, besides those of the tag's receptions
        (default 0)
    dimensions : 3, or 2 for a tag whose height is known
    height_std : m, of a height sensor on the tag beside every round of TDOAs; inf for none
        (default)
    hall : each place hears a part of the anchors, which may be few, or in a plane; `pairing` is
        then of those (default False)
    """

    anchors: Anchors
    noise: RadioNoise | FixedNoise = field(default_factory=RadioNoise)
    pairing: Pairing = None  # type: ignore[assignment]  # __post_init__ puts a ring there
    link_std: float = 0.0
    dimensions: int = 3
    height_std: float = np.inf
    hall: bool = False

    def __post_init__(self) -> None:
        if not self.height_std > 0.0 or (self.dimensions == 2 and self.height_std < np.inf):
            raise InputError(
                f"height std: {self.height_std!r} m is not the standard deviation of a height "
                "sensor; give one above 0, "
                "e.g. 0.02, and none for a tag of known height."
            )
        if not self.hall:
            check_anchors(self.anchors, self.unknowns)
        if self.pairing is None:
            object.__setattr__(self, "pairing", ring(len(self.anchors)))
        if not 0.0 <= self.link_std < 100.0:
            raise InputError(
                f"link noise: {self.link_std!r} m is not a standard deviation; give 0 or "
                "more, e.g. 0.05."
            )

    def of(self, anchors: Anchors) -> Installation:
        """The same with other Anchors, of which each place hears a part."""
        return replace(self, anchors=anchors, hall=True)

    @property
    def unknowns(self) -> int:
        """Coordinates that TDOAs alone must determine: 2 where a height is known or measured, else
        3.
        """
        return 2 if self.height_std < np.inf else self.dimensions

    def with_height(self, information: np.ndarray) -> np.ndarray:
        """Information (n, k, k) 1/m^2 of TDOAs about the position, with that of the height sensor
        added.
        """
        if self.height_std < np.inf:
            information = information + np.diag([0.0, 0.0, self.height_std**-2])
        return information

    def inside_hull(self, points: np.ndarray) -> np.ndarray:
        """Whether points (n, 3) are inside the convex hull of the anchors (seen from above if
        height is known or measured): (n,).
        """
        k = self.unknowns
        hull = Delaunay(self.anchors.positions[:, :k])
        return hull.find_simplex(points[:, :k]) >= 0

    def hull_outline(self) -> np.ndarray:
        """Corners of the hull seen from above, in order and closed: (k + 1, 2) m."""
        above = self.anchors.positions[:, :2]
        corners = ConvexHull(above).vertices
        return above[np.append(corners, corners[0])]


def check_anchors(anchors: Anchors, dimensions: int) -> None:
    """Raise InputError, with what to do, for anchors from which no position follows."""
    what = {2: "a position at known height", 3: "a position in space"}[dimensions]
    if len(anchors) < dimensions + 1:
        raise InputError(
            f"anchors: {len(anchors)} were given; {what} needs at least {dimensions + 1}."
        )
    away = np.linalg.norm(anchors.positions[:, None] - anchors.positions, axis=-1) + 1e9 * np.eye(
        len(anchors)
    )
    i, j = np.unravel_index(np.argmin(away), away.shape)
    if away[i, j] < SAME_PLACE:
        raise InputError(
            f"anchors: {anchors.ids[i]} and {anchors.ids[j]} are at the same place; move or "
            "delete one."
        )
    size = principal_extents(anchors.positions[:, :dimensions])
    if size[1] <= FLAT * size[0]:
        seen = "seen from above " if dimensions == 2 else ""
        raise InputError(
            f"anchors: all are on one line {seen}to {size[1]:.3f} m; move one of them out of it."
        )
    if dimensions == 3 and size[2] <= FLAT * size[0]:
        sides = sides_of(anchors.positions)
        raise InputError(
            f"anchors: all are in one plane to {size[2]:.3f} m, so that its two sides cannot "
            "be told apart; move one "
            "of them out of it, or plan for a tag of known height (--planar) or one that "
            "measures it (--with height)"
            f"{'; or ' + to_copy(sides) if sides else ''}."
        )


def principal_extents(positions: np.ndarray) -> np.ndarray:
    """Extent of positions (..., N, k) along their principal axes, the longest first: (..., k) m."""
    centred = positions - positions.mean(axis=-2, keepdims=True)
    return np.ptp(
        centred @ np.linalg.svd(centred, full_matrices=False)[2].swapaxes(-1, -2), axis=-2
    )
