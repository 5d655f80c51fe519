# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Accept a map, or state what the data leave open and what would settle it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError

from ..choices import MAP_ACCURACY
from .deviations import covariance
from .least_squares import Problem, Stage
from .search import SAME_MAP, SAME_SHAPE, minima, misfit_of, rigid_distance

if TYPE_CHECKING:
    from collections.abc import Callable

    from .least_squares import Equations, Fit
    from .observations import Observations

FEWEST = 4  # anchors of a map
AMBIGUOUS = 12.0  # cost by which another map must be worse
BEYOND = 3.0  # standard deviations within which two minima are one map
CONTRADICTING = 2.0  # robust scale of residuals of distances, in their standard deviations
DEFORMED = 0.6  # mean square of the residuals of accelerations, in their variance
CLEARER = 3.0  # misfit of accelerations with other signs of the gyroscope, multiples of the misfit
FLAT = 0.5  # m, range of the middle 80 % of the path along its flattest axis
RIGID = 4  # distances of each anchor that settle its side
UPRIGHT = 0.9  # vertical part of a normal from which heights settle the sides of a flat path
KNOWN = 0.1  # m, standard deviation of a coordinate up to which it is trusted


@dataclass(frozen=True, eq=False)
class FirstMap:
    """A map of anchors.

    Attributes
    ----------
    ids : (N,); positions : (N, 3) m, world; covariance : (3N, 3N) m^2
    trusted : (N, 3) bool, coordinates that were given
    others : positions (N, 3) m of other maps that explain the data equally well
    lasting : m, estimated size of errors of TDOAs and ranges that last
    why_not : a sentence if the map must not be used, else ""
    """

    ids: np.ndarray
    positions: np.ndarray
    covariance: np.ndarray
    trusted: np.ndarray
    others: tuple[np.ndarray, ...]
    lasting: float
    why_not: str

    @property
    def std(self) -> np.ndarray:
        """Return the standard deviations of all coordinates, (N, 3) m."""
        return np.sqrt(np.diag(self.covariance)).reshape(-1, 3)

    def anchors(self, frame: str = "map") -> Anchors:
        """Return the Anchors in a frame of this name."""
        return Anchors.from_positions(self.positions, self.ids, frame)


def map_anchors(
    seen: Observations,
    accuracy: float = MAP_ACCURACY,
    seed: int = 0,
    progress: Callable[[str], object] = lambda what: None,
) -> FirstMap:
    """Return the FirstMap of Observations.

    accuracy : m, largest 3D standard deviation of an anchor in a map that is accepted
    seed : of the search; progress is called with the current work

    Raises InputError for fewer than FEWEST anchors, and without coordinates.
    """
    if len(seen.ids) < FEWEST:
        raise InputError(
            f"a map needs {FEWEST} anchors or more; the data hold {len(seen.ids)}: record all anchors."
        )
    rng = np.random.default_rng(seed)
    fits, reached = minima(seen, rng, progress)
    progress("estimating how far the map can be off")
    best = fits[0]
    linear = Problem(seen, Stage()).about(best)
    spread, lasting = covariance(linear, best, rng)
    apart = SAME_MAP + BEYOND * np.sqrt(np.diag(spread)).reshape(-1, 3)
    near = [
        fit
        for fit in fits[1:]
        if fit.cost < best.cost + AMBIGUOUS and (np.abs(fit.anchors - best.anchors) > apart).any()
    ]
    trusted = np.zeros((len(seen.ids), 3), bool)
    row, axis = seen.coordinates[seen.coordinates[:, 3] <= KNOWN, :2].astype(int).T
    trusted[row, axis] = True
    found = FirstMap(
        seen.ids,
        best.anchors,
        spread,
        trusted,
        tuple(fit.anchors for fit in near),
        lasting,
        "",
    )
    return _judged(found, seen, linear, best, accuracy, reached)


def _judged(
    found: FirstMap, seen: Observations, linear: Equations, best: Fit, accuracy: float, reached: int
) -> FirstMap:
    """Return the FirstMap with `why_not`."""
    why = (
        _contradiction(seen, linear)
        or _handedness(seen, best)
        or _open(found, accuracy)
        or _flat(found, seen, best)
        or _imprecise(found, accuracy)
        or _unchecked(found, seen, best, accuracy)
    )
    if not why and reached < 2:
        why = (
            "only one starting point of the search led to this map, so a better one may exist; "
            "record longer flights, high and low and on all sides of the anchors"
        )
    return replace(found, why_not=why)


def _contradiction(seen: Observations, linear: Equations) -> str:
    """Return a sentence if measurements contradict each other."""
    bad = np.flatnonzero(np.nan_to_num(linear.misfit()) > DEFORMED)
    if len(bad):
        return (
            f"the accelerations of flight {bad[0] + 1} fit no path that its TDOAs or ranges allow; "
            "a faulty inertial sensor deforms the map: look at the recording with check"
        )
    between = linear.state.distance / seen.distances[:, 3]
    scale = 1.4826 * float(np.median(np.abs(between))) if len(between) else 0.0
    if scale > CONTRADICTING:
        return (
            f"the distances contradict each other by {scale:.1f} of their standard deviations; "
            "give the true ones in the column std, or --delay-std for distances by radio"
        )
    return ""


def _handedness(seen: Observations, best: Fit) -> str:
    """Return a sentence if another gyroscope explains the accelerations about as well.

    A gyroscope with a wrong sign makes a mirror image of the map, which fits all TDOAs.
    """
    given = misfit_of(seen, best.path, seen.accel)
    if not np.isfinite(given):
        return ""
    others = [misfit_of(seen, best.path, accel) for accel in seen.flipped]
    if np.nanmedian(others) > CLEARER * given:
        return ""
    return (
        "accelerations and turning rates do not show which of two mirror images is right: the flight "
        "hardly moves, or the inertial sensor has wrong axes; look at the recording with check, and "
        "fly faster, with turns"
    )


def _flat(found: FirstMap, seen: Observations, best: Fit) -> str:
    """Return a sentence if the path is in a plane, and coordinates do not settle the sides of anchors."""
    measured = np.bincount(seen.distances[:, :2].astype(int).ravel(), minlength=len(seen.ids))
    if not len(best.path) or (measured >= RIGID).all():
        return ""
    _, axes = np.linalg.eigh(np.cov(best.path.T))
    normal = axes[:, 0]
    low, high = np.percentile(best.path @ normal, [10.0, 90.0])
    settled = abs(normal[2]) > UPRIGHT and bool(found.trusted[:, 2].all())
    if high - low > FLAT or settled:
        return ""
    return (
        f"the path is flat ({high - low:.2f} m), so each anchor has a place on either side of it; fly "
        "high and low, or give the heights of all anchors (--coordinates)"
    )


def _open(found: FirstMap, accuracy: float) -> str:
    """Return a sentence if other maps explain the data equally well."""
    if not found.others:
        return ""
    if any(rigid_distance(found.positions, other, False) < SAME_SHAPE for other in found.others):
        return _TURNS
    if any(rigid_distance(found.positions, other, True) < SAME_SHAPE for other in found.others):
        return (
            "a mirror image of the map explains the data equally well; give a rough coordinate of "
            "an anchor off the line of the trusted ones (--coordinates), or add a flight with an "
            "inertial sensor"
        )
    far = [np.linalg.norm(other - found.positions, axis=1) for other in found.others]
    off = np.max(far, axis=0)
    names = ", ".join(map(str, found.ids[off > min(accuracy, 0.5)]))
    return (
        f"anchors {names or 'all'} have a second place that explains the data equally well; "
        "fly higher and lower and on all sides of them, or give a rough coordinate of each "
        "(--coordinates)"
    )


_TURNS = (
    "the map can turn about the line of the trusted anchors; give the height of a third anchor and "
    "its side (--coordinates), or add a flight with an inertial sensor"
)


def _imprecise(found: FirstMap, accuracy: float) -> str:
    """Return a sentence if the map is not known well enough."""
    off = np.linalg.norm(found.std, axis=1)
    bad = off > accuracy
    if not bad.any():
        return ""
    _, axes = np.linalg.eigh(found.covariance)
    if off.max() > 10.0 * accuracy and _is_rigid(found.positions, axes[:, -1]):
        return _TURNS
    names = ", ".join(map(str, found.ids[bad]))
    return (
        f"the data determine anchors {names} to {off.max():.1f} m only, {accuracy:g} m are wanted "
        "(--accuracy); fly farther out, high and low and on all sides, or measure distances or "
        "coordinates of these anchors"
    )


def _is_rigid(positions: np.ndarray, direction: np.ndarray) -> bool:
    """Return whether a direction (3N,) moves points (N, 3) as a rigid body."""
    from_middle = positions - positions.mean(axis=0)
    moves = [np.tile(axis, len(positions)) for axis in np.eye(3)]
    moves += [np.cross(axis, from_middle).ravel() for axis in np.eye(3)]
    basis, _ = np.linalg.qr(np.column_stack(moves))
    return float(np.linalg.norm(basis.T @ direction)) > 0.99


def _unchecked(found: FirstMap, seen: Observations, best: Fit, accuracy: float) -> str:
    """Return a sentence if a wrong distance would show nowhere: maps from distances alone."""
    if len(seen.t):
        return ""
    for number, (a, b, *_) in enumerate(seen.distances):
        fewer = replace(seen, distances=np.delete(seen.distances, number, axis=0))
        about = Problem(fewer, Stage()).about(best)
        std = np.sqrt(np.diag(about.covariance)[: found.positions.size]).reshape(-1, 3)
        if np.linalg.norm(std, axis=1).max() > accuracy:
            one, other = found.ids[[int(a), int(b)]]
            return (
                f"nothing checks the distance between anchors {one} and {other}: without it the map "
                "is not determined; measure more distances of these anchors"
            )
    return ""
