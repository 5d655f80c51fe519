"""Measurements that wait for the pose at which they will be corrected."""

from collections import deque


class Hold:
    """A queue in order of arrival. Its first item leaves when it is ready, or when it has been waited for too long.

    Too long is counted in stamps: a newer item is stamped more than `limit` seconds later.
    """

    def __init__(self, limit):
        """limit : s."""
        self.limit = limit
        self._items = deque()
        self._newest = -float("inf")

    def __len__(self):
        return len(self._items)

    def add(self, t, item):
        """Append an item stamped t, s."""
        self._items.append((t, item))
        self._newest = max(self._newest, t)

    def take(self, ready):
        """Remove and return what may leave: a list of (t, item, True if ready(t) else False)."""
        out = []
        while self._items:
            t, item = self._items[0]
            is_ready = ready(t)
            if not is_ready and self._newest - t <= self.limit:
                break
            out.append((t, item, is_ready))
            self._items.popleft()
        return out
