"""Whether the messages of a stream come in the order of their stamps: then nothing waits for older ones."""

import math

TRIAL = 2.0  # s of stamps in order, after which a stream is trusted to go on so


class Order:
    """Of one stream. It is judged by the order of its messages alone, which is their sender's, never by when they arrive.

    The first message that breaks the order of a trusted stream counts as late, even if nothing newer has been used yet. From
    then on the stream is not trusted any more. If no stamp has come twice, none is waited for a second time: then the first that
    does counts as late, and from then on they are waited for.
    """

    def __init__(self):
        self._first, self._sorted, self._rising, self._closed = math.nan, True, True, -math.inf

    def trusted(self, newest):
        """Whether nothing older than `newest`, s, the newest stamp so far, is to be expected."""
        return self._sorted and newest - self._first >= TRIAL

    def passed(self, newest, reorder):
        """Stamp, s, up to which nothing is to be expected any more; newest : s, so far; reorder : s by which messages of a stream
        that is not trusted may be out of order."""
        if not self.trusted(newest):
            return math.nextafter(newest - reorder, -math.inf)
        return newest if self._rising else math.nextafter(newest, -math.inf)

    def begin(self, t):
        """A message stamped t, s, has come in order."""
        if self._first != self._first:
            self._first = t

    def is_late(self, t, newest):
        """Whether a message stamped t, s, comes too late to be used; newest : s, before it, -inf for the first."""
        self.begin(t)
        if t > newest:
            return False
        if self.trusted(newest):
            self._closed = max(self._closed, self.passed(newest, 0.0))
        self._sorted, self._rising = self._sorted and t == newest, False
        return t <= self._closed
