# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Order a recording for the rules that try corrections, and fit its anchors.

`SurveyFit` estimates positions of tag and anchors together, from windows of TDOAs alone. Systematic
errors move the anchors by some decimetres. Only a larger gain speaks against a survey.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import cached_property
import math

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.flight import Flight, Imu, Tdoas
from uwb_tdoa_bias.common.sensors import Ranges
from uwb_tdoa_ekf.core import workspace
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.core.ground import KnownHeight
from uwb_tdoa_ekf.core.memory import TDOA, imu_rows, new_state, structured
from uwb_tdoa_ekf.core.ranges import APART
from uwb_tdoa_ekf.core.startup import locate, room_for
from uwb_tdoa_ekf.monitoring.explain import (
    CONFIG as WITHOUT_IMU,
    NO_IMU,
    SCALE,
    Unexplained,
    in_words,
    innovations,
    unexplained,
)
from uwb_tdoa_ekf.monitoring.finding import Finding
from uwb_tdoa_ekf.monitoring.windows import BEYOND
from uwb_tdoa_ekf.results import rows_of

from .recording import Recording

Window = tuple[np.ndarray, ...]  # t (n,) s, a and b (n,) rows of the anchors, d (n,) m

WINDOWS, LENGTH, FEWEST = 40, 0.5, 30  # windows over the recording; s each; least TDOAs in each
PRIOR = 0.5  # m, standard deviation of the survey, for each anchor
TAG, SPEED = 5.0, 1.0  # m and m/s, the same for the tag about its first position
STD, TOGETHER = 0.15, 20.0  # m, of one TDOA; most TDOAs of a window that count as independent
ROBUST = 0.4  # m, scale of the Geman-McClure weight
SWEEPS, STEP = 12, 1.0  # Gauss-Newton steps, and the longest of an anchor, m
# m, standard deviation of errors of the radio, and of their change over NEAR, m, of an anchor; number
# of functions of the place of which they consist: a constant, which is a delay, and three slopes
RADIO, NEAR, FUNCTIONS = 0.3, 2.0, 4
# thickness of positions over their size below which they lie in a plane; anchors of the measured
# rooms have 0.2 and more
FLAT_SHARE = 0.08
# the same of the places of a tag: persons and rovers 0.13 at most, measured flights 0.26 at least
THIN_SHARE = 0.2
# m of `second_principal_std`; measured flights 0.50 at least, also with ids swapped, a hovering tag
# 0.16 at most
LEAST_MOTION = 0.3


class SurveyFit:
    """Fit of tag and anchors to windows of TDOAs, which starts from the anchors as surveyed.

    Attributes
    ----------
    positions : (N, 3) array
        Anchors as surveyed, m, world.
    before : float
        Loss with these anchors, 0 to 1.
    """

    def __init__(
        self, t: np.ndarray, a: np.ndarray, b: np.ndarray, d: np.ndarray, positions: np.ndarray
    ) -> None:
        """Locate the tag in windows of TDOAs, and compute the loss `before`.

        Parameters
        ----------
        t : (n,) array
            Stamps, s, rising.
        a, b : (n,) array
            Rows of `positions`.
        d : (n,) array
            TDOAs, m.
        positions : (N, 3) array
            Anchors, m, world.
        """
        self.positions = positions
        # columns of each window, and (6,) m and m/s of the tag at its end
        self._windows, self._start = [], []
        config, state, box = FilterConfig(), new_state(positions), np.empty((2, 3))
        workspace.set_bounds(state.record.extent, config.workspace_margin, box)  # writes box
        rows = structured(TDOA, t, a, b, d, np.zeros(len(t)))
        for begin in np.linspace(t[0], t[-1] - LENGTH, WINDOWS) if len(t) else ():
            first, end = np.searchsorted(t, [begin, begin + LENGTH])
            if end - first < FEWEST:
                continue
            window, places = tuple(column[first:end] for column in (t, a, b, d)), room_for(1)
            locate(
                rows[first:end],
                state.anchors,
                box,
                config.parameters()[0],
                KnownHeight(np.nan, np.nan),  # unknown
                places,  # filled, the most probable place first
            )
            self._windows.append(window)
            self._start.append(places.x[0])
        # The loss after the tag alone is fitted: the prior of `locate` draws a fast tag towards rest.
        self.before, _ = self.solve([])

    def __len__(self) -> int:
        """Return the number of windows in which the tag was located."""
        return len(self._windows)

    @property
    def seconds(self) -> float:
        """Return the time from the first to the last window, s; 0 without windows."""
        return float(self._windows[-1][0][-1] - self._windows[0][0][0]) if self._windows else 0.0

    @property
    def heard(self) -> list[int]:
        """Return the rows of the anchors with TDOAs in the windows."""
        ends = [end for _, a, b, _ in self._windows for end in (a, b)]
        return np.unique(np.concatenate(ends)).tolist() if ends else []

    @property
    def places(self) -> np.ndarray:
        """Return the positions of the tag in the windows, (k, 3) m."""
        return np.array([x[:3] for x in self._start]).reshape(-1, 3)

    @cached_property
    def all_moved(self) -> tuple[float, np.ndarray]:
        """Return `solve` with all anchors free."""
        return self.solve()

    @cached_property
    def held_out_gain(self) -> float:
        """Return the fall of the loss in one half of the windows with anchors fitted to the other half.

        It is the mean of both halves. Errors at positions where the tag stays for a while are no errors of
        the survey.
        """
        return self._held_out(0)

    @cached_property
    def held_out_gain_of_radio(self) -> float:
        """Return the same with errors of each anchor that are linear functions of the place."""
        return self._held_out(FUNCTIONS)

    @cached_property
    def late_loss(self) -> float:
        """Return the loss with a delay of each anchor."""
        return self.solve(functions=1)[0]

    def _held_out(self, functions: int) -> float:
        half = len(self) // 2
        parts = [self._part(slice(None, half)), self._part(slice(half, None))]
        gains = [
            test.before - test.solve([], functions, fitted.solve(functions=functions)[1])[0]
            for fitted, test in (parts, parts[::-1])
        ]
        return float(np.mean(gains))

    @cached_property
    def radio_loss(self) -> float:
        """Return the loss with an error of each anchor that is a linear function of the place."""
        return self.solve(functions=FUNCTIONS)[0]

    @property
    def flat(self) -> bool:
        """Return whether the anchors that are heard lie in one plane: nothing is told across it."""
        return not len(self) or is_flat(self.positions[self.heard])

    @cached_property
    def thin(self) -> bool:
        """Return whether the tag moves in a plane: its anchors are told apart poorly across it."""
        size, thickness = size_and_thickness(self.places)
        return thickness < THIN_SHARE * size

    def _part(self, windows: slice) -> SurveyFit:
        """Return the same fit for some of the windows."""
        part = copy(self)
        part._windows, part._start = self._windows[windows], self._start[windows]
        part.before, _ = part.solve([])
        return part

    def solve(
        self,
        free: Sequence[int] | None = None,
        functions: int = 0,
        given: np.ndarray | None = None,
    ) -> tuple[float, np.ndarray]:
        """Move the tag, and the anchors in `free`, to the least loss.

        Each Gauss-Newton step eliminates the states of the tag, one per window (Schur complement).
        With the blocks A of a state, B of state and anchors, and C of the anchors, the anchors are
        solved from the sum of C - B' A^-1 B over the windows.

        Parameters
        ----------
        free : sequence of int or None
            Rows of the anchors that are moved, or have errors; None for all.
        functions : int
            If not 0, leave the anchors where they are, and fit errors of their signals: the first of
            the FUNCTIONS of the place.
        given : array or None
            Where to begin, as `anchors` below; None for the anchors as surveyed, without errors.

        Returns
        -------
        loss : float
            Remaining loss, 0 to 1.
        anchors : (N, 3) array
            Positions, m, world; with `functions` (N, functions) errors and their slopes, m.
        """
        count = len(self.positions)
        moved = np.ones(count, dtype=bool) if free is None else np.isin(range(count), free)
        size, std = (functions, RADIO) if functions else (3, PRIOR)
        columns = np.flatnonzero(np.repeat(moved, size))  # free unknowns
        surveyed = 0.0 if functions else self.positions
        unknown = np.zeros((count, size)) if given is None else given - surveyed
        start = [x.copy() for x in self._start]
        # In a hall each window has few of the anchors.
        heard = [moved & np.isin(np.arange(count), ends[1:3]) for ends in self._windows]
        # columns of their unknowns
        heard_columns = [np.flatnonzero(np.repeat(some[moved], size)) for some in heard]
        for _ in range(SWEEPS):
            H = np.eye(len(columns)) / std**2
            g = -unknown.reshape(-1)[columns] / std**2
            eliminated = []
            for x, window, some, own in zip(start, self._windows, heard, heard_columns):
                residual, by_tag, ends = self._linearised(x, window, unknown)
                by_anchors = _by_anchors(window, ends, some)
                weight = (
                    min(1.0, TOGETHER / len(residual))
                    / (STD * (1.0 + (residual / ROBUST) ** 2)) ** 2
                )
                left = by_tag * weight[:, None]
                A = left.T @ by_tag + np.diag([TAG**-2] * 3 + [SPEED**-2] * 3)
                B = left.T @ by_anchors
                c = left.T @ residual - np.r_[np.zeros(3), x[3:] / SPEED**2]
                solved = np.linalg.solve(A, np.column_stack([B, c]))
                H[np.ix_(own, own)] += (
                    by_anchors.T @ (weight[:, None] * by_anchors) - B.T @ solved[:, :-1]
                )
                g[own] += by_anchors.T @ (weight * residual) - B.T @ solved[:, -1]
                eliminated.append(solved)
            step = np.linalg.solve(H, g)
            step *= min(1.0, STEP / max(np.abs(step).max(initial=0.0), 1e-9))
            unknown.reshape(-1)[columns] += step
            for x, solved, own in zip(start, eliminated, heard_columns):
                x += np.clip(solved[:, -1] - solved[:, :-1] @ step[own], -2.0, 2.0)
        return self._loss(start, unknown), surveyed + unknown

    def _loss(self, states: list[np.ndarray], unknown: np.ndarray) -> float:
        """Return the mean Geman-McClure loss over the windows."""
        squares = (
            self._linearised(x, window, unknown)[0] ** 2 for x, window in zip(states, self._windows)
        )
        return (
            float(np.mean([np.mean(square / (square + SCALE**2)) for square in squares]))
            if states
            else np.nan
        )

    def _linearised(
        self, x: np.ndarray, window: Window, unknown: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Return residuals (n,) m, their Jacobian (n, 6) by position and velocity of the tag, and more.

        That is the Jacobians by the unknowns of the anchors a and b, (n, size) each. `unknown` is as in
        `solve`: (N, 3) by which the anchors are moved, or (N, 1) or (N, 4) errors of their signals.
        """
        t, a, b, d = window
        place = np.append(1.0, (x[:3] - self.positions.mean(axis=0)) / NEAR)[: unknown.shape[1]]
        moved = unknown.shape[1] == 3
        anchors = self.positions + unknown if moved else self.positions
        late = np.zeros(len(anchors)) if moved else unknown @ place
        before = t - t[-1]
        tag = x[:3] + before[:, None] * x[3:]
        from_a, from_b = tag - anchors[a], tag - anchors[b]
        ra, rb = (np.maximum(np.linalg.norm(v, axis=1), 1e-6) for v in (from_a, from_b))
        residual = d - (rb + late[b] - ra - late[a])
        by_a, by_b = from_a / ra[:, None], -from_b / rb[:, None]
        by_tag = np.column_stack([-by_b - by_a, before[:, None] * (-by_b - by_a)])
        if not moved:
            by_a, by_b = np.tile(-place, (len(d), 1)), np.tile(place, (len(d), 1))
        return residual, by_tag, (by_a, by_b)


def _by_anchors(window: Window, by_ends: Sequence[np.ndarray], moved: np.ndarray) -> np.ndarray:
    """Return the Jacobian (n, k size) by the k anchors in `moved` (N,), of those by both ends."""
    out = np.zeros((len(window[0]), int(moved.sum()), by_ends[0].shape[1]))
    number = np.cumsum(moved) - 1
    for ends, by_end in zip(window[1:3], by_ends):
        rows = np.flatnonzero(moved[ends])
        out[rows, number[ends[rows]]] += by_end[rows]
    return np.asfortranarray(out.reshape(len(out), -1))


def differences(ranges: Ranges, anchors: Anchors) -> Tdoas:
    """Return the TDOAs of successive Ranges to two known anchors, less than APART apart."""
    known = np.flatnonzero(
        (anchors.index(ranges.anchor) >= 0) & np.isfinite(ranges.t) & np.isfinite(ranges.d)
    )
    known = known[np.argsort(ranges.t[known], kind="stable")]
    t, ids, d = ranges.t[known], ranges.anchor[known], ranges.d[known]
    kept = np.flatnonzero((ids[1:] != ids[:-1]) & (np.diff(t) < APART)) + 1
    return Tdoas(t[kept], ids[kept - 1], ids[kept], d[kept] - d[kept - 1])


def displacement(surveyed: np.ndarray, fitted: np.ndarray) -> np.ndarray:
    """Return how far each anchor moved, (N,) m, after the best common rotation and translation."""
    one, two = surveyed - surveyed.mean(axis=0), fitted - fitted.mean(axis=0)
    turn, _ = Rotation.align_vectors(one, two)
    return np.linalg.norm(turn.apply(two) - one, axis=1)


def size_and_thickness(positions: np.ndarray) -> tuple[float, float]:
    """Return the largest and smallest standard deviation of positions (n, 3) along a direction, m."""
    size, thickness = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)[
        [0, 2]
    ] / np.sqrt(len(positions))
    return float(size), float(thickness)


def is_flat(positions: np.ndarray) -> bool:
    """Return whether positions (n, 3) lie in one plane."""
    size, thickness = size_and_thickness(positions)
    return thickness < FLAT_SHARE * size


def second_principal_std(places: np.ndarray) -> float:
    """Return the second largest principal standard deviation of positions (k, 3) m, in m.

    It is 0 for fewer than two positions, and for a tag at rest or on one line. Such a tag cannot
    distinguish an anchor from its mirror image.
    """
    if len(places) < 2:
        return 0.0
    return float(
        np.linalg.svd(places - places.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(places))
    )


LONG, SHORT = 60.0, 14.0  # s of the recording for trials: to decide, and to choose candidates
PERIOD = 1.0  # s over which motion is measured, to choose that part


@dataclass(frozen=True)
class OrderedRecording:
    """Streams in the order of their stamps, without values that are not finite.

    Attributes
    ----------
    anchors : Anchors
        The survey.
    tdoa : Tdoas
        TDOAs.
    imu : Imu or None
        Inertial samples.
    """

    anchors: Anchors
    tdoa: Tdoas
    imu: Imu | None

    @classmethod
    def of(cls, recording: Recording) -> OrderedRecording:
        """Return the OrderedRecording of a Recording."""
        tdoa, imu = recording.tdoa, recording.imu
        good = np.flatnonzero(np.isfinite(tdoa.t) & np.isfinite(tdoa.d))
        tdoa = rows_of(tdoa, good[np.argsort(tdoa.t[good], kind="stable")])
        if imu is not None:
            good = np.flatnonzero(
                np.isfinite(np.column_stack([imu.t, imu.gyro, imu.accel])).all(axis=1)
            )
            imu = rows_of(imu, good[np.argsort(imu.t[good], kind="stable")])
        return cls(recording.anchors, tdoa, imu if imu is not None and len(imu) else None)

    def part(self, length: float) -> OrderedRecording:
        """Return the `length` s in which the TDOAs change most; the whole if it is not longer."""
        t = self.tdoa.t
        if not len(t) or t[-1] - t[0] <= length:
            return self
        begin = _busiest(self, length)
        first, end = np.searchsorted(t, [begin, begin + length])
        imu = self.imu
        if imu is not None:
            imu = rows_of(imu, slice(*np.searchsorted(imu.t, [begin, begin + length])))
        return replace(
            self,
            tdoa=rows_of(self.tdoa, slice(first, end)),
            imu=imu if imu is not None and len(imu) else None,
        )

    def with_tdoa(self, **columns: np.ndarray) -> OrderedRecording:
        """Return the same with other columns of the TDOAs."""
        return replace(self, tdoa=replace(self.tdoa, **columns))

    def with_imu(self, **columns: np.ndarray) -> OrderedRecording:
        """Return the same with other columns of the inertial samples."""
        assert self.imu is not None
        return replace(self, imu=replace(self.imu, **columns))

    def possible(self) -> OrderedRecording:
        """Return the same without TDOAs that exceed the distance of their anchors."""
        a, b = self.rows()
        apart = np.linalg.norm(self.anchors.positions[a] - self.anchors.positions[b], axis=1)
        kept = (a < 0) | (b < 0) | (np.abs(self.tdoa.d) <= apart + BEYOND)
        return replace(self, tdoa=rows_of(self.tdoa, np.flatnonzero(kept)))

    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows of the anchors of each TDOA, two (n,) arrays, -1 for unknown ids."""
        return self.anchors.index(self.tdoa.a), self.anchors.index(self.tdoa.b)

    def scaled(self, factor: float) -> OrderedRecording:
        """Return the same with a survey that is smaller by a factor."""
        return replace(self, anchors=self.anchors.at(self.anchors.positions / factor))

    def unexplained(
        self, limit: float = math.inf, config: FilterConfig = WITHOUT_IMU
    ) -> Unexplained:
        """Return the Unexplained of the TDOAs by a filter, which takes the IMU if `config` does.

        limit : if the mean loss is certain to exceed this, the result holds no blocks, see
            `monitoring.explain.unexplained`.
        """
        tdoa, samples = self.tdoa, NO_IMU
        rows = structured(TDOA, tdoa.t, *self.rows(), tdoa.d, tdoa.variance)
        if self.imu is not None and config.use_imu:
            samples, usable = imu_rows(self.imu.t, self.imu.gyro, self.imu.accel)
            samples = samples[usable]
        return unexplained(rows, self.anchors.positions, samples, config, limit)

    def innovations(self) -> np.ndarray:
        """Return the innovations of a filter without the IMU, (n,) m, NaN for unusable TDOAs."""
        positions = self.anchors.positions
        rows = structured(TDOA, self.tdoa.t, *self.rows(), self.tdoa.d, self.tdoa.variance)
        return innovations(new_state(positions), rows, positions)

    @cached_property
    def survey_fit(self) -> SurveyFit:
        """Return the SurveyFit of the TDOAs between known anchors."""
        a, b = self.rows()
        known = (a >= 0) & (b >= 0) & (a != b)
        return SurveyFit(
            self.tdoa.t[known], a[known], b[known], self.tdoa.d[known], self.anchors.positions
        )

    def flight(self) -> Flight:
        """Return a Flight without ground truth."""
        return Flight("checked", self.anchors, self.tdoa, self.imu)


@dataclass(frozen=True)
class Trial:
    """A recording with one mistake undone.

    Attributes
    ----------
    recording : OrderedRecording
        The corrected recording.
    finding : Finding
        What to report, without evidence, if the correction explains much more.
    share : float
        Share of the TDOAs that it changes.
    """

    recording: OrderedRecording
    finding: Finding
    share: float = 1.0

    def explained(self, ratio: float, z: float) -> Finding:
        """Return the Finding for the ratio of the losses and its number of standard errors."""
        return replace(self.finding, evidence=in_words(ratio, z), value=ratio)


def _busiest(recording: OrderedRecording, length: float) -> float:
    """Return the stamp at which the `length` s begin in which the TDOAs of the pairs change most."""
    t, d = recording.tdoa.t, recording.tdoa.d
    pair = np.unique(recording.tdoa.a * 65536 + recording.tdoa.b, return_inverse=True)[1].reshape(
        -1
    )
    second = np.floor((t - t[0]) / PERIOD).astype(np.int64)
    order = np.lexsort((second, pair))
    begins = np.flatnonzero(np.diff(pair[order], prepend=-1) | np.diff(second[order], prepend=-1))
    mean = np.add.reduceat(d[order], begins) / np.diff(begins, append=len(order))
    # One row for each pair and each second with TDOAs:
    pair, second = pair[order][begins], second[order][begins]
    following = (np.diff(pair) == 0) & (np.diff(second) == 1)
    # Only seconds with TDOAs: a long pause needs no memory.
    seconds, place = np.unique(second, return_inverse=True)
    motion = np.bincount(
        place[1:][following],
        np.minimum(np.abs(np.diff(mean))[following], 1.0),
        minlength=len(seconds),
    )
    total = np.concatenate([[0.0], np.cumsum(motion)])
    until = np.searchsorted(seconds, seconds + int(length / PERIOD))
    best = int(seconds[np.argmax(total[until] - total[:-1])])
    return t[0] + min(best * PERIOD, t[-1] - t[0] - length)
