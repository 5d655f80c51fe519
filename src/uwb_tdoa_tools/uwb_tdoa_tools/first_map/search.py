# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Search for maps: starting points, shapes without a frame, their places in the frame, minima."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.optimize import least_squares
from scipy.sparse.csgraph import shortest_path
from scipy.spatial.transform import Rotation

from .least_squares import Fit, Problem, Stage
from .observations import STEP, Observations

STARTS, MOST_STARTS = 6, 24  # starting points of shapes, and the most if only one reached the best
WIDTHS = 10.0, 3.0, 1.0  # factors on standard deviations, one after the other
SPREAD = 0.3  # standard deviation of the logarithm of distances in starting points
FARTHER = 1.2  # distance of two anchors, multiples of their largest TDOA
FLATTEST = 0.05  # smallest extent along an axis of a starting point, share of the room squared
SAME_SHAPE, SAME_MAP = 0.2, 0.3  # m, root mean square and largest distance of the same
SHAPES, PLACES = 4, 8  # most shapes, and most places of each in the frame
CLOSE = 0.1, 50.0  # share of the best cost, and cost, within which a shape is placed
TURNS = 24  # random rotations that are tried without inertial samples
ROUGH = 0.3  # m, of coordinates while a shape is placed
SMOOTHING = 5  # bins over which accelerations are averaged to compare rotations
ROUNDS, BETTER = 3, 1.0  # of reflections, and the decrease of the cost that is worth another round
MOVING = 20  # fewest bins with accelerations


def minima(
    seen: Observations, rng: np.random.Generator, progress: Callable[[str], object]
) -> tuple[list[Fit], int]:
    """Return the distinct minima of the cost, best first, and how many starts reached the best shape.

    First come shapes without a frame. Each shape is placed in the frame in several ways. Each way,
    and reflections of the best fit so far, are a starting point of a fit in the frame.
    """
    shapes, reached = _shapes(seen, rng, progress)
    wide, exact = (Problem(seen, Stage(wide=wide)) for wide in WIDTHS[1:])
    fits: list[Fit] = []

    def fit_from(path: np.ndarray, columns: np.ndarray) -> None:
        rough = wide.solve(path, columns)
        fit = exact.solve(rough.path, rough.columns)
        if np.isfinite(fit.cost):
            fits.append(fit)

    for shape in shapes:
        for turn, shift in _places(seen, shape, rng):
            progress("placing the map in its frame")
            fit_from(*_placed(seen, shape, turn, shift))
    fits.sort(key=lambda fit: fit.cost)
    for _ in range(ROUNDS):
        best = fits[0]
        for path, columns in _reflections(seen, best):
            progress("looking for second places of anchors")
            fit_from(path, columns)
        fits.sort(key=lambda fit: fit.cost)
        if fits[0].cost > best.cost - BETTER:
            break
    return _distinct(fits), reached


def _distinct(fits: list[Fit]) -> list[Fit]:
    out: list[Fit] = []
    for fit in fits:
        if all(np.abs(fit.anchors - other.anchors).max() > SAME_MAP for other in out):
            out.append(fit)
    return out


def _shapes(
    seen: Observations, rng: np.random.Generator, progress: Callable[[str], object]
) -> tuple[list[Fit], int]:
    """Return distinct shapes, best first, and how many starting points reached the best."""
    problems = [Problem(seen, Stage(False, False, wide)) for wide in WIDTHS]
    fits: list[Fit] = []
    reached = 0
    for number, distances in enumerate(_distances(seen, rng)):
        if number >= STARTS and reached > 1 and len(seen.t):
            break
        progress("searching for the shape of the map")
        anchors = _embedded(distances)
        columns = np.zeros(problems[0].layout.size)
        columns[problems[0].layout.positions] = anchors.ravel()
        middle = anchors.mean(axis=0) + 0.05 * distances.max() * rng.standard_normal(3)
        path = np.tile(middle, (len(seen.t), 1))
        for problem in problems:
            fit = problem.solve(path, columns)
            path, columns = fit.path, fit.columns
        fits.append(fit)
        best = min(fits, key=lambda one: one.cost)
        reached = sum(_alike(one, best) for one in fits)
    fits.sort(key=lambda fit: fit.cost)
    limit = fits[0].cost * (1.0 + CLOSE[0]) + CLOSE[1]
    out: list[Fit] = []
    for fit in fits:
        if fit.cost < limit and not any(_alike(fit, other) for other in out):
            out.append(fit)
    return out[:SHAPES], reached


def _alike(one: Fit, other: Fit) -> bool:
    return rigid_distance(one.anchors, other.anchors) < SAME_SHAPE


def rigid_distance(a: np.ndarray, b: np.ndarray, mirrored: bool | None = None) -> float:
    """Return the root mean square distance of two sets of points (N, 3) after a rigid motion, m.

    mirrored : whether with a reflection; None for either
    """
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    if mirrored is None:
        return min(rigid_distance(a, b, False), rigid_distance(a, b, True))
    turned = a @ orthogonal(a, b, -1.0 if mirrored else 1.0).T
    return float(np.sqrt(np.mean(np.sum((turned - b) ** 2, axis=1))))


def orthogonal(a: np.ndarray, b: np.ndarray, determinant: float) -> np.ndarray:
    """Return the orthogonal (3, 3) matrix of this determinant that turns rows of a onto rows of b."""
    left, _, right = np.linalg.svd(b.T @ a)
    sign = determinant * np.sign(np.linalg.det(left @ right))
    return left @ np.diag([1.0, 1.0, sign]) @ right


def _distances(seen: Observations, rng: np.random.Generator) -> list[np.ndarray]:
    """Return distances of all anchors, (N, N) m, for each starting point.

    A TDOA never exceeds the distance of its anchors, and comes near to it in a flight through the room.
    Of measured distances, each is left out once: it may be an outlier.
    """
    count = len(seen.ids)
    largest = np.zeros((count, count))
    ranges = np.full((len(seen.t), count), np.nan)
    of_range = ~seen.two
    ranges[seen.bin[of_range], seen.b[of_range]] = seen.d[of_range]
    for a in range(count):
        for b in range(a + 1, count):
            difference = ranges[:, a] - ranges[:, b]
            values = [seen.d[(seen.a == a) & (seen.b == b)], difference[np.isfinite(difference)]]
            both = np.abs(np.concatenate(values))
            if len(both) > 5:
                largest[a, b] = largest[b, a] = np.quantile(both, 0.98)
    guess = FARTHER * largest
    rest = 0.8 * largest.max() if largest.any() else 0.0
    guess[guess == 0.0] = rest
    outs = []
    left_out = range(-1, len(seen.distances)) if not len(seen.t) else range(-1, 0)
    for number in [*left_out, *[-1] * (MOST_STARTS - 1)]:
        known = np.delete(seen.distances, number, axis=0) if number >= 0 else seen.distances
        measured = np.zeros((count, count))
        a, b = known[:, :2].astype(int).T
        measured[a, b] = measured[b, a] = known[:, 2]
        if len(seen.t):
            full = np.where(measured > 0.0, measured, guess)
        else:
            full = shortest_path(measured, directed=False)
            full[~np.isfinite(full)] = full[np.isfinite(full)].max()
        noise = SPREAD * rng.standard_normal((count, count)) * (measured == 0.0)
        noise = np.triu(noise, 1)
        full = full * np.exp(noise + noise.T)
        np.fill_diagonal(full, 0.0)
        outs.append(full)
    return outs


def _embedded(distances: np.ndarray) -> np.ndarray:
    """Return points with about these distances (N, N), (N, 3) m: classical scaling."""
    count = len(distances)
    centred = np.eye(count) - 1.0 / count
    values, vectors = np.linalg.eigh(-0.5 * centred @ distances**2 @ centred)
    least = FLATTEST * distances.max() ** 2
    return vectors[:, -3:] * np.sqrt(np.maximum(values[-3:], least))


def _places(
    seen: Observations, shape: Fit, rng: np.random.Generator
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return rotations, with and without a reflection, and shifts that place a shape in the frame."""
    anchors = shape.anchors
    middle = seen.middle
    moving = np.isfinite(seen.accel[middle]).all(axis=1) & (seen.flight[middle] == 0)
    upright = int(moving.sum()) > MOVING
    found = []
    for determinant in (1.0, -1.0):
        if upright:
            one = _slow(np.diff(shape.path, 2, axis=0)[middle - 1][moving] / STEP**2)
            turn = orthogonal(one, _slow(seen.accel[middle][moving]), determinant)
            angles = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
            turns = [Rotation.from_euler("z", angle).as_matrix() @ turn for angle in angles]
        else:
            random = Rotation.random(TURNS, random_state=rng).as_matrix()
            turns = [turn @ np.diag([1.0, 1.0, determinant]) for turn in random]
        found += [_settled(seen, anchors, turn, upright) for turn in turns]
    found.sort(key=lambda one: one[0])
    out: list[tuple[np.ndarray, np.ndarray]] = []
    there: list[np.ndarray] = []
    for cost, turn, shift in found:
        here = anchors @ turn.T + shift
        new = all(np.abs(here - other).max() > SAME_MAP for other in there)
        if new and cost < found[0][0] + CLOSE[1] and len(out) < PLACES:
            out.append((turn, shift))
            there.append(here)
    return out


def _slow(accel: np.ndarray) -> np.ndarray:
    """Return accelerations (n, 3) without their mean, averaged over SMOOTHING bins."""
    window = np.ones(SMOOTHING) / SMOOTHING
    columns = [np.convolve(column - column.mean(), window, "same") for column in accel.T]
    return np.column_stack(columns)


def _settled(
    seen: Observations, anchors: np.ndarray, turn: np.ndarray, upright: bool
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return (cost, rotation, shift) nearest to a rotation that fit the coordinates.

    upright : rotate about z only
    """
    row, axis = seen.coordinates[:, :2].astype(int).T
    value, std = seen.coordinates[:, 2], np.hypot(seen.coordinates[:, 3], ROUGH)
    angles = 1 if upright else 3

    def rotation(x: np.ndarray) -> np.ndarray:
        vector = [0.0, 0.0, x[0]] if upright else x[:3]
        return np.asarray(Rotation.from_rotvec(vector).as_matrix() @ turn)

    def off(x: np.ndarray) -> np.ndarray:
        there = anchors @ rotation(x).T + x[angles:]
        return np.concatenate([(there[row, axis] - value) / std, 1e-3 * x])

    found = least_squares(off, np.zeros(angles + 3), max_nfev=50)
    return float(found.cost), rotation(found.x), found.x[angles:]


def _placed(
    seen: Observations, shape: Fit, turn: np.ndarray, shift: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return path and columns of a shape in the frame; yaws come from accelerations."""
    columns, count = shape.columns.copy(), len(seen.ids)
    columns[: 3 * count] = (shape.anchors @ turn.T + shift).ravel()
    path = shape.path @ turn.T + shift
    middle = seen.middle
    for number in range(seen.flights):
        chosen = (seen.flight[middle] == number) & np.isfinite(seen.accel[middle]).all(axis=1)
        if chosen.any():
            one = _slow(np.diff(path, 2, axis=0)[middle - 1][chosen])
            other = _slow(seen.accel[middle][chosen])
            yaw = np.arctan2(
                np.sum(other[:, 0] * one[:, 1] - other[:, 1] * one[:, 0]),
                np.sum(other[:, :2] * one[:, :2]),
            )
            columns[5 * count + 6 * number] = yaw
    return path, columns


def _reflections(seen: Observations, fit: Fit) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return [(path, unknowns)], starting points with each anchor, and all unknown ones, reflected at planes.

    The planes are those of the path, or of the other anchors. A path in a plane, or on a line, gives an
    anchor a second place on the other side.
    """
    count, anchors = len(seen.ids), fit.anchors
    known = np.bincount(seen.coordinates[:, 0].astype(int), minlength=count) >= 3
    groups = [np.array([row]) for row in range(count) if not known[row]]
    if len(groups) > 1:
        groups.append(np.flatnonzero(~known))
    out = []
    for rows in groups:
        points = fit.path if len(fit.path) else np.delete(anchors, rows, axis=0)
        if len(points) < 3:
            continue
        middle = points.mean(axis=0)
        _, axes = np.linalg.eigh(np.cov(points.T))
        for normal in axes.T[: 2 if len(fit.path) else 1]:
            there = anchors.copy()
            there[rows] -= 2.0 * np.outer((anchors[rows] - middle) @ normal, normal)
            columns = fit.columns.copy()
            columns[: 3 * count] = there.ravel()
            out.append((fit.path, columns))
    return out


def misfit_of(seen: Observations, path: np.ndarray, accel: np.ndarray) -> float:
    """Return the mean square between slow accelerations (J, 3) and a path (J, 3), after a rotation.

    The rotation may hold a reflection. NaN if too few bins of a flight have accelerations.
    """
    middle, total = seen.middle, []
    for number in range(seen.flights):
        measured = np.isfinite(accel[middle]).all(axis=1) & (seen.flight[middle] == number)
        if measured.sum() > MOVING:
            one = _slow(np.diff(path, 2, axis=0)[middle - 1][measured] / STEP**2)
            other = _slow(accel[middle][measured])
            turns = [orthogonal(one, other, determinant) for determinant in (1.0, -1.0)]
            total.append(min(np.mean((one @ turn.T - other) ** 2) for turn in turns))
    return float(np.mean(total)) if total else np.nan
