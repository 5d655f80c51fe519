"""The poses of the last seconds."""

import numpy as np


class Poses:
    """Poses in the order of their stamps, of which at least the last `history` are kept."""

    def __init__(self, history):
        self._history, self._count = history, 0
        self._t, self._p, self._q = (np.empty((2 * history, *shape)) for shape in ((), (3,), (4,)))

    @property
    def t(self):
        """Stamps, (m,) s."""
        return self._t[: self._count]

    @property
    def p(self):
        """Positions, (m, 3) m."""
        return self._p[: self._count]

    @property
    def q(self):
        """Attitudes, (m, 4) x y z w, body to world."""
        return self._q[: self._count]

    @property
    def newest(self):
        """Stamp of the last pose, s; -inf if there is none."""
        return self._t[self._count - 1] if self._count else -np.inf

    def add(self, t, p, q):
        """Append one pose, or several: t (k,), p (k, 3), q (k, 4). Those not later than all before them are ignored."""
        t, p, q = np.reshape(t, -1), np.reshape(p, (-1, 3)), np.reshape(q, (-1, 4))
        rising = t > np.maximum.accumulate(np.concatenate([[self.newest], t]))[:-1]
        if not rising.all():
            t, p, q = t[rising], p[rising], q[rising]
        for first in range(0, len(t), self._history):
            self._append(*(part[first : first + self._history] for part in (t, p, q)))

    def at(self, places):
        """(p (n, 3), q (n, 4)) of the poses with these numbers (n,); NaN for -1."""
        known = places >= 0
        if known.all():
            return self._p[places], self._q[places]
        p, q = np.full((len(places), 3), np.nan), np.full((len(places), 4), np.nan)
        p[known], q[known] = self._p[places[known]], self._q[places[known]]
        return p, q

    def _append(self, *new):
        end = self._count + len(new[0])
        if end > 2 * self._history:  # make room
            kept = self._count - self._history
            for column in (self._t, self._p, self._q):
                column[: self._history] = column[kept : self._count].copy()
            self._count, end = self._history, self._history + len(new[0])
        for column, values in zip((self._t, self._p, self._q), new):
            column[self._count : end] = values
        self._count = end
