"""What a layout of anchors is judged by."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError

from .judging import Demand, judge
from .pairing import PAIRINGS
from .precision import bound, information, position_error

if TYPE_CHECKING:
    from uwb_tdoa_bias.foundation.anchors import Anchors

    from .installation import Installation

OBJECTIVES = ("worst", "mean")
UNUSABLE = (
    100.0  # m, what an infinite bound counts for, and a layout from which no position follows
)


@dataclass(frozen=True)
class Goal:
    """What a layout is judged by.

    points : (n, 3) m, where the tag is to be located; installation : what is not the anchors;
        pairing : name of
    PAIRINGS
    objective : "worst" or "mean" bound over the points; demand : Demand, what counts as failure
    """

    points: np.ndarray
    installation: Installation
    pairing: str = "ring"
    objective: str = "worst"
    demand: Demand = field(default_factory=Demand)

    def installed(self, anchors: Anchors, heard: int | None = None) -> Installation:
        """The Installation with other Anchors, of which so many are heard in a hall.

        Raises InputError for anchors that locate nothing.
        """
        return replace(
            self.installation,
            anchors=anchors,
            pairing=PAIRINGS[self.pairing](heard or len(anchors)),
        )

    def errors(self, anchors: Anchors) -> np.ndarray:
        """Bound at the points, without the small second term of eq. 1: (n,) m. Raises InputError
        for useless anchors.
        """
        found = position_error(
            bound(information(self.points, self.installed(anchors), correction=False))
        )
        return np.minimum(found, UNUSABLE)

    def figures(self, anchors: Anchors) -> dict[str, float]:
        """{"worst", "mean": m, bound over the points; "failing": share of the points that are not
        flyable}.
        """
        errors = self.errors(anchors)
        failing = 1.0 - np.mean(judge(self.points, self.installed(anchors), self.demand).flyable)
        return {
            "worst": float(errors.max()),
            "mean": float(errors.mean()),
            "failing": float(failing),
        }

    def score(self, anchors: Anchors) -> float:
        """What is minimised: the objective, m, twice that where the tag fails at all points."""
        try:
            found = self.figures(anchors)
        except InputError:
            return 2.0 * UNUSABLE
        return found[self.objective] * (1.0 + found["failing"])
