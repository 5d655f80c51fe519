# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Test whether anchors differ from the survey or calibration, with a Bayesian test over Slices.

The prior of an anchor position has the standard deviations of the survey. Each anchor also has a
delay that depends on the place, because of antennas and reflections. One part of it is a smooth
function of the place, a Gaussian process as in `survey`. The other part is constant in a cell of
the room, so many slices of a cell count little more than a single slice. The evidence selects the
sizes of both parts and of unknown delays. A change of an anchor is reported if it makes the flight
ODDS times more probable. Then the search continues with the next change (`..evidence`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.geometry import ranges
from uwb_tdoa_bias.effects.effect_set import Covariance

from ..anchor_table import AnchorTable
from ..evidence import (
    DELAY,
    FUNCTION_LENGTH,
    POSITION,
    ChangeKey,
    Part,
    changes_of,
    eliminated,
    known_before,
    most_likely_changes,
    smallest_delays,
)
from .slices import TDOA_VARIANCE, Slice

CELL = 0.7  # m, size of a cell of the room
# cells in a comparison, the latest ones; and anchors that are heard in them
MOST_CELLS, MOST_ANCHORS = (150, 24)
TDOA_STD = 0.1  # m, standard deviation of one TDOA without these errors
# m, candidate standard deviations of errors that are constant in a cell
ERROR_STDS = (0.02, 0.05, 0.1, 0.2, 0.4)
# m, candidate standard deviations of functions of the place
FUNCTION_STDS = (0.01, 0.03, 0.1, 0.3)
# largest number of components of one function, and smallest mean square of a component, relative to
# that of the function
MOST_COMPONENTS, SMALLEST_COMPONENT = 10, 0.02
SURVEY_STD = 0.05  # m, prior standard deviation of coordinates without a calibration
ODDS = 1e3  # factor by which a change must raise the probability of the flight
FEWEST_SLICES = 40  # fewest slices of a comparison
MORE = TDOA_VARIANCE / TDOA_STD**2


@dataclass(frozen=True)
class Displaced:
    """Describe an anchor that differs from the survey or calibration.

    Attributes
    ----------
    row : int
        Row of the anchor.
    shift, std : (3,) array
        Position minus surveyed position and its standard deviation, in m.
    later : float
        Delay minus calibrated delay, in m.
    odds : float
        Logarithm of the odds of the change.
    either : bool
        True if a delay explains about as much as a shift.
    others : tuple of int
        Rows of anchors whose change explains about as much, the most probable first.
    """

    row: int
    shift: np.ndarray
    std: np.ndarray
    later: float
    odds: float
    either: bool
    others: tuple[int, ...] = ()

    def without(self, rows: set[int]) -> Displaced:
        """Return a copy without some rows in `others`."""
        return replace(self, others=tuple(row for row in self.others if row not in rows))


class _Cell:
    """Accumulate the information on anchor delays from all slices in one cell.

    The information has the shape (H, H) and its vector (H,), for the H anchors in `rows`.

    Attributes
    ----------
    rows : (H,) int array
        Rows of the anchors.
    place : (3,) array
        Mean position of the tag in the world frame, in m.
    slices : int
        Number of slices.
    """

    def __init__(self) -> None:
        self.rows: np.ndarray = np.empty(0, int)
        self._information: np.ndarray = np.zeros((0, 0))
        self._vector: np.ndarray = np.zeros(0)
        self.place: np.ndarray = np.zeros(3)
        self.slices = 0
        self._parts: list[Part] = []

    def add(self, piece: Slice) -> None:
        """Add a Slice."""
        rows = np.union1d(self.rows, piece.rows)
        if len(rows) > len(self.rows):
            old, information = np.searchsorted(rows, self.rows), np.zeros((len(rows),) * 2)
            vector: np.ndarray = np.zeros(len(rows))
            information[np.ix_(old, old)], vector[old] = self._information, self._vector
            self.rows, self._information, self._vector = rows, information, vector
        new = np.searchsorted(rows, piece.rows)
        self._information[np.ix_(new, new)] += MORE * piece.information
        self._vector[new] += MORE * piece.vector
        self.slices += 1
        self.place = self.place + (piece.p - self.place) / self.slices
        self._parts = []

    @property
    def parts(self) -> list[Part]:
        """Return a Part of the delays for each of ERROR_STDS, without the cell's errors."""
        if not self._parts:
            gram, vector, n = (
                np.tile(self._information, (2, 2)),
                np.tile(self._vector, 2),
                len(self.rows),
            )
            self._parts = [Part(*eliminated(gram, vector, n, std), std) for std in ERROR_STDS]
        return self._parts


class SurveyComparison:
    """Collect Slices and find anchors that differ from the survey or calibration."""

    def __init__(
        self, anchors: Anchors | AnchorTable, calibrated: Covariance | None = None
    ) -> None:
        """Create a comparison without slices.

        Parameters
        ----------
        anchors : Anchors or AnchorTable
            Surveyed anchors.
        calibrated : Covariance or None
            Covariance of their positions and delays.
        """
        self._anchors, self._calibrated = anchors, calibrated
        self._cells: dict[
            tuple[int, ...], _Cell
        ] = {}  # the cell that the tag visited last is at the end

    def add(self, piece: Slice) -> None:
        """Add a Slice."""
        key = tuple(np.floor(piece.p / CELL).astype(int).tolist())
        cell = self._cells.pop(key, None) or _Cell()
        cell.add(piece)
        self._cells[key] = cell
        if len(self._cells) > MOST_CELLS:
            del self._cells[next(iter(self._cells))]

    def forget(self, rows: set[int]) -> None:
        """Drop all cells with anchors in `rows`, which are gone."""
        self._cells = {
            key: cell for key, cell in self._cells.items() if not rows & set(cell.rows.tolist())
        }

    def find(self) -> list[Displaced]:
        """Return anchors that differ from the survey or calibration, the clearest first."""
        rows, cells = self._latest()
        if sum(cell.slices for cell in cells) < FEWEST_SLICES:
            return []
        # The unknowns are 3 n coordinates, then n delays. The survey is the mean of their prior.
        n, ids, no_offset = len(rows), self._anchors.ids[rows], np.zeros(4 * len(rows))
        parts = self._parts(rows, cells)

        def prior_of(delay_std: float) -> tuple[np.ndarray, np.ndarray]:
            variance = np.repeat([SURVEY_STD**2, delay_std**2], [3 * n, n])
            return known_before(ids, variance, self._calibrated)

        delay_std = smallest_delays(parts, lambda std: prior_of(std)[0], no_offset)
        covariance, calibrated = prior_of(delay_std)
        # a delay can only have changed if the calibration states it
        possible = {
            key: change
            for key, change in changes_of(n).items()
            if key[0] == POSITION or calibrated[change[0]].all()
        }
        changes = most_likely_changes(parts, covariance, no_offset, possible, ODDS)
        if not changes.found:
            return []
        reported: dict[ChangeKey, tuple[float, bool, tuple[int, ...]]] = {}
        for (what, k), (odds, rivals) in changes.found.items():
            either = any(row == k for _, row in rivals)
            others = tuple(dict.fromkeys(int(rows[row]) for _, row in rivals if row != k))
            # a shift is reported if the data do not distinguish it from a delay
            what = POSITION if (POSITION, k) in rivals else what
            reported[what, k] = odds, either, others
        for places, std in (possible[key] for key in reported):
            covariance[places, places] += std**2
        part, prior = parts[changes.number], np.linalg.inv(covariance)
        posterior = np.linalg.inv(part.gram + prior)
        estimate, stds = posterior @ part.vector, np.sqrt(np.diag(posterior))
        out: dict[int, Displaced] = {}
        for (what, k), (odds, either, others) in reported.items():
            own = slice(3 * k, 3 * k + 3)
            later = float(estimate[3 * n + k]) if what == DELAY else 0.0
            out.setdefault(
                k, Displaced(int(rows[k]), estimate[own], stds[own], later, odds, either, others)
            )
        return list(out.values())

    def _latest(self) -> tuple[np.ndarray, list[_Cell]]:
        """Return (rows of the anchors, cells) of the comparison."""
        rows: set[int] = set()
        cells: list[_Cell] = []
        for cell in reversed(self._cells.values()):
            more = rows | set(cell.rows.tolist())
            if cells and len(more) > MOST_ANCHORS:
                break
            rows, cells = more, [*cells, cell]
        return np.array(sorted(rows), int), cells

    def _parts(self, rows: np.ndarray, cells: Sequence[_Cell]) -> list[Part]:
        """Return a Part of coordinates and delays for each of ERROR_STDS and FUNCTION_STDS.

        Parameters
        ----------
        rows : (n,) int array
            Rows of the anchors.
        cells : sequence of _Cell
            Cells of the comparison.
        """
        n, places = len(rows), np.array([cell.place for cell in cells])
        functions = smooth_functions(places)
        k = 4 + functions.shape[1]  # unknowns of one anchor
        # derivatives of each delay in each cell by the coordinates, delay and functions of its anchor
        by = np.zeros((len(cells), n, k))
        grams = np.zeros((len(ERROR_STDS), len(cells), n, n))
        vectors = np.zeros((len(ERROR_STDS), len(cells), n))
        rests = np.zeros(len(ERROR_STDS))
        for number, cell in enumerate(cells):
            own = np.searchsorted(rows, cell.rows)
            by[number, own, :3] = -ranges(cell.place, self._anchors.positions[cell.rows])[1]
            by[number, own, 3] = 1.0
            by[number, own, 4:] = functions[number]
            for size, part in enumerate(cell.parts):
                grams[size, number][np.ix_(own, own)] = part.gram
                vectors[size, number, own] = part.vector
                rests[size] += part.rest
        unknowns = np.arange(n * k).reshape(n, k)
        order = np.concatenate([unknowns[:, :3].ravel(), unknowns[:, 3], unknowns[:, 4:].ravel()])
        parts = []
        for gram, vector, rest, error_std in zip(grams, vectors, rests.tolist(), ERROR_STDS):
            weighted = (gram[:, :, :, None] * by[:, None]).reshape(len(cells), n, n * k)
            together = by.transpose(1, 2, 0) @ weighted.transpose(1, 0, 2)
            whole = together.reshape(n * k, n * k)[np.ix_(order, order)]
            right = np.einsum("cik,ci->ik", by, vector).ravel()[order]
            for std in FUNCTION_STDS:
                less, left, more = eliminated(whole, right, 4 * n, std)
                parts.append(Part(less, left, rest + more, math.hypot(error_std, std)))
        return parts


def smooth_functions(places: np.ndarray) -> np.ndarray:
    """Return the components of a Gaussian process at places: (C, k), at most MOST_COMPONENTS.

    A function of the place is the sum of the components, each with a random factor of variance 1.
    Its standard deviation is 1 and its mean over the places is zero, because a constant is a delay.

    Parameters
    ----------
    places : (C, 3) array
        Positions in the world frame, in m.
    """
    away = np.sum((places[:, None] - places) ** 2, axis=2)
    kernel = np.exp(-0.5 * away / FUNCTION_LENGTH**2)
    kernel = kernel - kernel.mean(axis=0)
    kernel = kernel - kernel.mean(axis=1, keepdims=True)
    power, vectors = np.linalg.eigh(kernel)
    kept = np.flatnonzero(power > SMALLEST_COMPONENT * len(places))[-MOST_COMPONENTS:]
    return np.asarray(vectors[:, kept] * np.sqrt(power[kept]))
