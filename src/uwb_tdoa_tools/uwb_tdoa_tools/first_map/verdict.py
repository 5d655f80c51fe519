# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Accept a map, or state what the data leave open and what would settle it.

`covariance` states how far the map can be off under errors that last.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.files import write_picture

from ..choices import MAP_ACCURACY
from .least_squares import (
    MOTION,
    SAME_MAP,
    SAME_SHAPE,
    Equations,
    Fit,
    Problem,
    minima,
    misfit_of,
    rigid_distance,
)
from .observations import Observations

LENGTH = 1.2  # m, of the smooth error of each anchor, as in `survey`
DRAWS = 300  # of the errors
TILT, TILT_TIME = 0.1, 10.0  # m/s^2 and s, of accelerations by errors of roll and pitch
SHAKEN = 0.15  # m/s^2, of the acceleration of a bin
# Factor on the variance that lasting errors make: the fit is linear here, and their size is
# estimated from the residuals. Set on simulated halls other than those of the study.
MARGIN = 1.5
NEAR = 5  # bins, at most between two measurements whose common error lasts
CLIPPED = 3.0  # robust standard deviations beyond which a residual is an outlier
LEAST_SHARE = 0.1  # of the variance of residuals that lasts at least
LEAST = 0.01  # m, of a coordinate


def covariance(linear: Equations, fit: Fit, rng: np.random.Generator) -> tuple[np.ndarray, float]:
    """Return the covariance of the anchors, (3N, 3N) m^2, and the size of lasting errors, m.

    Draws of all errors pass through the linear problem. Each anchor has a smooth error of the place of
    the tag. Successive residuals of a pair give its size by what they share. Most of such an error
    disappears in the map, so the errors are larger than the residuals. Accelerations have a slow error.
    The rest is independent.
    """
    problem = linear.problem
    seen, size = problem.seen, 3 * len(problem.seen.ids)
    least = LEAST**2 * np.eye(size)
    if not len(seen.t):
        return linear.covariance[:size, :size] + least, 0.0
    root = _root(fit.path)
    draws = rng.standard_normal((len(seen.ids), root.shape[1], DRAWS))
    smooth = np.einsum("jr,nrs->njs", root, draws)
    radio = smooth[seen.b, seen.bin]
    radio -= np.where(problem.two[:, None], smooth[problem.first, seen.bin], 0.0)
    errors = np.zeros((len(problem.std), DRAWS))
    errors[problem.rows["radio"]] = radio
    lasting, left = linear.response(errors)
    scale = _scale(linear.state.radio)
    pairs = _neighbours(linear)
    clipped = np.clip(linear.state.radio, -CLIPPED * scale, CLIPPED * scale)
    together = max(_lasting(clipped[:, None], pairs), LEAST_SHARE * scale**2)
    std = float(np.sqrt(together / max(_lasting(left, pairs), 1e-9)))
    motion, others = problem.rows["motion"], len(problem.std) - len(problem.rows["motion"])
    size_of = np.where(np.arange(others) < len(radio), scale, -problem.std[:others])
    errors[:others] = size_of[:, None] * rng.standard_normal((others, DRAWS))
    errors[motion] = _accelerations(linear, rng).reshape(-1, DRAWS)
    independent, _ = linear.response(errors)
    total = std * lasting[:size] + independent[:size]
    return least + MARGIN * total @ total.T / DRAWS, std


def _neighbours(linear: Equations) -> tuple[np.ndarray, np.ndarray]:
    """Return rows (k,) of measurements, and of the next one of the same anchors within NEAR bins."""
    seen = linear.problem.seen
    order = np.lexsort((seen.bin, seen.b, seen.a))
    first, second = order[:-1], order[1:]
    same = (seen.a[first] == seen.a[second]) & (seen.b[first] == seen.b[second])
    near = same & (seen.bin[second] - seen.bin[first] <= NEAR)
    return first[near], second[near]


def _lasting(residual: np.ndarray, pairs: tuple[np.ndarray, np.ndarray]) -> float:
    """Return the variance of the part of residuals (n, s) that two successive ones share, m^2."""
    first, second = pairs
    return float(np.mean(residual[first] * residual[second])) if len(first) else 0.0


def _root(path: np.ndarray) -> np.ndarray:
    """Return (J, r) whose product with normal numbers is a smooth function along a path (J, 3) m."""
    apart = np.sum((path[:, None] - path) ** 2, axis=2)
    values, vectors = np.linalg.eigh(np.exp(-0.5 * apart / LENGTH**2))
    kept = values > 1e-6 * values[-1]
    return vectors[:, kept] * np.sqrt(values[kept])


def _accelerations(linear: Equations, rng: np.random.Generator) -> np.ndarray:
    """Return draws of the errors of accelerations, (m, 3, s) m/s^2."""
    problem = linear.problem
    flight, t = problem.seen.flight[problem.middle], problem.seen.t[problem.middle]
    together = flight[:, None] == flight
    together = together & problem.measured & problem.measured[:, None]
    slow = TILT**2 * together * np.exp(-np.abs(t[:, None] - t) / TILT_TIME)
    quick = np.where(problem.measured, SHAKEN, MOTION)
    root = np.linalg.cholesky(slow + np.diag(quick**2))
    draws = rng.standard_normal((3, len(t), DRAWS))
    return np.einsum("ij,kjs->iks", root, draws)


def _scale(values: np.ndarray) -> float:
    """Return the robust standard deviation of values about zero."""
    return 1.4826 * float(np.median(np.abs(values)))


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
    linear = Problem(seen).about(best)
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
        about = Problem(fewer).about(best)
        std = np.sqrt(np.diag(about.covariance)[: found.positions.size]).reshape(-1, 3)
        if np.linalg.norm(std, axis=1).max() > accuracy:
            one, other = found.ids[[int(a), int(b)]]
            return (
                f"nothing checks the distance between anchors {one} and {other}: without it the map "
                "is not determined; measure more distances of these anchors"
            )
    return ""


CHI2_95 = 5.99  # of two coordinates


def as_dict(found: FirstMap) -> dict[str, Any]:
    """Return the figures for JSON."""
    return {
        "accepted": not found.why_not,
        "why_not": found.why_not,
        "anchors": {
            str(i): {
                "position": found.positions[row].tolist(),
                "std": found.std[row].tolist(),
                "trusted": found.trusted[row].tolist(),
                "others": [other[row].tolist() for other in found.others],
            }
            for row, i in enumerate(found.ids)
        },
        "covariance": found.covariance.tolist(),
        "lasting_std": found.lasting,
    }


def as_text(found: FirstMap) -> str:
    """Return a table of the anchors, and the verdict."""
    lines = [f"{'anchor':>6}  {'position [m]':>24}  {'std [m]':>18}"]
    for row, i in enumerate(found.ids):
        position = "".join(f"{value:8.2f}" for value in found.positions[row])
        std = "".join(f"{value:6.2f}" for value in found.std[row])
        mark = "  trusted" if found.trusted[row].all() else ""
        lines.append(f"{i:>6}  {position}  {std}{mark}")
    if found.why_not:
        lines.append(f"no map: {found.why_not}")
    else:
        off = np.linalg.norm(found.std[~found.trusted.all(axis=1)], axis=1)
        lines.append(
            f"{len(off)} anchors are known to {np.median(off):.2f} m (median), {off.max():.2f} m at "
            "most: a first map; heights and distances make it better"
        )
    return "\n".join(lines)


def picture(found: FirstMap, path: str | Path) -> None:
    """Draw the map from above and from the side, with ellipses of 95 % and other maps."""
    from matplotlib.patches import Ellipse  # takes a second to import

    from ..scoring.plots import two_views

    figure, views = two_views()
    for ax, axes in views:
        for other in found.others:
            ax.plot(*other[:, axes].T, "x", color="tab:red", ms=7)
        for row, i in enumerate(found.ids):
            place = found.positions[row, axes]
            columns = [3 * row + axis for axis in axes]
            values, vectors = np.linalg.eigh(found.covariance[np.ix_(columns, columns)])
            width, height = 2.0 * np.sqrt(CHI2_95 * np.maximum(values, 0.0))
            angle = np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0]))
            ax.add_patch(
                Ellipse(tuple(place), width, height, angle=angle, fc="none", ec="tab:blue")
            )
            ax.plot(*place, "s" if found.trusted[row].all() else "o", color="tab:blue", ms=5)
            ax.annotate(str(i), (place[0], place[1]), textcoords="offset points", xytext=(6, 6))
    state = f"not accepted; red: {len(found.others)} other maps" if found.why_not else "accepted"
    figure.suptitle(f"first map: {state}; squares: trusted; ellipses: 95 %")
    write_picture(path, figure)
