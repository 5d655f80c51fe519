# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Test sequentially over Slices whether one anchor has changed.

The delays of the anchors depend on the place, because of antennas, reflections and survey errors. A
Gaussian process over the place (kernel below) learns the delays in flight. Its whitened one-step
prediction errors contain the new information.

The test considers each anchor and each onset within the last seconds. It is a generalized
likelihood ratio (Willsky and Jones, IEEE Trans. Automatic Control 21, 1976). It compares a delay
that begins at the onset with no delay. A delay that grows becomes several such steps. The response
to the delay is whitened like the errors. The ratio is divided by the mean square of the errors
before the onset. A flight with larger errors than the kernel expects therefore needs a larger
change.

Memory and time grow with the anchors that are heard, not with those that are installed. An anchor
has a column while any stored slice contains it. Responses are stored only for anchors heard in a
slice, and only for slices that may hold an onset.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
import math

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled

from .anchor_watch import DELAY_STD, LENGTH, Slice

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
