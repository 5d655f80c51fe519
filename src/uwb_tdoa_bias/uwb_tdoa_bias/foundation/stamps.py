"""Whether a stamp can be believed: one far from its neighbours is wrong, two in a row that agree are another time."""

import math

BACK, AHEAD = 1.0, 10.0  # s from the newest stamp of a stream, within which a stamp is believed at once


class StampWatch:
    """Watches one stream of items. A doubtful one is held until the next one of the stream has been seen."""

    def __init__(self):
        self.newest = -math.inf  # s, of the stamps believed
        self._held = []

    def __len__(self):
        """Items held: 0 or 1."""
        return len(self._held)

    def take(self, t, item):
        """Take an item stamped t, s. Returns (believed, strays, fell_back): lists of (t, item), and whether the believed
        ones are the first of an earlier time: the stream has started anew."""
        if not self._held and (self._near(t) or self.newest == -math.inf):
            self.newest = max(self.newest, t)
            return [(t, item)], [], False
        strays, self._held = self._held, []
        if strays and -BACK <= t - strays[0][0] <= AHEAD:
            fell_back = t < self.newest
            self.newest = max(t, strays[0][0])
            return [*strays, (t, item)], [], fell_back
        if self._near(t):
            self.newest = max(self.newest, t)
            return [(t, item)], strays, False
        self._held = [(t, item)]
        return [], strays, False

    def see(self, t):
        """Note the time t, s, of an item that is good for nothing else."""
        if self._near(t):
            self.newest = max(self.newest, t)

    def _near(self, t):
        return self.newest - BACK <= t <= self.newest + AHEAD

    def finish(self):
        """What is held when nothing follows, a list of (t, item): strays."""
        strays, self._held = self._held, []
        return strays
