# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Watch residuals for anchors that change or differ from their survey.

Slice: reduce the residuals of half a second to one delay for each anchor. A TDOA has anchors with
the delays delay_a and delay_b. Its prediction uses a position with the error e. Its innovation is
delay_b - delay_a + (u_b - u_a) e. Here u is the unit vector from an anchor to the tag. The
position error is marginalized. The result contains the combinations of delays that no position
error explains.

ChangeDetector: test sequentially over Slices whether one anchor has changed. The delays of the
anchors depend on the place, because of antennas, reflections and survey errors. A Gaussian process
over the place (kernel below) learns the delays in flight. Its whitened one-step prediction errors
contain the new information.

The test considers each anchor and each onset within the last seconds. It is a generalized
likelihood ratio (Willsky and Jones, IEEE Trans. Automatic Control 21, 1976). It compares a delay
that begins at the onset with no delay. A delay that grows becomes several such steps. The response
to the delay is whitened like the errors. The ratio is divided by the mean square of the errors
before the onset. A flight with larger errors than the kernel expects therefore needs a larger
change.

Memory and time grow with the anchors that are heard, not with those that are installed. An anchor
has a column while any stored slice contains it. Responses are stored only for anchors heard in a
slice, and only for slices that may hold an onset.

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
from uwb_tdoa_bias.common.compiled import compiled
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


# m, standard deviation of the place-dependent part, and its correlation length
GRADUAL_STD, GRADUAL_LENGTH = 0.2, 0.9
# m, m, s, standard deviation, length and time of the part that lasts while the tag stays
LOCAL_STD, LOCAL_LENGTH, LOCAL_TIME = (0.05, 0.3, 2.0)
NOISE_STD = 0.1  # m, standard deviation of independent noise in each slice
# normalised square of a slice's error above which its variance is raised until the square is this
OUTLIER = 3.0
# largest normalised square of a slice for the scale of the flight
LARGEST_ERROR = 8.0
# smallest scale; a flight with smaller errors is treated as if it had this scale
SMALLEST_SCALE = 1.0
# prior scale (mean normalised square), and its weight in slices
SCALE, SCALE_SLICES = (2.0, 20)
# slices in which the test searches for an onset, and smallest age of an onset in slices
WINDOW, YOUNGEST = 24, 4
CAPACITY = 240  # slices that are stored


@dataclass(frozen=True)
class Change:
    """Describe a delay of one anchor that began in flight.

    Attributes
    ----------
    row : int
        Row of the anchor.
    since : float
        Stamp of the onset, in s.
    size : float
        Delay, in m.
    ratio : float
        Twice the log of the likelihood ratio of the change, over the scale of the errors before it.
    rival : float
        The same of the best change of any other anchor.
    left : float
        Mean square of the unexplained errors since the onset over that before it.
    """

    row: int
    since: float
    size: float
    ratio: float
    rival: float
    left: float

    def at(self, t: float) -> np.ndarray:
        """Return the delay, in m, at stamps t, in s."""
        return np.where(t > self.since, self.size, 0.0)


class ChangeDetector:
    """Test Slices in the order of their stamps for a change of one anchor.

    `find` searches for a Change, and `compensate` subtracts it from all later results.
    """

    def __init__(self) -> None:
        room = CAPACITY
        # rows of the anchors with a column, and the column of each row
        self._rows: np.ndarray = np.empty(0, int)
        self._columns: dict[int, int] = {}
        self._t, self._p = np.zeros(room), np.zeros((room, 3))
        # delays minus compensated changes; number of independent combinations measured
        self._delays: np.ndarray = np.zeros((room, 0))
        self._freedom = np.zeros(room)
        # Cholesky factor; whitened errors; their normalised squares
        self._factor = np.zeros((room, room))
        self._white: np.ndarray = np.zeros((room, 0))
        self._squares = np.zeros(room)
        # ring buffer over the latest slices: responses of the anchors that were heard
        self._response: np.ndarray = np.zeros((WINDOW, 0, 0))
        # ring buffer: index of each column's anchor in its slice, -1 if it was not heard
        self._index: np.ndarray = np.full((WINDOW, 0), -1)
        self._known: list[Change] = []
        self._count = self._added = 0

    def add(self, piece: Slice) -> None:
        """Add a Slice."""
        if self._count == CAPACITY:
            self._forget_oldest(CAPACITY // 4)
        k, n, columns = self._count, len(piece.rows), self._ensure_columns(piece.rows)
        self._count, self._added = k + 1, self._added + 1
        self._t[k], self._p[k], self._freedom[k] = piece.t, piece.p, np.trace(piece.response)
        self._delays[k] = 0.0
        self._delays[k, columns] = piece.delays - piece.response @ self.delays_at(
            piece.t, piece.rows
        )
        turn = self._turn(k)
        self._index[turn] = -1
        self._index[turn, columns] = np.arange(n)
        self._response[turn, :n, :n] = piece.response
        self._whiten(k)

    def delays_at(self, t: float, rows: Sequence[int] | np.ndarray) -> np.ndarray:
        """Return the compensated delays of the anchors in rows (k,) at stamp t, in s: (k,) m."""
        total = np.zeros(len(rows))
        for change in self._known:
            total[np.asarray(rows) == change.row] += change.at(t)
        return total

    def _ensure_columns(self, rows: np.ndarray) -> np.ndarray:
        """Return the columns of anchors in _delays, _white and _index; add those that are missing.

        Slices that did not hear an anchor hold a delay of 0 for it, and `_seen` leaves them out.
        `_response` is enlarged if this slice has more anchors than any before.

        rows : (n,) rows of the anchors in the installation
        """
        new = [row for row in rows.tolist() if row not in self._columns]
        if new:
            self._columns |= {row: len(self._rows) + k for k, row in enumerate(new)}
            self._rows = np.concatenate([self._rows, new]).astype(int)
            self._delays, self._white = (
                np.pad(array, ((0, 0), (0, len(new)))) for array in (self._delays, self._white)
            )
            self._index = np.pad(self._index, ((0, 0), (0, len(new))), constant_values=-1)
        missing = len(rows) - self._response.shape[1]
        if missing > 0:
            self._response = np.pad(self._response, ((0, 0), (0, missing), (0, missing)))
        return np.array([self._columns[row] for row in rows.tolist()], int)

    def find(self, after: float) -> Change | None:
        """Return the Change that explains the latest slices best, or None for too few slices.

        Parameters
        ----------
        after : float
            Earliest stamp of an onset, in s.
        """
        first = self._first(after)
        if self._count - first <= YOUNGEST:
            return None
        value, ratio, scales = self._compare(first)
        step, column = np.unravel_index(np.argmax(ratio), ratio.shape)
        onset, best = first + int(step), float(ratio[step, column])
        left = np.sum(self._white[onset : self._count] ** 2) - best * scales[step]
        expected = np.sum(self._freedom[onset : self._count]) * scales[step]
        return Change(
            row=int(self._rows[column]),
            since=float(self._t[onset] - 0.5 * LENGTH),
            size=float(value[step, column]),
            ratio=best,
            rival=float(np.max(np.delete(ratio, column, axis=1), initial=0.0)),
            left=float(left / max(expected, 1e-9)),
        )

    def refined(self, change: Change) -> Change | None:
        """Return the last compensated step with its new size, or None, and compensate that."""
        first = self._first(change.since)
        if self._t[first] - change.since > LENGTH or self._count - first <= YOUNGEST:
            return None
        more = float(self._compare(first)[0][0, self._columns[change.row]])
        better = replace(change, size=change.size + more)
        self._known.remove(change)
        self._known.append(better)
        self._subtract(replace(change, size=more))
        return better

    def compensate(self, change: Change) -> None:
        """Subtract a Change; a further change of the same anchor is then found as a new Change."""
        self._known.append(change)
        self._subtract(change)

    def _subtract(self, change: Change) -> None:
        # Subtract a Change from the stored slices since its onset and whiten them again.
        column = self._columns[change.row]
        for k in range(
            self._first(change.since), self._count
        ):  # the window holds all slices since any onset that `find` returns
            place, response = self._index[self._turn(k)], self._response[self._turn(k)]
            if place[column] >= 0:
                heard = np.flatnonzero(place >= 0)
                self._delays[k, heard] -= response[place[heard], place[column]] * change.at(
                    self._t[k]
                )
            self._whiten(k)

    def _turn(self, k: int | np.ndarray) -> int | np.ndarray:
        """Return the place of slice k in the ring buffer; k may be an array."""
        return (self._added - self._count + k) % WINDOW

    def _first(self, after: float) -> int:
        """Return the first slice of the window that is later than `after`, in s."""
        return max(0, self._count - WINDOW, int(np.searchsorted(self._t[: self._count], after)))

    def _compare(self, first: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compare steps that begin with each slice from `first`, except the youngest.

        Returns
        -------
        value : (k, N) array
            Most likely steps, in m.
        ratio : (k, N) array
            Likelihood ratios.
        scale : (k,) array
            Mean square of the errors before each onset.
        """
        n, turns = self._count - first, self._turn(np.arange(first, self._count))
        some = np.flatnonzero((self._index[turns] >= 0).any(axis=0))  # anchors that were heard
        white = self._white[first : self._count, some]
        inverse = np.linalg.inv(self._factor[first : self._count, first : self._count])
        # contiguous, or numba compiles a second version in flight
        of_slices = (np.ascontiguousarray(self._index[turns][:, some]), self._response[turns])
        scores, information = _seen(*of_slices, inverse.T @ white, inverse.T @ inverse)
        # slices (columns) since each onset (rows)
        shapes = (np.arange(n) >= np.arange(n - YOUNGEST)[:, None]).astype(float)
        score = shapes @ scores
        power = np.sum(np.tensordot(shapes, information, axes=1) * shapes[:, :, None], axis=1)
        value = np.zeros((len(shapes), self._white.shape[1]))
        value[:, some] = score / (power + 1e-9)
        squares = np.minimum(self._squares[: self._count], LARGEST_ERROR)
        before = first + np.arange(n - YOUNGEST)  # slices before each onset
        scale = SCALE_SLICES * SCALE + np.concatenate([[0.0], np.cumsum(squares)])[before]
        scale = np.maximum(scale / (SCALE_SLICES + before), SMALLEST_SCALE)
        ratio = np.zeros_like(value)
        ratio[:, some] = score * value[:, some] / scale[:, None]
        return value, ratio, scale

    def _whiten(self, k: int) -> None:
        """Compute row k of the Cholesky factor and its whitened error."""
        _whiten(
            k,
            self._t,
            self._p,
            self._delays,
            self._freedom,
            (self._factor, self._white, self._squares),
        )

    def _forget_oldest(self, n: int) -> None:
        # Drop the n oldest slices, and columns of anchors that no stored slice contains.
        for array in (self._t, self._p, self._delays, self._freedom):
            array[: CAPACITY - n] = array[n:].copy()
        self._count = CAPACITY - n
        known = np.isin(self._rows, [change.row for change in self._known])
        kept = np.flatnonzero(
            (self._delays[: self._count] != 0.0).any(axis=0)
            | (self._index >= 0).any(axis=0)
            | known
        )
        self._rows = self._rows[kept]
        self._columns = {row: k for k, row in enumerate(self._rows.tolist())}
        self._delays, self._white, self._index = (
            array[:, kept] for array in (self._delays, self._white, self._index)
        )
        for k in range(self._count):
            self._whiten(k)


@compiled
def _whiten(
    k: int,
    t: np.ndarray,
    p: np.ndarray,
    delays: np.ndarray,
    freedom: np.ndarray,
    whitened: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Write row k of the Cholesky factor and its whitened error and normalised square.

    Parameters
    ----------
    k : int
        Row.
    t : (m,) array
        Stamps of the slices, in s.
    p : (m, 3) array
        Positions of the tag, in m.
    delays : (m, N) array
        Delays of the anchors, in m.
    freedom : (m,) array
        Number of independent combinations measured in each slice.
    whitened : tuple of arrays
        Cholesky factor (m, m), whitened errors (m, N), normalised squares (m,).
    """
    factor, white, squares = whitened[0], whitened[1], whitened[2]
    row, error = factor[k], delays[k].copy()
    variance = DELAY_STD**2 + GRADUAL_STD**2 + LOCAL_STD**2 + NOISE_STD**2
    for i in range(k):
        apart = (p[i, 0] - p[k, 0]) ** 2 + (p[i, 1] - p[k, 1]) ** 2 + (p[i, 2] - p[k, 2]) ** 2
        local = math.exp(-0.5 * apart / LOCAL_LENGTH**2 - abs(t[k] - t[i]) / LOCAL_TIME)
        kernel = (
            DELAY_STD**2
            + GRADUAL_STD**2 * math.exp(-0.5 * apart / GRADUAL_LENGTH**2)
            + LOCAL_STD**2 * local
        )
        for j in range(i):
            kernel -= factor[i, j] * row[j]
        row[i] = kernel / factor[i, i]
        error -= row[i] * white[i]
        variance -= row[i] ** 2
    squares[k] = np.sum(error**2) / (variance * max(freedom[k], 1e-3))
    row[k] = math.sqrt(variance * max(1.0, squares[k] / OUTLIER))
    white[k] = error / row[k]


@compiled
def _seen(
    place: np.ndarray, response: np.ndarray, errors: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the response of whitened errors to a delay of each anchor, and its information.

    Parameters
    ----------
    place : (n, M) int array
        Place of each anchor in the response of each slice, or -1.
    response : (n, H, H) array
        Response of the estimate in each slice to the delays.
    errors : (n, M) array
        Weighted whitened errors.
    weights : (n, n) array
        Weights of pairs of slices.

    Returns
    -------
    scores : (n, M) array
        Correlation of the errors with a delay of each anchor.
    information : (n, n, M) array
        Information of each pair of slices on that delay.
    """
    n, anchors = errors.shape
    scores, information = np.zeros((n, anchors)), np.zeros((n, n, anchors))
    for s in range(n):
        heard = np.flatnonzero(place[s] >= 0)
        own = place[s][heard]
        for row, i in zip(own, heard):
            for column, k in zip(own, heard):
                scores[s, k] += response[s, row, column] * errors[s, i]
        for t in range(s + 1):
            both = heard[place[t][heard] >= 0]
            own, other = place[s][both], place[t][both]
            for i in range(len(both)):
                one, two = response[s, own[i]], response[t, other[i]]
                for k in range(len(both)):
                    information[s, t, both[k]] += one[own[k]] * two[other[k]]
            information[s, t] *= weights[s, t]
            information[t, s] = information[s, t]
    return scores, information


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
