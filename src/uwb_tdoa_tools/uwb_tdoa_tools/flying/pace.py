"""When the next turn of a vehicle on topics may come: at its time, or, where time is simulated,
when the estimate is there.
"""

from __future__ import annotations

from collections import deque
from statistics import median_low
import time
from typing import TYPE_CHECKING

from uwb_tdoa_ekf.reorder_buffer import TRIAL

from .simulator import DT

if TYPE_CHECKING:
    from collections.abc import Callable

    from .simulator import SensorReadings

LARGEST_CATCH_UP = 0.1  # s: a longer delay shifts all that follows
LONGEST_GAP = (
    0.3  # s of stamps after which the filter goes on without a stream: more than ekf_node's `lag`
)
# s that it waits for what is out of order, until it knows that nothing is: more than its `reorder`
UNTRUSTED = 0.005
PATIENCE, IMPATIENCE = (
    5.0,
    0.05,
)  # s of the wall clock for an estimate that is due, and for one after another that did not come
REMEMBERED = 9  # odometries by which their period is known


class RealTime:
    """Each turn at its time."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._began, self._now = clock, clock(), 0.0

    def sent(self, now: float, measured: SensorReadings) -> None:
        """SensorReadings, all up to `now`, s, were published."""
        self._now = now

    def heard(self, t: float) -> None:
        """An odometry stamped t, s, has come."""

    def may_go_on(self) -> bool:
        """Whether it is time for the next turn."""
        behind = self._clock() - self._began - self._now
        if behind > LARGEST_CATCH_UP:
            self._began += behind - LARGEST_CATCH_UP
        return behind >= 0.0


class Lockstep:
    """The next turn comes when the odometry is there that the filter makes of what was sent:
    whatever else the computer does, the same seed gives the same flight. One that does not come is
    waited for PATIENCE, and the next ones IMPATIENCE until one does.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._reach, self._since = clock, 0.0, 0.0
        self._newest: dict[str, float] = {}
        self._first: float | None = None
        self._heard: float | None = None
        self._periods, self._silent = deque([DT], REMEMBERED), True

    def sent(self, now: float, measured: SensorReadings) -> None:
        """SensorReadings, all up to `now`, s, were published."""
        self._newest |= {
            stream: part.t[-1] for stream, part in measured.streams.items() if len(part.t)
        }
        self._first = now if self._first is None else self._first
        settled = 0.0 if now > self._first + TRIAL + UNTRUSTED else UNTRUSTED
        self._reach = max(min(self._newest.values(), default=now), now - LONGEST_GAP) - settled
        self._since = self._clock()

    def heard(self, t: float) -> None:
        """An odometry stamped t, s, has come."""
        if self._heard is not None:
            self._periods.append(t - self._heard)
        self._heard = t

    def may_go_on(self) -> bool:
        """Whether what is due is there, or is not waited for any longer."""
        if self._heard is not None and self._heard + median_low(self._periods) > self._reach:
            self._silent = False
            return True
        if self._clock() < self._since + (IMPATIENCE if self._silent else PATIENCE):
            return False
        self._silent = True
        return True
