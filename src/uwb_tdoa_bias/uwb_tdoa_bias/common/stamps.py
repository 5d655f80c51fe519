# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Hold items of one stream by their stamps: implausible ones, and those that wait for a pose."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
import math
from typing import Any

from .compiled import compiled

# s behind the newest stamp of a stream. With one clock, messages are out of order by less.
LARGEST_STEP_BACK = 1.0
# s ahead of the newest stamp: the step that any stream, and a slow stream, may make at once.
STEP_AHEAD, LARGEST_STEP_AHEAD = (0.25, 2.0)
# Multiple of the usual step that a stream may make at once. One lost message makes two steps, three
# lost messages make four.
USUAL = 4.0
FORGETTING = 0.1  # weight of the latest step in the usual step
NEAR = 0.25  # s between stamps of two streams that confirm each other
# s. A jump that no other stream confirms must persist so long: where another stream continues in
# the old time, and where none does.
CONTRADICTED, UNCONTRADICTED = 0.3, 0.05
MOST_HELD = 1000  # held messages of a stream with a stopped clock
MOST_WAITING = 10_000  # items; limits a queue whose stamps stand still


class StampGate:
    """Let through the items of one stream whose stamps are plausible.

    An item with an implausible stamp is held. If the next stamp is plausible, the held item is an
    outlier. If the following stamps agree with the held one, the clock has jumped, and the items are
    accepted. They agree at once if another stream has reached the same time. Otherwise the jump must
    persist for CONTRADICTED or UNCONTRADICTED seconds. A gap in a stream is treated like a jump ahead.
    """

    def __init__(self) -> None:
        self.newest = -math.inf  # s, newest accepted stamp
        self.usual = LARGEST_STEP_AHEAD / USUAL  # s, mean step between stamps
        self._held: list[tuple[float, Any]] = []

    def __len__(self) -> int:
        """Return the number of held items."""
        return len(self._held)

    @property
    def held(self) -> float:
        """Stamp of the last held item, s; NaN for fewer than two held items."""
        return self._held[-1][0] if len(self._held) > 1 else math.nan

    @property
    def limit(self) -> float:
        """Latest plausible stamp of the next item, s."""
        return self.newest + allowed_step(self.usual)

    def take(
        self, t: float, item: Any, reached: Iterable[float] = ()
    ) -> tuple[list[tuple[float, Any]], list[tuple[float, Any]], bool]:
        """Take one item, and return the items that this decides.

        Parameters
        ----------
        t : stamp, s
        item : any object
        reached : stamps that other streams have reached, s

        Returns
        -------
        accepted, outliers : lists of (t, item)
        jumped_back : whether the accepted items are the first of an earlier time
        """
        if self.newest == -math.inf or self._is_plausible(t):
            outliers, self._held = self._held, []
            self._go_on(t)
            return [(t, item)], outliers, False
        outliers = []
        if self._held and not abs(t - self._held[-1][0]) <= LARGEST_STEP_BACK:
            outliers, self._held = self._held, []
        self._held.append((t, item))
        if len(self._held) > MOST_HELD:
            outliers.append(self._held.pop(0))
        if not self._is_confirmed(reached):
            return [], outliers, False
        accepted, self._held = self._held, []
        jumped_back = accepted[0][0] < self.newest
        self.newest = -math.inf
        for stamp, _ in accepted:
            self._go_on(stamp)
        return accepted, outliers, jumped_back

    def take_all(self, stamps: Sequence[float]) -> bool:
        """Accept items if all their stamps are plausible, and return whether they are.

        stamps : s, in order of arrival
        """
        if self._held:
            return False
        newest, usual = self.newest, self.usual
        for t in stamps:
            if not (self.newest == -math.inf or self._is_plausible(t)):
                self.newest, self.usual = newest, usual
                return False
            self._go_on(t)
        return True

    def pass_time(self, t: float, reached: Iterable[float] = ()) -> None:
        """Note the time t, s, of an item that is not used otherwise; `reached` as in `take`."""
        if (
            self._is_plausible(t)
            or t > self.newest
            and any(abs(t - other) <= NEAR for other in reached)
        ):
            self._go_on(t)

    def finish(self) -> list[tuple[float, Any]]:
        """Return the held items when the stream ends, a list of (t, item); they are outliers."""
        held, self._held = self._held, []
        return held

    def _is_plausible(self, t: float) -> bool:
        return self.newest - LARGEST_STEP_BACK <= t <= self.limit

    def _go_on(self, t: float) -> None:
        if self.newest > -math.inf:
            self.usual = usual_step(self.usual, t - self.newest)
        self.newest = max(self.newest, t)

    def _is_confirmed(self, reached: Iterable[float]) -> bool:
        first, last = self._held[0][0], self._held[-1][0]
        if (last > self.newest or len(self._held) > 1) and any(
            abs(last - t) <= NEAR for t in reached
        ):
            return True
        contradicted = any(self.newest < t < self.newest + LARGEST_STEP_BACK for t in reached)
        return last - first >= (CONTRADICTED if contradicted else UNCONTRADICTED)


class PoseQueue:
    """A queue in order of arrival, as of TDOAs that wait for a pose.

    Its first item leaves when it is ready, or has waited too long. Whether an item is ready depends on
    the stamp of the item before it. An item has waited too long if a newer item is stamped more than
    `limit` s later. The same holds if more than MOST_WAITING items wait.
    """

    def __init__(self, limit: float) -> None:
        """Set the limit of the wait, s."""
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

    def shorten(self, most: int) -> int:
        """Remove the oldest of more than `most` items, and return their number."""
        removed = max(len(self._items) - most, 0)
        for _ in range(removed):
            self._items.popleft()
        return removed

    def take(self, ready: Callable[[float], bool]) -> list[tuple[float, Any, bool]]:
        """Remove and return the items that may leave: a list of (t, item, ready(preceding)).

        preceding : s, the latest stamp added before the item, at most t; t for the first item
        """
        out = []
        while self._items:
            t, preceding, item = self._items[0]
            is_ready = ready(preceding)
            if not is_ready and self._newest - t <= self.limit and len(self._items) <= MOST_WAITING:
                break
            out.append((t, item, is_ready))
            self._items.popleft()
        return out


@compiled
def allowed_step(usual: float) -> float:
    """Return the largest plausible step, s, from the newest stamp to the next; compiled.

    usual : usual step of the stream, s
    """
    return min(max(STEP_AHEAD, USUAL * usual), LARGEST_STEP_AHEAD)


@compiled
def usual_step(usual: float, step: float) -> float:
    """Return the usual step, s, after another step; compiled. Only steps ahead count.

    usual, step : s
    """
    if not step > 0.0:
        return usual
    return usual + FORGETTING * (min(step, LARGEST_STEP_AHEAD) - usual)
