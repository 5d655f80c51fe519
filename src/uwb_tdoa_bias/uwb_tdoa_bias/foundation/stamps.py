"""Whether a stamp is plausible: one far from its neighbours is an outlier, two in a row that agree are another time."""

from __future__ import annotations

import math
from typing import Any, TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Sequence

LARGEST_STEP_BACK, LARGEST_STEP_AHEAD = 1.0, 10.0  # s from the newest stamp of a stream, within which one is plausible


class StampGate:
    """Lets through the items of one stream. One whose stamp is not plausible is held until the next one of the stream
    tells whether it is an outlier or the beginning of another time."""

    def __init__(self) -> None:
        self.newest = -math.inf  # s, of the stamps accepted
        self._held: list[tuple[float, Any]] = []

    def __len__(self) -> int:
        """Items held: 0 or 1."""
        return len(self._held)

    def take(self, t: float, item: Any) -> tuple[list[tuple[float, Any]], list[tuple[float, Any]], bool]:
        """Take an item stamped t, s. Returns (accepted, outliers, jumped_back): lists of (t, item), and whether the
        accepted ones are the first of an earlier time: the stream has started anew."""
        if not self._held and (self._is_plausible(t) or self.newest == -math.inf):
            self.newest = max(self.newest, t)
            return [(t, item)], [], False
        held, self._held = self._held, []
        if held and -LARGEST_STEP_BACK <= t - held[0][0] <= LARGEST_STEP_AHEAD:
            jumped_back = t < self.newest
            self.newest = max(t, held[0][0])
            return [*held, (t, item)], [], jumped_back
        if self._is_plausible(t):
            self.newest = max(self.newest, t)
            return [(t, item)], held, False
        self._held = [(t, item)]
        return [], held, False

    def take_all(self, stamps: Sequence[float]) -> bool:
        """Whether items stamped so, a list of s in the order of their arrival, are all plausible; then they are accepted."""
        newest = self.newest if self.newest > -math.inf else stamps[0]
        for t in stamps:
            if not newest - LARGEST_STEP_BACK <= t <= newest + LARGEST_STEP_AHEAD:
                return False
            newest = max(newest, t)
        if not self._held:
            self.newest = newest
        return not self._held

    def pass_time(self, t: float) -> None:
        """Note the time t, s, of an item that is good for nothing else."""
        if self._is_plausible(t):
            self.newest = max(self.newest, t)

    def finish(self) -> list[tuple[float, Any]]:
        """What is held when nothing follows, a list of (t, item): outliers."""
        held, self._held = self._held, []
        return held

    def _is_plausible(self, t: float) -> bool:
        return self.newest - LARGEST_STEP_BACK <= t <= self.newest + LARGEST_STEP_AHEAD
