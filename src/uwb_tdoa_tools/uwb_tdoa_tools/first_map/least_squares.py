# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Robust least squares for anchors and the path of the tag together.

The unknowns are the position of the tag in each time bin, and the columns `Layout` of anchors and
flights. Levenberg-Marquardt steps solve sparse normal equations. The search starts them from many points.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import least_squares
from scipy.sparse import csc_matrix, csr_matrix, diags
from scipy.sparse.csgraph import shortest_path
from scipy.sparse.linalg import SuperLU, splu
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
    """Observations, and what of them a fit uses.

    Attributes
    ----------
    std : (n,) standard deviations of the residuals of a `Fit`; robust : (n,) bool, under Student's t
    """

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
        self.middle = seen.middle
        known = np.isfinite(seen.accel[self.middle]).all(axis=1)
        self.measured = known & inertial
        self.accel = np.where(self.measured[:, None], np.nan_to_num(seen.accel[self.middle]), 0.0)
        self.of_flight = self.layout.of_flights[seen.flight]
        self.high = np.flatnonzero(np.isfinite(seen.height) & frame)
        ends = seen.distances[:, :2].astype(int)
        self.ends = ends[:, 0], ends[:, 1]
        self.known = seen.coordinates if frame else seen.coordinates[:0]
        row, axis = self.known[:, :2].astype(int).T
        self.coordinates = 3 * row + axis
        prior = np.empty(self.layout.size)
        prior[self.layout.positions], prior[self.layout.delays] = ANYWHERE, DELAY
        prior[self.layout.between] = max(seen.delay_std, HELD)
        prior[5 * len(seen.ids) :] = np.tile(PER_FLIGHT, seen.flights)
        parts = {
            "radio": seen.std * wide * (LASTING if frame else 1.0),
            "prior": prior,
            "coordinate": self.known[:, 3],
            "distance": seen.distances[:, 3] * wide,
            "height": np.full(len(self.high), HEIGHT_STD),
            "motion": np.repeat(np.where(self.measured, ACCEL_STD, MOTION), 3),
        }
        self.std = np.concatenate([*parts.values()])
        names = np.repeat([*parts], [len(part) for part in parts.values()])
        self.robust = np.isin(names, ["radio", "distance", "height"])
        self.rows = {name: np.flatnonzero(names == name) for name in parts}

    def solve(self, path: np.ndarray, columns: np.ndarray) -> Fit:
        """Return the minimum that Levenberg-Marquardt steps reach from path (J, 3) and columns."""
        state = Fit(self, path, columns)
        damping = DAMPING
        for _ in range(STEPS):
            equations = Equations(state)
            for _ in range(TRIES):
                following = equations.following(damping)
                if following.cost < state.cost:
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


class Fit:
    """Residuals of a Problem at a path and columns; `Problem.solve` returns that of a minimum.

    Attributes
    ----------
    path : (J, 3) m; columns : (k,); anchors : (N, 3) m, positions in the columns
    radio, distance, height : m, accel : (m, 3) m/s^2, residuals; residual : (n,), all of them
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
        coordinate = columns[problem.coordinates] - problem.known[:, 2]
        parts = self.radio, columns, coordinate, self.distance, self.height, self.accel.ravel()
        self.residual = np.concatenate(parts)
        square = (self.residual / problem.std) ** 2
        likely = (NU + 1.0) * np.log1p(square[problem.robust] / NU)
        self.cost = 0.5 * float(likely.sum() + square[~problem.robust].sum())

    @property
    def weight(self) -> np.ndarray:
        """Weights of the residuals, (n,): those of Student's t where they are robust."""
        std, robust = self.problem.std, self.problem.robust
        students = (NU + 1.0) / (NU + (self.residual / std) ** 2)
        return np.where(robust, students, 1.0) / std**2

    def jacobian(self) -> csr_matrix:
        """Return the derivatives of the residuals by the path and the columns, (n, 3J + k)."""
        problem, layout, xyz = self.problem, self.problem.layout, np.arange(3)
        seen, two, size = problem.seen, problem.two, 3 * problem.bins
        entries: list[list[np.ndarray]] = []

        def add(rows: ArrayLike, columns: ArrayLike, values: ArrayLike) -> None:
            entries.append([part.ravel() for part in np.broadcast_arrays(rows, columns, values)])

        rows = problem.rows["radio"]
        add(
            rows[:, None],
            3 * seen.bin[:, None] + xyz,
            self.by_b - np.where(two[:, None], self.by_a, 0.0),
        )
        add(rows[:, None], size + 3 * seen.b[:, None] + xyz, -self.by_b)
        add(rows[two, None], size + 3 * seen.a[two, None] + xyz, self.by_a[two])
        add(rows, size + layout.delays.start + seen.b, 1.0)
        add(rows[two], size + layout.delays.start + seen.a[two], -1.0)
        add(rows[~two], size + problem.of_flight[seen.bin[~two]] + 5, 1.0)
        add(problem.rows["prior"], size + np.arange(layout.size), 1.0)
        add(problem.rows["coordinate"], size + problem.coordinates, 1.0)
        for end, sign in zip(problem.ends, (1.0, -1.0)):
            rows = problem.rows["distance"]
            add(rows[:, None], size + 3 * end[:, None] + xyz, sign * self.along)
            add(rows, size + layout.between.start + end, 1.0)
        add(problem.rows["height"], 3 * problem.high + 2, 1.0)
        rows, middle = problem.rows["motion"].reshape(-1, 3), problem.middle[:, None]
        for shift, factor in ((-1, 1.0), (0, -2.0), (1, 1.0)):
            add(rows, 3 * (middle + shift) + xyz, factor / STEP**2)
        of_flight = size + problem.of_flight[middle]
        by_yaw = self.turned[:, [1, 0]] * [1.0, -1.0]
        add(rows[:, :2], of_flight, by_yaw)
        add(rows[:, :2], of_flight + 1, by_yaw * seen.t[middle])
        add(rows, of_flight + [2, 3, 4], -1.0 * problem.measured[:, None])
        rows, columns, values = (np.concatenate(parts) for parts in zip(*entries))
        return csr_matrix((values, (rows, columns)), (len(self.residual), size + layout.size))


class Equations:
    """Normal equations of a Problem at a path and columns.

    Attributes
    ----------
    path_gradient : (3J,), gradient : (k,) of the cost by the path and by the columns
    """

    def __init__(self, state: Fit) -> None:
        self.state, self.problem = state, state.problem
        self._size = 3 * self.problem.bins
        self._jacobian = state.jacobian()
        self._weighted = self._jacobian.T.multiply(state.weight).tocsr()
        gradient = self._weighted @ state.residual
        self.path_gradient, self.gradient = np.split(gradient, [self._size])
        weak = np.where(np.arange(len(gradient)) < self._size, WEAK, 0.0)
        self._information = (self._weighted @ self._jacobian + diags(weak)).tocsc()

    def following(self, damping: float) -> Fit:
        """Return the state after a step."""
        damped = self._information + diags(damping * self._information.diagonal())
        gradient = np.concatenate([self.path_gradient, self.gradient])
        path, columns = np.split(-_factor(damped).solve(gradient), [self._size])
        state = self.state
        return Fit(self.problem, state.path + path.reshape(-1, 3), state.columns + columns)

    @cached_property
    def _solver(self) -> SuperLU:
        return _factor(self._information)

    @cached_property
    def covariance(self) -> np.ndarray:
        """Covariance of the columns, (k, k), for independent errors."""
        every = np.eye(self._information.shape[0])
        return self._solver.solve(every[:, self._size :])[self._size :]

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

    def response(self, errors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the errors of the columns (k, s) that s draws of errors of measurements cause.

        Also return the residuals of radio measurements with these errors, (n, s) m.

        Errors of accelerations move the path. What yaw and biases could take up of them is not counted:
        the stated deviations are larger by that.

        errors : (n, s), of the measurements of all residuals
        """
        gradient, motion = self._weighted @ errors, self.problem.rows["motion"]
        gradient[self._size :] -= self._weighted[self._size :, motion] @ errors[motion]
        change = self._solver.solve(gradient)
        left = self._jacobian @ change - errors
        return change[self._size :], left[self.problem.rows["radio"]]


def _factor(information: csc_matrix) -> SuperLU:
    """Return the factor of normal equations: those of the path are banded, the columns come last."""
    settings: dict[str, Any] = {"permc_spec": "NATURAL", "diag_pivot_thresh": 0.0}
    return splu(information.tocsc(), **settings, options={"SymmetricMode": True})


def _length(line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return lengths (n,) of lines (n, 3), and their directions."""
    length = np.sqrt(np.sum(line**2, axis=1) + 1e-9)
    return length, line / length[:, None]


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
