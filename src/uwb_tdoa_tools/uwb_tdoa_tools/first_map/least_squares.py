# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Robust least squares for anchors and the path of the tag together.

The unknowns are the position of the tag in each time bin, and the columns `Layout` of anchors and
flights. Levenberg-Marquardt steps eliminate the positions, whose normal equations are banded. The search starts them from
many points.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve, cho_solve_banded, cholesky_banded
from scipy.optimize import least_squares
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import shortest_path
from scipy.spatial.transform import Rotation

from .observations import STEP, Observations

NU = 4.0  # degrees of freedom of Student's t, of TDOAs, ranges, heights and distances
DELAY = 0.1  # m, prior of the delay of an anchor
TAG_DELAY = 0.5  # m, prior of the antenna delay of the tag, in ranges
ANYWHERE = 100.0  # m, prior of an anchor, about the origin
YAW, YAW_RATE, BIAS = 100.0, 0.02, 0.15  # rad, rad/s, m/s^2: priors of each flight
PER_FLIGHT = np.array([YAW, YAW_RATE, BIAS, BIAS, BIAS, TAG_DELAY])
# Errors of a TDOA or range last: 12 count as one, as in `survey`. Counted fully, they outweigh the
# inertial sensor, which gives the size of the path.
LASTING = 3.5
ACCEL_STD = 0.2  # m/s^2, of the acceleration of a bin
MOTION = 2.5  # m/s^2, acceleration of a tag without inertial samples
HEIGHT_STD = 0.1  # m, of the height of a bin
HELD = 1e-4  # m, prior of a delay that does not exist
WEAK = 1e-6  # 1/m^2, information of each coordinate of the path: bins without measurements
DAMPING, LESS, MORE, TRIES = 1e-3, 0.2, 5.0, 8
STEPS = 80  # most accepted steps
CONVERGED = 0.05  # smallest decrease of the cost that another step is worth


class Layout:
    """Columns of anchors and flights: positions, delays, delays of distances, PER_FLIGHT."""

    def __init__(self, anchors: int, flights: int) -> None:
        self.anchors, self.flights = anchors, flights
        self.positions = slice(0, 3 * anchors)
        self.delays = slice(3 * anchors, 4 * anchors)
        self.between = slice(4 * anchors, 5 * anchors)
        self.of_flights = 5 * anchors + len(PER_FLIGHT) * np.arange(flights)
        self.size = 5 * anchors + len(PER_FLIGHT) * flights


class Problem:
    """Observations, and what of them a fit uses."""

    def __init__(
        self, seen: Observations, inertial: bool = True, frame: bool = True, wide: float = 1.0
    ) -> None:
        """Weigh the Observations.

        inertial : whether accelerations hold; otherwise the path is only smooth
        frame : whether coordinates and heights hold; otherwise the frame is arbitrary
        wide : factor on the standard deviations of radio measurements and distances; more than 1
            smooths the cost, for a search
        """
        self.seen = seen
        self.layout = Layout(len(seen.ids), seen.flights)
        self.bins = len(seen.t)
        self.two = seen.two
        self.first = np.where(self.two, seen.a, 0)
        self.std = seen.std * wide * (LASTING if frame else 1.0)
        self.middle = seen.middle
        known = np.isfinite(seen.accel[self.middle]).all(axis=1)
        self.measured = known & inertial
        self.accel = np.where(self.measured[:, None], np.nan_to_num(seen.accel[self.middle]), 0.0)
        self.motion_weight = np.where(self.measured, ACCEL_STD, MOTION) ** -2.0
        self.accel_weight = np.where(self.measured, self.motion_weight, 0.0)
        self.of_flight = self.layout.of_flights[seen.flight]
        self.high = np.flatnonzero(np.isfinite(seen.height) & frame)
        ends = seen.distances[:, :2].astype(int)
        self.ends = ends[:, 0], ends[:, 1]
        self.distance_std = seen.distances[:, 3] * wide
        row, axis = seen.coordinates[:, :2].astype(int).T
        self.coordinates = 3 * row + axis if frame else np.zeros(0, int)
        self.prior = np.empty(self.layout.size)
        self.prior[self.layout.positions] = ANYWHERE**-2.0
        self.prior[self.layout.delays] = DELAY**-2.0
        self.prior[self.layout.between] = max(seen.delay_std, HELD) ** -2.0
        self.prior[5 * len(seen.ids) :] = np.tile(PER_FLIGHT**-2.0, seen.flights)

    def solve(self, path: np.ndarray, columns: np.ndarray) -> Fit:
        """Return the minimum that Levenberg-Marquardt steps reach from path (J, 3) and columns."""
        state = Fit(self, path, columns)
        damping = DAMPING
        for _ in range(STEPS):
            equations = Equations(state)
            for _ in range(TRIES):
                following = equations.following(damping)
                if following is not None and following.cost < state.cost:
                    break
                damping *= MORE
            else:
                break
            gain = state.cost - following.cost
            state = following
            damping = max(damping * LESS, 1e-9)
            if gain < CONVERGED:
                break
        return state

    def about(self, fit: Fit) -> Equations:
        """Return the normal equations about a Fit."""
        return Equations(Fit(self, fit.path, fit.columns))

    def spread(self, values: np.ndarray) -> np.ndarray:
        """Return the gradient by the path (J, 3, s) of second differences (m, 3, s)."""
        out = np.zeros((self.bins, *values.shape[1:]))
        for shift, factor in ((-1, 1.0), (0, -2.0), (1, 1.0)):
            out[self.middle + shift] += factor * values / STEP**2
        return out

    @cached_property
    def smooth(self) -> np.ndarray:
        """Normal equations of second differences: upper bands (7, 3J)."""
        bands, weight = np.zeros((3, self.bins)), self.motion_weight / STEP**4
        for shift, factor in ((-1, 1.0), (0, 4.0), (1, 1.0)):
            bands[0][self.middle + shift] += factor * weight
        bands[1][self.middle] -= 2.0 * weight
        bands[1][self.middle + 1] -= 2.0 * weight
        bands[2][self.middle + 1] += weight
        out = np.zeros((7, 3 * self.bins))
        out[6], out[3], out[0] = (np.repeat(band, 3) for band in bands)
        out[6] += WEAK
        return out

    @cached_property
    def pattern(self) -> tuple[np.ndarray, csr_matrix]:
        """(order, matrix): places of (n, 3) derivatives by positions of the tag in (3J, n)."""
        count = len(self.seen.d)
        rows = (3 * self.seen.bin[:, None] + np.arange(3)).ravel()
        numbers = np.arange(3 * count) + 1.0
        matrix = csr_matrix(
            (numbers, (rows, np.repeat(np.arange(count), 3))), shape=(3 * self.bins, count)
        )
        return matrix.data.astype(int) - 1, matrix


class Fit:
    """Residuals of a Problem at a path and columns; `Problem.solve` returns that of a minimum.

    Attributes
    ----------
    path : (J, 3) m; columns : (k,); anchors : (N, 3) m, positions in the columns
    cost : negative log-likelihood
    """

    def __init__(self, problem: Problem, path: np.ndarray, columns: np.ndarray) -> None:
        self.problem, self.path, self.columns = problem, path, columns
        seen, layout = problem.seen, problem.layout
        self.anchors = anchors = columns[layout.positions].reshape(-1, 3)
        delay, between = columns[layout.delays], columns[layout.between]
        tag = path[seen.bin]
        to_b, self.by_b = _length(tag - anchors[seen.b])
        to_a, self.by_a = _length(tag - anchors[problem.first])
        of_tag = columns[problem.of_flight + 5][seen.bin]
        other = np.where(problem.two, to_a + delay[problem.first], -of_tag)
        self.radio = to_b + delay[seen.b] - other - seen.d
        flight = problem.of_flight[problem.middle]
        yaw = columns[flight] + columns[flight + 1] * seen.t[problem.middle]
        cos, sin = np.cos(yaw), np.sin(yaw)
        x, y, z = problem.accel.T
        self.turned = np.column_stack([cos * x - sin * y, sin * x + cos * y, z])
        bias = columns[flight[:, None] + [2, 3, 4]] * problem.measured[:, None]
        second = np.diff(path, 2, axis=0)[problem.middle - 1] if len(path) else path
        self.accel = second / STEP**2 - self.turned - bias
        self.height = path[problem.high, 2] - seen.height[problem.high]
        one, other_end = problem.ends
        length, self.along = _length(anchors[one] - anchors[other_end])
        self.distance = length + between[one] + between[other_end] - seen.distances[:, 2]
        known = problem.coordinates
        self.coordinate = columns[known] - seen.coordinates[: len(known), 2]
        self.coordinate_std = seen.coordinates[: len(known), 3]
        self.cost = self._cost()

    def _cost(self) -> float:
        problem = self.problem
        return float(
            _student(self.radio / problem.std)
            + _student(self.height / HEIGHT_STD)
            + _student(self.distance / problem.distance_std)
            + 0.5 * np.sum(problem.motion_weight[:, None] * self.accel**2)
            + 0.5 * np.sum((self.coordinate / self.coordinate_std) ** 2)
            + 0.5 * np.sum(problem.prior * self.columns**2)
        )


class Equations:
    """Normal equations of a Problem at a path and columns.

    Attributes
    ----------
    weight : (n,) 1/m^2, of TDOAs and ranges; by_columns : (n, k), by_tag : (3J, n) their derivatives
    by_distances : (m, k) derivatives of distances, weighted
    """

    def __init__(self, state: Fit) -> None:
        self.state = state
        self.problem = problem = state.problem
        self.gram = np.diag(problem.prior)
        self.gradient = problem.prior * state.columns
        self.cross = np.zeros((3 * problem.bins, problem.layout.size))
        self.path_gradient = np.zeros(3 * problem.bins)
        self.bands = problem.smooth.copy()
        self._add_radio()
        self._add_motion()
        self._add_anchors()

    def _add_radio(self) -> None:
        state, problem = self.state, self.state.problem
        seen, layout, two = problem.seen, problem.layout, problem.two
        row = np.arange(len(seen.d))
        self.weight = _weight(state.radio, problem.std)
        out = np.zeros((len(row), layout.size))
        for axis in range(3):
            out[row, 3 * seen.b + axis] = -state.by_b[:, axis]
            out[row[two], 3 * seen.a[two] + axis] = state.by_a[two, axis]
        out[row, layout.delays.start + seen.b] = 1.0
        out[row[two], layout.delays.start + seen.a[two]] = -1.0
        out[row[~two], problem.of_flight[seen.bin[~two]] + 5] = 1.0
        self.by_columns = out
        by_tag = state.by_b - np.where(two[:, None], state.by_a, 0.0)
        order, pattern = problem.pattern
        self.by_tag = csr_matrix(
            (by_tag.ravel()[order], pattern.indices, pattern.indptr), shape=pattern.shape
        )
        weighted = out * self.weight[:, None]
        self.gram += out.T @ weighted
        self.gradient = self.gradient + weighted.T @ state.radio
        self.cross += self.by_tag @ weighted
        self.path_gradient += self.by_tag @ (self.weight * state.radio)
        for i, k in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2)):
            sums = np.bincount(
                seen.bin, self.weight * by_tag[:, i] * by_tag[:, k], minlength=problem.bins
            )
            self.bands[6 + i - k, k::3] += sums

    def _add_motion(self) -> None:
        state, problem = self.state, self.state.problem
        seen = problem.seen
        weight = problem.motion_weight[:, None] * state.accel
        self.path_gradient += problem.spread(weight).ravel()
        height = _weight(state.height, np.full(len(problem.high), HEIGHT_STD))
        self.bands[6, 3 * problem.high + 2] += height
        self.path_gradient[3 * problem.high + 2] += height * state.height
        for number, first in enumerate(problem.layout.of_flights):
            chosen = problem.measured & (seen.flight[problem.middle] == number)
            rows = np.flatnonzero(chosen)
            by = np.zeros((len(chosen), 3, 5))
            x, y, _ = state.turned[rows].T
            by[rows, 0, 0], by[rows, 1, 0] = y, -x
            by[rows, :, 1] = by[rows, :, 0] * seen.t[problem.middle[rows], None]
            for axis in range(3):
                by[rows, axis, 2 + axis] = -1.0
            columns = first + np.arange(5)
            weighted = by * problem.accel_weight[:, None, None]
            self.gram[np.ix_(columns, columns)] += np.einsum("nki,nkj->ij", by, weighted)
            self.gradient[columns] += np.einsum("nki,nk->i", weighted, state.accel)
            self.cross[:, columns] += problem.spread(weighted).reshape(-1, 5)

    def _add_anchors(self) -> None:
        state, problem = self.state, self.state.problem
        one, other = problem.ends
        row = np.arange(len(one))
        by = np.zeros((len(one), problem.layout.size))
        for axis in range(3):
            by[row, 3 * one + axis] = state.along[:, axis]
            by[row, 3 * other + axis] = -state.along[:, axis]
        by[row, problem.layout.between.start + one] = 1.0
        by[row, problem.layout.between.start + other] = 1.0
        weighted = by * _weight(state.distance, problem.distance_std)[:, None]
        self.gram += by.T @ weighted
        self.gradient = self.gradient + weighted.T @ state.distance
        self.by_distances = weighted
        known, information = problem.coordinates, state.coordinate_std**-2.0
        np.add.at(self.gram, (known, known), information)
        np.add.at(self.gradient, known, information * state.coordinate)

    def following(self, damping: float) -> Fit | None:
        """Return the state after a step; None if the equations are singular."""
        bands = self.bands.copy()
        bands[6] *= 1.0 + damping
        gram = self.gram + damping * np.diag(np.diag(self.gram))
        try:
            factor = _factor(bands)
            solved = _solved(factor, np.column_stack([self.cross, self.path_gradient]))
            reduced = cho_factor(gram - self.cross.T @ solved[:, :-1], check_finite=False)
        except LinAlgError:
            return None
        columns = -cho_solve(reduced, self.gradient - self.cross.T @ solved[:, -1])
        path = -(solved[:, -1] + solved[:, :-1] @ columns)
        state = self.state
        return Fit(self.problem, state.path + path.reshape(-1, 3), state.columns + columns)

    @cached_property
    def path_factor(self) -> np.ndarray:
        """Factor of the normal equations of the path."""
        return _factor(self.bands)

    @cached_property
    def path_by_columns(self) -> np.ndarray:
        """Minus the derivatives of the best path by the columns, (3J, k)."""
        return _solved(self.path_factor, self.cross)

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance of the columns, (k, k), for independent errors."""
        return np.linalg.inv(self.gram - self.cross.T @ self.path_by_columns)

    def misfit(self) -> np.ndarray:
        """Return the mean square of accelerations over ACCEL_STD^2, of each flight; NaN without."""
        problem = self.problem
        flight = problem.seen.flight[problem.middle]
        square = (self.state.accel**2).mean(axis=1) / ACCEL_STD**2
        out = np.full(problem.layout.flights, np.nan)
        for number in range(problem.layout.flights):
            chosen = problem.measured & (flight == number)
            if chosen.any():
                out[number] = square[chosen].mean()
        return out

    def response(
        self, radio: np.ndarray, accel: np.ndarray, others: tuple[np.ndarray, np.ndarray]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the errors of the columns (k, s) that s draws of errors of measurements cause.

        Also return the residuals of radio measurements with these errors, (n, s) m.

        radio : (n, s) m, errors of radio measurements
        accel : (m, 3, s) m/s^2, errors of accelerations at the middle bins
        others : gradients by the columns (k, s) and by the path (3J, s) that other errors make, as of
            `others`
        """
        problem = self.problem
        weighted = -self.weight[:, None] * radio
        column_gradient = others[0] + self.by_columns.T @ weighted
        spread = problem.spread(-problem.motion_weight[:, None, None] * accel)
        path_gradient = others[1] + self.by_tag @ weighted + spread.reshape(-1, radio.shape[1])
        solved = _solved(self.path_factor, path_gradient)
        columns = -self.covariance @ (column_gradient - self.cross.T @ solved)
        path = -(solved + self.path_by_columns @ columns)
        return columns, self.by_columns @ columns + self.by_tag.T @ path - radio

    def others(self, rng: np.random.Generator, draws: int) -> tuple[np.ndarray, np.ndarray]:
        """Return draws of the gradients that errors of heights, distances, coordinates and priors make."""
        problem = self.problem
        size = problem.layout.size
        columns = np.sqrt(problem.prior)[:, None] * rng.standard_normal((size, draws))
        known = problem.coordinates
        std = problem.seen.coordinates[: len(known), 3]
        noise = rng.standard_normal((len(known), draws)) / std[:, None]
        np.add.at(columns, known, noise)
        between = self.by_distances * problem.distance_std[:, None]
        columns += between.T @ rng.standard_normal((len(between), draws))
        path = np.zeros((3 * problem.bins, draws))
        high = 3 * problem.high + 2
        path[high] = rng.standard_normal((len(high), draws)) / HEIGHT_STD
        return columns, path


def _factor(bands: np.ndarray) -> np.ndarray:
    """Return the Cholesky factor of upper bands; without a path there are none."""
    return cholesky_banded(bands, check_finite=False) if bands.size else bands


def _solved(factor: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the solution of the equations of a `_factor`."""
    if not factor.size:
        return values
    return cho_solve_banded((factor, False), values, check_finite=False)


def _length(line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return lengths (n,) of lines (n, 3), and their directions."""
    length = np.sqrt(np.sum(line**2, axis=1) + 1e-9)
    return length, line / length[:, None]


def _student(value: np.ndarray) -> float:
    """Return the negative log-likelihood of normalized residuals under Student's t."""
    return 0.5 * (NU + 1.0) * float(np.log1p(value**2 / NU).sum())


def _weight(residual: np.ndarray, std: np.ndarray) -> np.ndarray:
    """Return the weights of Student's t, 1/m^2."""
    return (NU + 1.0) / (NU + (residual / std) ** 2) / std**2


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
    wide, exact = (Problem(seen, wide=wide) for wide in WIDTHS[1:])
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
    return _distinct(fits, lambda one, other: _elsewhere(one.anchors, other.anchors)), reached


def _distinct(found: Iterable[Any], differ: Callable[[Any, Any], bool]) -> list[Any]:
    """Return what differs from all that is returned before it."""
    out: list[Any] = []
    for one in found:
        if all(differ(one, other) for other in out):
            out.append(one)
    return out


def _elsewhere(anchors: np.ndarray, others: np.ndarray) -> bool:
    return bool(np.abs(anchors - others).max() > SAME_MAP)


def _shapes(
    seen: Observations, rng: np.random.Generator, progress: Callable[[str], object]
) -> tuple[list[Fit], int]:
    """Return distinct shapes, best first, and how many starting points reached the best."""
    problems = [Problem(seen, False, False, wide) for wide in WIDTHS]
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
    near = (fit for fit in fits if fit.cost < limit)
    return _distinct(near, lambda one, other: not _alike(one, other))[:SHAPES], reached


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
    near = ((turn, shift) for cost, turn, shift in found if cost < found[0][0] + CLOSE[1])

    def differ(one: tuple[np.ndarray, np.ndarray], other: tuple[np.ndarray, np.ndarray]) -> bool:
        here, there = (anchors @ turn.T + shift for turn, shift in (one, other))
        return _elsewhere(here, there)

    return _distinct(near, differ)[:PLACES]


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
