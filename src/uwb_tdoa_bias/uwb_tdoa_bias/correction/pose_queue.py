"""Measurements that wait for the pose at which they will be corrected."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Callable


MOST = 10_000  # items: what has one stamp for ever would never have waited too long


class PoseQueue:
    """A queue in order of arrival. Its first item leaves when it is ready, or when it has been
    waited for too long.

    What makes an item ready depends on the stamp of the item before it. Too long is counted in
    stamps: a newer item is stamped more than `limit` seconds later, or MOST wait.
    """

    def __init__(self, limit: float) -> None:
        """limit : s."""
        self.limit = limit
        self._items: deque[tuple[float, float, Any]] = deque()
        self._newest: float = None  # type: ignore[assignment]  # latest stamp so far, s, once there is one

    def __len__(self) -> int:
        return len(self._items)

    def add(self, t: float, item: Any) -> None:
        """Append an item stamped t, s."""
        newest = t if self._newest is None else self._newest
        self._items.append((t, min(t, newest), item))
        self._newest = max(newest, t)

    def take(self, ready: Callable[[float], bool]) -> list[tuple[float, Any, bool]]:
        """Remove and return what may leave: a list of (t, item, ready(before)), `before` being the
        latest stamp added before the item, at most t; t for the first.
        """
        out = []
        while self._items:
            t, before, item = self._items[0]
            is_ready = ready(before)
            if not is_ready and self._newest - t <= self.limit and len(self._items) <= MOST:
                break
            out.append((t, item, is_ready))
            self._items.popleft()
        return out
