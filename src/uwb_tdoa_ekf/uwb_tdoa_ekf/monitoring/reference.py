"""Test whether anchors differ from the survey or calibration, with a Bayesian test over Slices.

The prior of an anchor position has the standard deviations of the survey. Each anchor also has a
delay that depends on the place, because of antennas and reflections. Slices in one cell of the room
share this error. Many slices of a cell therefore count little more than a single slice. A part of
the error is a slope over all cells. The evidence selects the size of such errors. A change of an
anchor is reported if it makes the flight ODDS times more probable. Then the search continues with
the next change (`..evidence`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.geometry import ranges

from ..evidence import (
    DELAY,
    POSITION,
    Part,
    changes_of,
    eliminated,
    known_before,
    most_likely_changes,
)
from .slices import TDOA_VARIANCE

if TYPE_CHECKING:
    from collections.abc import Sequence

    from uwb_tdoa_bias.common.anchors import Anchors
    from uwb_tdoa_bias.effects.effect_set import Covariance

    from ..anchor_table import AnchorTable
    from ..evidence import ChangeKey
    from .slices import Slice

CELL = 0.7  # m, size of a cell of the room
# cells in a comparison, the latest ones; and anchors that are heard in them
MOST_CELLS, MOST_ANCHORS = (150, 24)
TDOA_STD = 0.1  # m, standard deviation of one TDOA without these errors
# m, standard deviations of errors that are constant in a cell; the evidence selects one
ERROR_STDS = (0.02, 0.05, 0.1, 0.15, 0.22, 0.32, 0.45, 0.65)
# m, prior standard deviations of coordinates and of delays without a calibration
SURVEY_STD, DELAY_STD = (0.05, 0.15)
ODDS = 1e3  # factor by which a change must raise the probability of the flight
FEWEST_CELLS, FEWEST_SLICES = 12, 40  # fewest cells and slices of a comparison
SLOPES = 0.5  # 1/m, standard deviation of the slope of errors over cells, relative to their size
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
        if len(cells) < FEWEST_CELLS or sum(cell.slices for cell in cells) < FEWEST_SLICES:
            return []
        n, positions = len(rows), self._anchors.positions[rows]
        parts = self._parts(rows, positions, cells)
        variance = np.repeat([SURVEY_STD**2, DELAY_STD**2], [3 * n, n])
        covariance, known = known_before(self._anchors.ids[rows], variance, self._calibrated)
        possible = {
            key: one
            for key, one in changes_of(n).items()
            if key[0] == POSITION or known[one[0]].all()
        }
        changes = most_likely_changes(parts, covariance, np.zeros(4 * n), possible, ODDS)
        if not changes.found:
            return []
        named: dict[ChangeKey, tuple[float, bool, tuple[int, ...]]] = {}
        for (what, k), (odds, rivals) in changes.found.items():
            either = any(row == k for _, row in rivals)
            others = tuple(dict.fromkeys(int(rows[row]) for _, row in rivals if row != k))
            named[POSITION if (POSITION, k) in rivals else what, k] = odds, either, others
        for some, size in (
            possible[key] for key in named
        ):  # a shift is assumed if the data do not distinguish it from a delay
            covariance[some, some] += size**2
        part, prior = parts[changes.number], np.linalg.inv(covariance)
        inverse = np.linalg.inv(part.gram + prior)
        step, std = inverse @ part.vector, np.sqrt(np.diag(inverse))
        out: dict[int, Displaced] = {}
        for (what, k), (odds, either, rival_rows) in named.items():
            places = slice(3 * k, 3 * k + 3)
            later = float(step[3 * n + k]) if what == DELAY else 0.0
            out.setdefault(
                k,
                Displaced(int(rows[k]), step[places], std[places], later, odds, either, rival_rows),
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

    def _parts(self, rows: np.ndarray, positions: np.ndarray, cells: Sequence[_Cell]) -> list[Part]:
        """Return a Part of coordinates and delays for each of ERROR_STDS.

        Parameters
        ----------
        rows : (n,) int array
            Rows of the anchors.
        positions : (n, 3) array
            Their positions in the world frame, in m.
        cells : sequence of _Cell
            Cells of the comparison.
        """
        n, middle = len(rows), np.mean([cell.place for cell in cells], axis=0)
        grams, vectors, rests = (
            np.zeros((len(ERROR_STDS), 7 * n, 7 * n)),
            np.zeros((len(ERROR_STDS), 7 * n)),
            np.zeros(len(ERROR_STDS)),
        )
        for cell in cells:
            own = np.searchsorted(rows, cell.rows)
            towards = ranges(cell.place, positions[own])[1]
            axes = (3 * own[:, None] + np.arange(3)).ravel()
            columns = np.concatenate([axes, 3 * n + own, 4 * n + axes])
            # derivatives of delays by coordinates, delays and slopes
            by, each = (np.zeros((len(own), 7 * len(own))), np.arange(len(own)))
            for axis in range(3):
                by[each, 3 * each + axis] = -towards[:, axis]
                by[each, 4 * len(own) + 3 * each + axis] = cell.place[axis] - middle[axis]
            by[each, 3 * len(own) + each] = 1.0
            for k, part in enumerate(cell.parts):
                grams[k][np.ix_(columns, columns)] += by.T @ part.gram @ by
                vectors[k][columns] += by.T @ part.vector
                rests[k] += part.rest
        parts = []
        for gram, vector, rest, std in zip(grams, vectors, rests, ERROR_STDS):
            less, right, more = eliminated(gram, vector, 4 * n, SLOPES * std)
            parts.append(Part(less, right, float(rest) + more, std))
        return parts
