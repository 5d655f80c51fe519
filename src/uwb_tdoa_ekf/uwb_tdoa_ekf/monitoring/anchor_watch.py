# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reduce residuals to delays of anchors, and compare these with the survey.

Slice: reduce the residuals of half a second to one delay for each anchor. A TDOA has anchors with
the delays delay_a and delay_b. Its prediction uses a position with the error e. Its innovation is
delay_b - delay_a + (u_b - u_a) e. Here u is the unit vector from an anchor to the tag. The
position error is marginalized. The result contains the combinations of delays that no position
error explains.

SurveyComparison: test whether anchors differ from the survey or calibration, with a Bayesian test
over Slices. The prior of an anchor position has the standard deviations of the survey. Each anchor
also has a delay that depends on the place, because of antennas and reflections. One part of it is
a smooth function of the place, a Gaussian process as in `survey`. The other part is constant in a
cell of the room, so many slices of a cell count little more than a single slice. The evidence
selects the sizes of both parts and of unknown delays. A change of an anchor is reported if it
makes the flight ODDS times more probable. Then the search continues with the next change
(`..evidence`).
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

LENGTH = 0.5  # s of stamps of one slice
CLIP = 1.5  # m; larger innovations are clipped to this
FEWEST = 10  # fewest TDOAs of a slice that show an exchange, or signs that turn
TDOA_VARIANCE = 0.02  # m^2, noise variance of one TDOA without its constant errors
PLACE_STD = 0.5  # m, standard deviation of the position of the filter
DELAY_STD = (
    0.15  # m, prior standard deviation of a delay, without its part that depends on the place
)
# largest number of anchors in a slice; the anchors with the fewest TDOAs are left out
MOST = 100


@dataclass(frozen=True)
class Slice:
    """Store the delays of all anchors that are heard in half a second.

    Attributes
    ----------
    t : float
        Stamp of the middle, in s.
    p : (3,) array
        Position of the filter in the world frame, in m.
    rows : (H,) int array
        Rows of the anchors, at most MOST.
    delays : (H,) array
        Minimum mean square error estimate of their delays, in m.
    response : (H, H) array
        Change of the estimate (row) per metre of delay of each anchor (column).
    information : (H, H) array
        Information of the TDOAs alone on the delays, with the position marginalized, in 1/m^2.
    vector : (H,) array
        Information vector, in 1/m.
    """

    t: float
    p: np.ndarray
    rows: np.ndarray
    delays: np.ndarray
    response: np.ndarray
    information: np.ndarray
    vector: np.ndarray


def reduced(
    t: float,
    p: np.ndarray,
    positions: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    innovation: np.ndarray,
) -> Slice:
    """Return the Slice of TDOAs.

    Parameters
    ----------
    t : float
        Stamp of the middle, in s.
    p : (3,) array
        Position of the filter in the world frame, in m.
    positions : (N, 3) array
        Anchor positions in the world frame, in m.
    a, b : (n,) int array
        Rows of the anchors of each TDOA.
    innovation : (n,) array
        Innovations, in m.
    """
    value = np.clip(innovation, -CLIP, CLIP)
    rows, a, b, value = _heard_most(a, b, value)
    n = len(rows)
    heard = np.bincount(a, minlength=n) + np.bincount(b, minlength=n)
    both = np.bincount(a * n + b, minlength=n * n).reshape(n, n)
    information = (np.diag(heard) - both - both.T) / TDOA_VARIANCE
    vector = (np.bincount(b, value, n) - np.bincount(a, value, n)) / TDOA_VARIANCE
    direction = ranges(p, positions[rows])[1]
    of_place = information @ direction
    gain = np.linalg.solve(direction.T @ of_place + np.eye(3) / PLACE_STD**2, of_place.T)
    information = information - of_place @ gain
    vector = vector - gain.T @ (direction.T @ vector)
    both = np.linalg.solve(
        information + np.eye(n) / DELAY_STD**2, np.column_stack([vector, information])
    )
    return Slice(t, p, rows, both[:, 0], both[:, 1:], information, vector)


def _heard_most(
    a: np.ndarray, b: np.ndarray, value: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the anchors with the most TDOAs, at most MOST, and the TDOAs between them.

    Returns
    -------
    rows : (H,) int array
        Rows of the anchors.
    a, b : (k,) int array
        Anchors of each TDOA as places in `rows`.
    value : (k,) array
        Innovations, in m.
    """
    rows, both = np.unique(np.concatenate([a, b]), return_inverse=True)
    often = np.sort(np.argsort(-np.bincount(both, minlength=len(rows)), kind="stable")[:MOST])
    place = np.full(len(rows), -1)
    place[often] = np.arange(len(often))
    a, b = place[both[: len(a)]], place[both[len(a) :]]
    kept = (a >= 0) & (b >= 0)
    return rows[often], a[kept], b[kept], value[kept]


TURNED = 0.75  # m, change of a TDOA with its sign below which it shows nothing
OTHER_LEAVES = 0.35  # largest share of that change that the other sign may leave
# Shares of the significant TDOAs: smallest share that the other sign must explain, and largest
# share that the present sign may explain. After a flip these were 0.66 to 1.0 and 0.0 in simulated
# flights. Near a floor, where anchors are metres late, they were 0.67 and 0.3.
TURNING, PRESENT = 0.6, 0.1


def turned(innovation: np.ndarray, predicted: np.ndarray) -> bool:
    """Return whether the other sign explains the innovations of a slice.

    All TDOAs far from zero count, including those that the filter explains. If a few anchors are
    late, as near a floor, most TDOAs therefore contradict a flip.

    Parameters
    ----------
    innovation : (n,) array
        Innovations, in m.
    predicted : (n,) array
        TDOAs predicted at the position of the filter, in m.
    """
    change = np.abs(2.0 * predicted)
    asked = change > TURNED
    if np.count_nonzero(asked) < FEWEST:
        return False
    small = OTHER_LEAVES * change[asked]
    left = np.abs(2.0 * predicted[asked] + innovation[asked])  # -(-d - predicted) for a measured d
    return bool(
        np.mean(left < small) > TURNING and np.mean(np.abs(innovation[asked]) < small) < PRESENT
    )


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
