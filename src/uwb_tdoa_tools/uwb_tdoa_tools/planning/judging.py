"""Whether a tag can be flown at a place, and if not, why: what it hears is too little, imprecise,
or has two solutions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.foundation.errors import InputError

from ..simulation.rooms import Room
from .bifurcation import Subsets
from .precision import bound, information, position_error, range_weights
from .second_minimum import CLEAR, second_minima

if TYPE_CHECKING:
    from .installation import Installation

# m, of the bound of one round, beyond which a place counts as imprecise unless somebody asks for
# another
ACCURACY = 0.5
CRITERIA = {
    "round": "a whole round of all that is heard has one solution",
    "pairings": (
        "every choice of k + 1 anchors alone has one solution, inside their hull (Grasso et al., "
        "sec. 2.3.2)"
    ),
}
FLYABLE, TWO_SOLUTIONS, IMPRECISE, TOO_FEW, OUTSIDE = range(
    5
)  # of a place; OUTSIDE of the hull counts with "pairings" only
_CHUNK = 2_000_000  # numbers in the largest array of one step
_EVERYWHERE = Room(np.full(3, -np.inf), np.full(3, np.inf))


@dataclass(frozen=True)
class Demand:
    """What is asked of a place. room : Room in which a second solution counts; accuracy : m,
    largest bound of one round; criterion : of CRITERIA; quick : no second solution is looked for,
    and the bound is that of the errors' means alone, as a search needs. Raises InputError.
    """

    room: Room = _EVERYWHERE
    accuracy: float = ACCURACY
    criterion: str = "round"
    quick: bool = False

    def __post_init__(self) -> None:
        if not 0.0 < self.accuracy < np.inf:
            raise InputError(
                f"accuracy: {self.accuracy!r} m is none; give the largest bound of one round, "
                "above 0, e.g. 0.3."
            )


@dataclass(frozen=True)
class Judged:
    """Of n places: covariance (n, k, k) m^2, bound of one round; error (n,) m, root of its trace;
    status (n,) int, FLYABLE or why not.
    """

    covariance: np.ndarray
    error: np.ndarray
    status: np.ndarray

    @property
    def flyable(self) -> np.ndarray:
        """(n,) bool."""
        return self.status == FLYABLE

    def part(self, rows: np.ndarray) -> Judged:
        """Judged of some of its places."""
        return Judged(self.covariance[rows], self.error[rows], self.status[rows])

    def put(self, rows: np.ndarray, found: Judged) -> None:
        """Put what was found at some of its places there."""
        self.covariance[rows], self.error[rows], self.status[rows] = (
            found.covariance,
            found.error,
            found.status,
        )


def judge(
    points: np.ndarray,
    installation: Installation,
    demand: Demand,
    columns: np.ndarray | None = None,
) -> Judged:
    """Judged of points (n, 3) m. columns : (n, K) rows of the anchors that are heard at each, in
    order; None for all of them at all.
    """
    heard = len(installation.anchors) if columns is None else columns.shape[1]
    n, k = len(points), installation.dimensions
    if heard <= installation.unknowns:
        return Judged(np.full((n, k, k), np.inf), np.full(n, np.inf), np.full(n, TOO_FEW))
    covariance = bound(information(points, installation, not demand.quick, columns))
    error = position_error(covariance)
    status = np.where(error <= demand.accuracy, FLYABLE, IMPRECISE)
    if demand.quick:
        return Judged(covariance, error, status)
    if demand.criterion == "pairings":
        status[Subsets(installation.anchors, installation.unknowns).ambiguous(points) > 0.0] = (
            TWO_SOLUTIONS
        )
        status[~installation.inside_hull(points)] = OUTSIDE
        return Judged(covariance, error, status)
    misfit, _ = other_solutions(points, installation, demand.room, columns)
    status[misfit <= CLEAR] = TWO_SOLUTIONS
    return Judged(covariance, error, status)


def other_solutions(
    points: np.ndarray, installation: Installation, room: Room, columns: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """(misfit (n,) standard deviations, place (n, 3) m) of `second_minima` of a round at points (n,
    3) m; columns : as of `judge`.
    """
    anchors = installation.anchors
    if columns is None:
        columns = np.broadcast_to(np.arange(len(anchors)), (len(points), len(anchors)))
    heard = columns.shape[1]
    misfits, places = [np.empty(0)], [np.empty((0, 3))]
    for rows in np.array_split(
        np.arange(len(points)), max(1, len(points) * max(heard**2, len(anchors)) // _CHUNK)
    ):
        variance = np.take_along_axis(
            installation.noise.variance(points[rows], anchors), columns[rows], axis=1
        )
        weights = np.ascontiguousarray(
            range_weights(variance, installation.pairing, installation.link_std)
        )
        misfit, place = second_minima(
            points[rows],
            anchors.positions,
            np.ascontiguousarray(columns[rows]),
            weights,
            room,
            installation.unknowns,
        )
        misfits.append(misfit)
        places.append(place)
    return np.concatenate(misfits), np.concatenate(places)
