# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Status of a node on /diagnostics and in the log, including paused simulated time."""

from __future__ import annotations

import math
import re
import time
from typing import TYPE_CHECKING, Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock as SteadyClock, ClockType, ROSClock
from rclpy.qos import QoSProfile

if TYPE_CHECKING:
    from collections.abc import Callable

    from rclpy.node import Node

    from .node import StreamNode

BEHIND = 0.5  # s, longest wait of a request without a warning
AGAIN = 30.0  # s until a sentence may be logged again
# Match each number as a whole. A pattern with backtracking at each digit takes 8 s for 20 000 digits.
NUMBER = re.compile(
    r"([-+]?)\d+(\.\d+)?(?=(\s*(?:%|s\b|ms\b|m\b|Hz|messages|samples|TDOAs|times))?)"
)
# s between reports, and number of checks per report for urgent changes.
REPORT_PERIOD, LOOKS = (1.0, 5)
# s without a new time on /clock; longest period of a running clock, s.
PAUSED, SLOWEST_CLOCK = (0.5, 2.0)
DIAGNOSTICS_QOS = QoSProfile(depth=10)

Report = tuple[bytes, str, dict[str, Any]]  # level of a DiagnosticStatus, text, values


class Diagnostics:
    """Publishes one status on /diagnostics each second of the wall clock.

    It publishes at once if simulated time stops or continues. A LogFilter decides
    which statuses it logs.

    Parameters
    ----------
    report : callable of () -> (level, text, {key: value}), level: DiagnosticStatus.OK, WARN or ERROR
    look : callable of (), called LOOKS times per second
    """

    def __init__(
        self,
        node: StreamNode,
        report: Callable[[], Report],
        look: Callable[[], None] = lambda: None,
    ) -> None:
        self._node, self._report, self._look = node, report, look
        self._log_filter = LogFilter()
        self._clock, self._looks = SimulatedClock(node), 0
        self._clock_status: tuple[bytes, str] | None = None
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", DIAGNOSTICS_QOS)
        node.create_timer(
            REPORT_PERIOD / LOOKS,
            self._on_timer,
            clock=SteadyClock(clock_type=ClockType.STEADY_TIME),
        )

    def _on_timer(self) -> None:
        before, self._clock_status = self._clock_status, self._clock.status()
        self._looks += 1
        if self._looks % LOOKS == 0 or before != self._clock_status:
            self.publish()
        self._look()

    @property
    def paused(self) -> bool:
        """Whether simulated time stands still."""
        return self._clock_status is not None

    def publish(self) -> None:
        """Publish the status now."""
        level, text, values = self._report()
        spinner = self._node.spinner
        if spinner is not None:
            late = spinner.longest_wait
            spinner.longest_wait = 0.0  # one value per process: the first node reports it
            values |= {"longest wait of a request": f"{late:.3f} s"}
            if late > BEHIND and level == DiagnosticStatus.OK:
                level = DiagnosticStatus.WARN
                text = f"this node answers up to {late:.1f} s late: check the load of this machine"
        values |= {
            "frozen": "yes" if self._node.frozen else "no",
            "refused because frozen": self._node.refused,
        }
        refused = self._node.refused_lately()
        if refused and level == DiagnosticStatus.OK:
            level, text = DiagnosticStatus.WARN, refused
        level, text = self._clock_status or (level, text)
        if self._log_filter.should_log(text, time.monotonic()):
            logger = self._node.get_logger()
            if level == DiagnosticStatus.OK:
                logger.info(text)
            else:  # separate line: rclpy allows one severity per line
                logger.warning(text)
        name = self._node.get_fully_qualified_name()
        entries = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        status = DiagnosticStatus(
            level=level, name=name, message=text, hardware_id=name, values=entries
        )
        message = DiagnosticArray(status=[status])
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(message)


class LogFilter:
    """Decides which sentences are worth a line in the log.

    Sentences that differ only in measured numbers are of one kind; ids of anchors are no measured
    numbers. A sentence is logged if its kind differs from that of the last logged one, and was not
    logged within AGAIN seconds. Sentences that are not logged do not count.
    """

    def __init__(self) -> None:
        self._last_logged: str | None = None
        self._logged_at: dict[str, float] = {}  # {kind: s}, within AGAIN

    def should_log(self, text: str, now: float) -> bool:
        """Return whether to log a text now, and count it as logged; now : s."""
        kind = NUMBER.sub(_unless_id, text)
        if kind == self._last_logged or now - self._logged_at.get(kind, -math.inf) < AGAIN:
            return False
        recent = {other: at for other, at in self._logged_at.items() if now - at < AGAIN}
        self._logged_at = recent | {kind: now}
        self._last_logged = kind
        return True


def _unless_id(number: re.Match[str]) -> str:
    """Return "#" for a measured number: one with a sign, a decimal point or a unit.

    The id of an anchor has none of these, and stays.
    """
    return "#" if any(number.groups()) else number[0]


class SimulatedClock:
    """Detects whether simulated time of a node stands still; asked a few times per second."""

    def __init__(self, node: Node, now: Callable[[], float] = time.monotonic) -> None:
        self._node, self._now = node, now
        self._time: int | None = None  # last time, ns
        self._since, self._period = now(), 0.0  # s: time of the last change; recent period

    def status(self) -> tuple[bytes, str] | None:
        """Return (level, text) while simulated time stands still, else None."""
        clock: ROSClock = self._node.get_clock()  # type: ignore[assignment]  # nodes have this class of clock
        now = self._now()
        if not clock.ros_time_is_active:
            self._time = None
            return None
        time_of_it = clock.now().nanoseconds
        if time_of_it == 0:
            remedy = "play the bag with --clock, or set use_sim_time to false"
            return (
                DiagnosticStatus.WARN,
                f"use_sim_time is set, and nobody publishes /clock: {remedy}",
            )
        if time_of_it != self._time:
            took = now - self._since
            if self._time is not None and took < SLOWEST_CLOCK:
                self._period = max(took, 0.5 * self._period)
            self._time, self._since = time_of_it, now
        stands = now - self._since > max(PAUSED, 2.0 * self._period)
        return (DiagnosticStatus.OK, "paused: /clock stands still") if stands else None


class Elapsed:
    """Call it for the time since the start, s, by the clock of a node; it never goes back.

    Ages by it are right in a simulation at any speed.
    """

    def __init__(self, node: Node) -> None:
        self._clock: ROSClock = node.get_clock()  # type: ignore[assignment]  # nodes have this class
        self._seconds, self._last = 0.0, 0.0

    def __call__(self) -> float:
        now = time.monotonic()
        if self._clock.ros_time_is_active:
            now = self._clock.now().nanoseconds * 1e-9
        if self._last:  # simulated time is 0 before its first message
            self._seconds += max(now - self._last, 0.0)
        self._last = now
        return self._seconds


class Rate:
    """Rate of events per second of the wall clock."""

    def __init__(self) -> None:
        self._count, self._since = 0, time.monotonic()

    def of(self, count: int) -> float:
        """Return the rate since the last call, Hz; count : running total."""
        now = time.monotonic()
        rate = (count - self._count) / max(now - self._since, 1e-3)
        self._count, self._since = count, now
        return rate
