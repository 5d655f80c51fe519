"""What became of the measurements lately, by the clock of this machine: the one judge of that for
`status` and for /diagnostics.
"""

from __future__ import annotations

from collections import deque
import math
from typing import TYPE_CHECKING

from uwb_tdoa_bias.common.sensors import LOCATING

if TYPE_CHECKING:
    from collections.abc import Mapping

SILENT = 1.0  # s without a measurement that was used, before it is said
WINDOW = 1.5  # s over which shares are judged
# s, the same for TDOAs that contradict the filter: 46 % at most in 22 measured flights, of which
# some land
WINDOW_OF_REJECTED = 4.0
# s after a start, before which it is not said that TDOAs contradict the filter: on the floor, 85 %
# for 3 s
SETTLED = 5.0
EARLY = 0.05  # s by which a look may come early
LARGEST_UNUSED = 0.5  # share of TDOAs that are not used for one reason, before it is said
FEWEST = 10  # TDOAs of a window that say something
REASONS = "late", "invalid", "rejected"
USED = (
    "used",
    "compensated",
    *(f"{name}_{verdict}" for name in LOCATING for verdict in ("used", "compensated")),
)


class Use:
    """Looks at the counts of an Estimator several times a second.

    tdoa_age, imu_age : s since a TDOA or distance, or an inertial sample, was seen to be used; inf
        before the first. arrival_age : s since
    a TDOA or distance was seen to arrive.
    """

    def __init__(self, lag: float) -> None:
        """lag : s, for which the filter waits."""
        self._lag = lag
        self._looks: deque[tuple[float, dict[str, int]]] = (
            deque()
        )  # (time.monotonic(), counts) of the last seconds
        self._since: dict[
            str, float
        ] = {}  # time.monotonic() of the last look at which there was more, by kind
        self._running_since = math.inf  # time.monotonic()
        self._now = -math.inf

    def look(
        self, now: float, received: Mapping[str, int], counts: Mapping[str, int], running: bool
    ) -> None:
        """Take totals at time.monotonic() `now`, s. received : messages by stream; counts : by
        verdict; running : there is a position.
        """
        totals = {
            "arrival": received["tdoa"] + sum(received[name] for name in LOCATING),
            "tdoa": sum(counts[name] for name in USED),
            "imu": counts["imu_used"],
            "velocity": counts["velocity_used"],
            "restarts": counts["restarts"],
            "counted": counts["used"] + counts["compensated"],
            **{reason: counts[reason] for reason in REASONS},
        }
        before = self._looks[-1][1] if self._looks else dict.fromkeys(totals, 0)
        self._since |= {
            kind: now
            for kind in ("arrival", "tdoa", "imu", "velocity", "restarts")
            if totals[kind] > before[kind]
        }
        if not running or totals["restarts"] > before["restarts"]:
            self._running_since = math.inf
        if running and self._running_since == math.inf:
            self._running_since = now
        self._now = now
        self._looks.append((now, totals))
        while len(self._looks) > 2 and self._looks[1][0] <= now - WINDOW_OF_REJECTED:
            self._looks.popleft()

    def _age(self, kind: str) -> float:
        return self._now - self._since[kind] if kind in self._since else math.inf

    @property
    def tdoa_age(self) -> float:
        return self._age("tdoa")

    @property
    def arrival_age(self) -> float:
        return self._age("arrival")

    @property
    def imu_age(self) -> float:
        return self._age("imu")

    @property
    def restart_age(self) -> float:
        """s since the filter was seen to start anew."""
        return self._age("restarts")

    @property
    def imu_used(self) -> bool:
        """Whether inertial samples were used lately."""
        return self.imu_age < SILENT

    @property
    def velocity_used(self) -> bool:
        """Whether velocities were used lately."""
        return self._age("velocity") < SILENT

    def _shares(self, window: float) -> dict[str, float]:
        """Shares of the TDOAs of the last `window`, s, by what became of them, 0 to 1; empty for
        too few.
        """
        until = self._now - window + EARLY
        first = next((totals for at, totals in reversed(self._looks) if at <= until), None)
        if first is None:
            return {}
        last = self._looks[-1][1]
        recent = {name: max(last[name] - first[name], 0) for name in ("counted", *REASONS)}
        total = sum(recent.values())
        return {name: count / total for name, count in recent.items()} if total >= FEWEST else {}

    @property
    def contradicted(self) -> bool:
        """Whether most TDOAs contradict a filter that has run for a while."""
        settled = self._now - self._running_since > SETTLED
        return settled and self._shares(WINDOW_OF_REJECTED).get("rejected", 0.0) > LARGEST_UNUSED

    @property
    def trouble(self) -> str | None:
        """Why most TDOAs are not used, a sentence, or None."""
        shares = self._shares(WINDOW)
        for name in ("late", "invalid"):
            if shares.get(name, 0.0) > LARGEST_UNUSED:
                return self._sentence(name)
        none_used = self.tdoa_age > SILENT and shares.get("rejected", 0.0) > LARGEST_UNUSED
        return self._sentence("rejected") if none_used or self.contradicted else None

    def _sentence(self, reason: str) -> str:
        reasons = {
            "late": (
                "come too late to be used: if they arrive late or in bursts, raise lag (-p "
                f"lag:=, now {self._lag} s); if they come out of "
                "order, raise reorder; otherwise another stream is stamped ahead"
            ),
            "invalid": (
                "are invalid (not finite, or of ids that uwb/anchors does not list): correct the "
                "driver, or list its anchors"
            ),
            "rejected": "contradict the filter: check the anchors' positions, and tdoa_std",
        }
        return f"more than half of the TDOAs {reasons[reason]}"
