"""Rows that wait to be used, in the order of their stamps."""

import numpy as np

from uwb_tdoa_bias.foundation.compiled import compiled
from uwb_tdoa_bias.foundation.stamps import LARGEST_STEP_AHEAD

ROOM = 256  # rows, to begin with


class Waiting:
    """Rows of one structured type with a field t. They come a few at a time, nearly always in order: then they are appended."""

    def __init__(self, kind):
        self._room, self._first, self._end = np.empty(ROOM, kind), 0, 0

    def __len__(self):
        return self._end - self._first

    @property
    def rows(self):
        """(n,) of them, which the next call may change."""
        return self._room[self._first : self._end]

    def append(self, rows, newest, after):
        """Append rows (k,), k > 0, if their stamps rise, are not before `after`, s, but after `newest`, s, the newest stamp of the
        stream, and plausible for it (see StampGate). Returns the newest stamp now, s; NaN if they were not appended."""
        self._make_room(len(rows))
        newest = _append(self._room, self._first, self._end, rows, newest, after)
        if newest == newest:
            self._end += len(rows)
        return newest

    def merge(self, rows):
        """Put rows among the others: by stamp, and by everything else where stamps are equal, not by when they came."""
        both = np.concatenate([self.rows, rows])
        columns = [column for name in both.dtype.names for column in both[name].reshape(len(both), -1).T]
        self._first = self._end = 0
        self._make_room(len(both))
        self._room[: len(both)], self._end = both[np.lexsort(columns[::-1])], len(both)

    def take(self, until):
        """Remove and return the rows stamped up to `until`, s."""
        n = _count(self._room, self._first, self._end, until)
        taken = self._room[self._first : self._first + n].copy()
        self._first += n
        return taken

    def _make_room(self, n):
        if self._end + n > len(self._room):
            kept = self.rows
            room = np.empty(max(ROOM, 2 * (len(kept) + n)), self._room.dtype)
            room[: len(kept)] = kept
            self._room, self._first, self._end = room, 0, len(kept)


@compiled
def _append(room, first, end, rows, newest, after):
    last = max(newest, room[end - 1].t) if end > first else newest
    if newest == -np.inf:
        newest = rows[0].t
    for k in range(len(rows)):
        t = rows[k].t
        if not last < t <= newest + LARGEST_STEP_AHEAD or t < after:
            return np.nan
        newest = last = t
    for k in range(len(rows)):
        room[end + k] = rows[k]
    return newest


@compiled
def _count(room, first, end, until):
    n = 0
    while first + n < end and room[first + n].t <= until:
        n += 1
    return n
