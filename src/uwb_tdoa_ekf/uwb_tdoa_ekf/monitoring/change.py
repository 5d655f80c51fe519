"""Has one anchor changed? A sequential test over Slices.

The delays of the anchors depend on the place: antennas, reflections, a survey that is off. A
Gaussian process of the place (kernel below) learns them while flying; its whitened one-step errors
are what is new. For every anchor and every onset within the last seconds a generalised likelihood
ratio (Willsky and Jones, IEEE Trans. Automatic Control 21, 1976) compares a delay that began then,
as a step or as a ramp, with none: what a delay would make of the same errors, whitened likewise,
against them. The ratio is counted in units of the mean square of the errors before the onset, so
that a flight with worse errors than the kernel expects needs a larger change.

Memory and time go with the anchors that are heard, not with those that are installed: an anchor has
a column from the first slice in which it is heard to the last one that is remembered. What a delay
does to a slice is kept for the anchors that were heard in it, and for the slices in which an onset
is looked for.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
from typing import TYPE_CHECKING

import numpy as np

from uwb_tdoa_bias.common.compiled import compiled

from .slices import LENGTH

if TYPE_CHECKING:
    from collections.abc import Sequence

    from .slices import Slice

MEAN_STD = 0.15  # m, of a delay that is the same everywhere,
PLACE_STD, PLACE_LENGTH = 0.2, 0.9  # m, of one that depends on the place, and how far it is alike,
# m, m, s, of one that lasts while the tag stays,
LOCAL_STD, LOCAL_LENGTH, LOCAL_TIME = (0.05, 0.3, 2.0)
NOISE_STD = 0.1  # m, and of what is new in every slice
# normalised square of a slice's error, above which its variance is raised until it is this
OUTLIER = 3.0
# normalised square that a slice counts as at most when the scale of the flight is learned
LARGEST_ERROR = 8.0
SMALLEST_SCALE = 1.0  # mean normalised square below which no flight counts as better
# mean normalised square before there are any slices, and how many slices that is worth
SCALE, SCALE_SLICES = (2.0, 20)
WINDOW, YOUNGEST = 24, 4  # slices in which an onset is looked for, and that it must have lasted
FASTEST_DRIFT, CLEARLY = 0.1, 1.5  # m/s, of a clock; how much better than all steps a ramp must be
CAPACITY = 240  # slices that are remembered


@dataclass(frozen=True)
class Change:
    """row : of the anchor; since : s, stamp of the onset; size : m, at the onset; slope : m/s;
    ratio : the test; rival : the same of the best change of any other anchor; left : mean square of
    the errors since then that it does not explain, over that of those before.
    """

    row: int
    since: float
    size: float
    slope: float
    ratio: float
    rival: float
    left: float

    def at(self, t: float) -> np.ndarray:
        """The delay, m, at stamps t, s."""
        return np.where(t > self.since, self.size + self.slope * (t - self.since), 0.0)


class ChangeDetector:
    """Takes Slices in the order of their stamps; `find` tests them; what it found is subtracted by
    `compensate`.
    """

    def __init__(self) -> None:
        room = CAPACITY
        # of the anchors with a column, and the column of each row
        self._rows: np.ndarray = np.empty(0, int)
        self._columns: dict[int, int] = {}
        self._t, self._p = np.zeros(room), np.zeros((room, 3))
        self._delays: np.ndarray
        self._white: np.ndarray
        # without what was taken out; combinations measured
        self._delays, self._freedom = (np.zeros((room, 0)), np.zeros(room))
        # Cholesky factor; whitened errors
        self._factor, self._white = (np.zeros((room, room)), np.zeros((room, 0)))
        self._squares = np.zeros(room)  # normalised squares
        # of the latest slices, in turn, for the anchors that were heard,
        self._response: np.ndarray = np.zeros((WINDOW, 0, 0))
        # and where the anchor of a column is among them
        self._place: np.ndarray = np.full((WINDOW, 0), -1)
        self._known: list[Change] = []
        self._count = self._added = 0

    def add(self, piece: Slice) -> None:
        """Take a Slice."""
        if self._count == CAPACITY:
            self._forget_oldest(CAPACITY // 4)
        k, n, columns = self._count, len(piece.rows), self._columns_of(piece.rows)
        self._count, self._added = k + 1, self._added + 1
        self._t[k], self._p[k], self._freedom[k] = piece.t, piece.p, np.trace(piece.response)
        self._delays[k] = 0.0
        self._delays[k, columns] = piece.delays - piece.response @ self.delays_at(
            piece.t, piece.rows
        )
        turn = self._turn(k)
        self._place[turn] = -1
        self._place[turn, columns] = np.arange(n)
        self._response[turn, :n, :n] = piece.response
        self._whiten(k)

    def delays_at(self, t: float, rows: Sequence[int] | np.ndarray) -> np.ndarray:
        """(k,) m: what was taken out of the anchors in rows (k,), at stamp t, s."""
        total = np.zeros(len(rows))
        for change in self._known:
            total[np.asarray(rows) == change.row] += change.at(t)
        return total

    def _columns_of(self, rows: np.ndarray) -> np.ndarray:
        """(k,) columns of anchors, by their rows (k,), with new ones for those that have none; room
        for so many in a slice.
        """
        new = [row for row in rows.tolist() if row not in self._columns]
        if new:
            self._columns |= {row: len(self._rows) + k for k, row in enumerate(new)}
            self._rows = np.concatenate([self._rows, new]).astype(int)
            self._delays, self._white = (
                np.pad(array, ((0, 0), (0, len(new)))) for array in (self._delays, self._white)
            )
            self._place = np.pad(self._place, ((0, 0), (0, len(new))), constant_values=-1)
        if (more := len(rows) - self._response.shape[1]) > 0:
            self._response = np.pad(self._response, ((0, 0), (0, more), (0, more)))
        return np.array([self._columns[row] for row in rows.tolist()], int)

    def find(self, after: float) -> Change | None:
        """The Change that explains the latest slices best, of onsets later than `after`, s; None
        without enough of them.
        """
        first = self._first(after)
        onsets = self._count - first - YOUNGEST
        if onsets <= 0:
            return None
        value, ratio, scales = self._compare(first)
        ratio[onsets:][np.abs(value[onsets:]) > FASTEST_DRIFT] = 0.0
        ratio[onsets:] /= CLEARLY
        shape, column = np.unravel_index(np.argmax(ratio), ratio.shape)
        best, scale, later = (
            float(ratio[shape, column]),
            scales[shape],
            slice(first + shape % onsets, self._count),
        )
        explained = best * scale * (CLEARLY if shape >= onsets else 1.0)
        left = (np.sum(self._white[later] ** 2) - explained) / max(
            np.sum(self._freedom[later]) * scale, 1e-9
        )
        rival = float(np.max(np.delete(ratio, column, axis=1), initial=0.0))
        since, change = self._t[first + shape % onsets] - 0.5 * LENGTH, float(value[shape, column])
        size, slope = (change, 0.0) if shape < onsets else (0.0, change)
        return Change(int(self._rows[column]), float(since), size, slope, best, rival, float(left))

    def refined(self, change: Change) -> Change | None:
        """The step that was taken out last, with the size that it has by now, or None; takes that
        out instead.
        """
        first = self._first(change.since)
        if (
            change.slope
            or self._t[first] - change.since > LENGTH
            or self._count - first <= YOUNGEST
        ):
            return None
        more = float(self._compare(first)[0][0, self._columns[change.row]])
        better = replace(change, size=change.size + more)
        self._known.remove(change)
        self._known.append(better)
        self._subtract(replace(change, size=more))
        return better

    def compensate(self, change: Change) -> None:
        """Go on as if an anchor had not changed; what it does beyond that is a Change again."""
        self._known.append(change)
        self._subtract(change)

    def _subtract(self, change: Change) -> None:
        column = self._columns[change.row]
        for k in range(
            self._first(change.since), self._count
        ):  # later than any onset that is found
            place, response = self._place[self._turn(k)], self._response[self._turn(k)]
            if place[column] >= 0:
                heard = np.flatnonzero(place >= 0)
                self._delays[k, heard] -= response[place[heard], place[column]] * change.at(
                    self._t[k]
                )
            self._whiten(k)

    def _turn(self, k: int | np.ndarray) -> int | np.ndarray:
        """Where the response of slice k is, one of the latest; or of several."""
        return (self._added - self._count + k) % WINDOW

    def _first(self, after: float) -> int:
        """Place of the first slice of the window that is later than `after`, s."""
        return max(0, self._count - WINDOW, int(np.searchsorted(self._t[: self._count], after)))

    def _compare(self, first: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Steps (m), then ramps (m/s), that began with each slice from `first` on but the youngest:
        their most likely values and their ratios, (2 k, N), and the mean square of the errors
        before each, (2 k,).
        """
        n, turns = self._count - first, self._turn(np.arange(first, self._count))
        some = np.flatnonzero((self._place[turns] >= 0).any(axis=0))  # anchors that were heard
        inverse, white = _inverse(self._factor, first, n), self._white[first : self._count, some]
        # or it is compiled anew in flight
        of_slices = (np.ascontiguousarray(self._place[turns][:, some]), self._response[turns])
        scores, information = _seen(*of_slices, inverse.T @ white, inverse.T @ inverse)
        # of slices (columns) since each onset (rows)
        age = np.arange(n) - np.arange(n - YOUNGEST)[:, None]
        shapes = np.concatenate([(age >= 0).astype(float), LENGTH * np.maximum(age + 0.5, 0.0)])
        score = shapes @ scores
        power = np.sum(np.tensordot(shapes, information, axes=1) * shapes[:, :, None], axis=1)
        value = np.zeros((len(shapes), self._white.shape[1]))
        value[:, some] = score / (power + 1e-9)
        squares = np.minimum(self._squares[: self._count], LARGEST_ERROR)
        before = first + np.tile(np.arange(n - YOUNGEST), 2)  # slices before each onset
        scale = SCALE_SLICES * SCALE + np.concatenate([[0.0], np.cumsum(squares)])[before]
        scale = np.maximum(scale / (SCALE_SLICES + before), SMALLEST_SCALE)
        ratio = np.zeros_like(value)
        ratio[:, some] = score * value[:, some] / scale[:, None]
        return value, ratio, scale

    def _whiten(self, k: int) -> None:
        """Row k of the factor, and its whitened error."""
        _whiten(
            k,
            self._t,
            self._p,
            self._delays,
            self._freedom,
            (self._factor, self._white, self._squares),
        )

    def _forget_oldest(self, n: int) -> None:
        for array in (self._t, self._p, self._delays, self._freedom):
            array[: CAPACITY - n] = array[n:].copy()
        self._count = CAPACITY - n
        known = np.isin(self._rows, [change.row for change in self._known])
        kept = np.flatnonzero(
            (self._delays[: self._count] != 0.0).any(axis=0)
            | (self._place >= 0).any(axis=0)
            | known
        )
        self._rows = self._rows[kept]
        self._columns = {row: k for k, row in enumerate(self._rows.tolist())}
        self._delays, self._white, self._place = (
            array[:, kept] for array in (self._delays, self._white, self._place)
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
    """Row k of the Cholesky factor (m, m), of the whitened errors (m, N), and of their normalised
    squares (m,).
    """
    factor, white, squares = whitened[0], whitened[1], whitened[2]
    row, error = factor[k], delays[k].copy()
    variance = MEAN_STD**2 + PLACE_STD**2 + LOCAL_STD**2 + NOISE_STD**2
    for i in range(k):
        apart = (p[i, 0] - p[k, 0]) ** 2 + (p[i, 1] - p[k, 1]) ** 2 + (p[i, 2] - p[k, 2]) ** 2
        local = math.exp(-0.5 * apart / LOCAL_LENGTH**2 - abs(t[k] - t[i]) / LOCAL_TIME)
        kernel = (
            MEAN_STD**2
            + PLACE_STD**2 * math.exp(-0.5 * apart / PLACE_LENGTH**2)
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
def _inverse(factor: np.ndarray, first: int, n: int) -> np.ndarray:
    """(n, n): inverse of the part of a lower triangular matrix that begins with row and column
    `first`.
    """
    out = np.zeros((n, n))
    for i in range(n):
        out[i, i] = 1.0
        for j in range(i):
            out[i] -= factor[first + i, first + j] * out[j]
        out[i] /= factor[first + i, first + i]
    return out


@compiled
def _seen(
    place: np.ndarray, response: np.ndarray, errors: np.ndarray, weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Of n slices what a delay of each anchor makes of whitened errors (n, M) that are there, (n,
    M), and how much of it any two of them would see, weighted (n, n): (n, n, M). place : (n, M), of
    an anchor in the response (H, H) of each slice, or -1.
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
