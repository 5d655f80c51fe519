"""Downhill to better anchors: the bound, its derivatives along what moves the anchors, and a
descent along them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from scipy.optimize import minimize
from scipy.spatial import ConvexHull, QhullError
from scipy.special import expit

from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.geometry import ranges

from .bifurcation import Subsets
from .goal import UNUSABLE
from .pairing import PAIRINGS
from .precision import bound, position_error, weigh

if TYPE_CHECKING:
    from collections.abc import Callable

    from .goal import Goal
    from .layout import Layout

Result = TypeVar("Result")

SOFT = 0.05  # of |q|^2 - 1, over which failure sets in where derivatives are needed
EDGE = 0.05  # m over which the hull ends, likewise
FAILED = 10.0  # of the objective, a logarithm
SHAKEN = (
    0.0,
    1e-3,
    1e-2,
    0.1,
)  # of what is allowed, by which a start is moved where the goal is not defined
CLOSE = 1e-4  # of the objective: a step that gains less is the last
_CHUNK = 1_000_000  # numbers in the largest array of one step


def errors_and_slopes(
    goal: Goal, layout: Layout, x: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The bound at points (n, 3): (n,) m, and its derivatives along x: (n, len(x)).

    Only one column of the ranges and of the variances changes with one number of x, so each is
    computed once, and the information of all changed layouts in one batch. d sqrt(tr J^-1) =
    -tr(J^-2 dJ) / (2 sqrt(tr J^-1)).
    """
    installation, k = goal.installation, goal.installation.dimensions
    positions, orientations, steps = layout.nudged(x)
    every = Anchors(np.arange(len(positions)), positions, orientations)
    variance = installation.noise.variance(points, every)
    unit = ranges(points[:, None], positions)[1]
    chosen = layout.columns()
    pairing = PAIRINGS[goal.pairing](chosen.shape[1])
    information = np.concatenate(
        [
            weigh(
                unit[rows][:, chosen, :k].reshape(-1, chosen.shape[1], k),
                variance[rows][:, chosen].reshape(-1, chosen.shape[1]),
                pairing,
                installation.link_std,
            )
            for rows in np.array_split(
                np.arange(len(points)), max(1, len(points) * chosen.size * k // _CHUNK)
            )
        ]
    ).reshape(len(points), -1, k, k)
    covariance = bound(installation.with_height(information[:, 0]))
    errors = position_error(covariance)
    lost = ~(errors < UNUSABLE)
    covariance[lost], errors[lost] = 0.0, UNUSABLE
    change = (information[:, 1:] - information[:, :1]) / steps[:, None, None]
    slopes = -0.5 * np.einsum("nij,nvji->nv", covariance @ covariance, change) / errors[:, None]
    return errors, slopes


def failing_and_slopes(
    goal: Goal, layout: Layout, x: np.ndarray, points: np.ndarray
) -> tuple[float, np.ndarray]:
    """A smooth stand-in for the share of points (n, 3) that are not flyable, and its derivatives
    along x: (len(x),).

    Outside of the anchors' hull or, for the criterion "pairings", where one of them has two
    solutions. Raises InputError where that is not defined: two anchors have met, or all are in a
    plane.
    """
    anchors = layout.anchors(x)
    try:
        good, along = _inside(anchors.positions, points, goal.installation.unknowns)
    except QhullError as error:
        raise InputError(
            "anchors: they span no hull; take some of them out of the plane of the others."
        ) from error
    more: np.ndarray | float
    if goal.demand.criterion == "pairings":
        subsets = Subsets(anchors, goal.installation.unknowns)
        excess = subsets.discriminant(points) / SOFT
        single = expit(-excess).prod(axis=1)
        along = along * single[:, None, None]
        weights = (good * single)[:, None] * expit(excess) / SOFT
        good, more = good * single, -subsets.slopes(points, weights)
    else:
        more = 0.0
    along = -(along.sum(axis=0) + more) / len(points)
    positions, _, steps = layout.nudged(x)
    here, moved = layout.free(positions)
    return 1.0 - good.mean(), np.einsum(
        "imk,ik->im", moved - here[:, None], along[-len(here) :]
    ).ravel() / steps


def _inside(positions: np.ndarray, points: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
    """How far inside the hull points (n, 3) are, softly 0 ... 1: (n,), and its derivatives along
    the anchors' positions (N, 3): (n, N, 3) 1/m.

    With the distance h beyond the facet that is exceeded most, and l_j the barycentric coordinates
    on it of the point's foot, moving its corner j by dm moves the facet there by l_j dm: dh = -l_j
    normal . dm.
    """
    hull = ConvexHull(positions[:, :k])
    beyond = points[:, :k] @ hull.equations[:, :k].T + hull.equations[:, k]
    facet = np.argmax(beyond, axis=1)
    h, normal = beyond[np.arange(len(points)), facet], hull.equations[facet, :k]
    corners = hull.simplices[facet]
    foot = points[:, :k] - h[:, None] * normal
    spanned = np.concatenate(
        [positions[corners][:, :, :k], np.ones((*corners.shape, 1))], axis=2
    ).swapaxes(1, 2)
    share = np.einsum(
        "nij,nj->ni", np.linalg.pinv(spanned), np.hstack([foot, np.ones((len(foot), 1))])
    )
    inside = expit(-h / EDGE)
    along = np.zeros((len(points), len(positions), 3))
    slope = (inside * (1.0 - inside) / EDGE)[:, None, None] * share[:, :, None] * normal[:, None]
    along[np.arange(len(points))[:, None], corners, :k] = slope
    return inside, along


def descend(
    goal: Goal, layout: Layout, points: np.ndarray, x: np.ndarray, sweeps: int
) -> np.ndarray:
    """x after at most `sweeps` steps of SLSQP (scipy.optimize) towards the goal at points (n, 3).

    The worst case is not smooth, but the smallest s that no point's log error exceeds is, with a
    constraint per point. Where the goal is not defined there is no slope, and none is made up: such
    a step is taken back, being FAILED worse than any other; where SLSQP would go on from there, the
    best x so far is returned. A start there is shaken until the goal is defined, and returned if it
    never is.
    """
    size, (low, high) = len(x), np.transpose(layout.bounds)
    seen: dict[bytes, tuple[np.ndarray, np.ndarray, float, np.ndarray]] = {}  # of the last x
    best: list[Any] = [np.inf, x]

    def at(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, np.ndarray]:
        """(errors, slopes, failing, slopes of that) at x.

        Raises InputError where they are not defined.
        """
        if not np.isfinite(x).all():
            raise InputError("layout: no numbers")  # SLSQP has been seen to ask for NaN
        x = np.clip(x, low, high)
        if (key := x.tobytes()) not in seen:
            seen.clear()
            errors, slopes = errors_and_slopes(goal, layout, x, points)
            failing, more = failing_and_slopes(goal, layout, x, points)
            seen[key] = errors, slopes, failing, more
            if (
                value := (errors.mean() if goal.objective == "mean" else errors.max())
                * (1.0 + failing)
            ) < best[0]:
                best[:] = value, x
        return seen[key]

    def tried(
        function: Callable[[np.ndarray], Result], otherwise: Result
    ) -> Callable[[np.ndarray], Result]:
        def value(z: np.ndarray) -> Result:
            try:
                return function(z)
            except InputError:
                return otherwise

        return value

    def mean(x: np.ndarray) -> float:
        errors, _, failing, _ = at(x)
        return np.log(errors.mean() * (1.0 + failing))

    def mean_slopes(x: np.ndarray) -> np.ndarray:
        errors, slopes, failing, more = at(x)
        return slopes.mean(axis=0) / errors.mean() + more / (1.0 + failing)

    def worst_slopes(z: np.ndarray) -> np.ndarray:
        _, _, failing, slopes = at(z[:size])
        return np.append(slopes / (1.0 + failing), 1.0)

    options = {"method": "SLSQP", "options": {"maxiter": sweeps, "ftol": CLOSE}}
    try:
        x = _defined_near(at, np.clip(x, low, high), low, high)
        if goal.objective == "mean":
            found = minimize(
                tried(mean, FAILED), x, jac=mean_slopes, bounds=layout.bounds, **options
            )
        else:
            below = {
                "type": "ineq",
                "fun": tried(
                    lambda z: z[size] - np.log(at(z[:size])[0]), np.full(len(points), -FAILED)
                ),
                "jac": lambda z: np.column_stack(
                    [-at(z[:size])[1] / at(z[:size])[0][:, None], np.ones(len(points))]
                ),
            }
            worst = tried(lambda z: z[size] + np.log1p(at(z[:size])[2]), FAILED)
            z, bounds = np.append(x, np.log(at(x)[0].max())), [*layout.bounds, (None, None)]
            found = minimize(
                worst, z, jac=worst_slopes, bounds=bounds, constraints=[below], **options
            )
        at(found.x[:size])
    except InputError:
        return best[1]
    return np.clip(found.x[:size], low, high)


def _defined_near(
    at: Callable[[np.ndarray], object], x: np.ndarray, low: np.ndarray, high: np.ndarray
) -> np.ndarray:
    """x, or an x near it where `at` raises no InputError; moved at random by more and more of what
    is allowed. Raises InputError.
    """
    rng = np.random.default_rng(0)
    for share in SHAKEN:
        shaken = np.clip(x + share * (high - low) * rng.uniform(-1.0, 1.0, len(x)), low, high)
        try:
            at(shaken)
            return shaken
        except InputError as error:
            last = error
    raise last
