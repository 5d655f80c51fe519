"""How a process serves its streams, and everything else of the graph that concerns it: in turn, so
that neither waits for the other.
"""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING, Any

from rclpy.executors import SingleThreadedExecutor, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation as implementation

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from rclpy import Future

    from .ros_node import StreamNode
    from .ros_streams import RoundRobin

try:  # not in rclpy before 7.1.4; a message costs a quarter
    from rclpy.experimental import EventsExecutor
except ImportError:
    EventsExecutor = None  # type: ignore[assignment]  # says that there is none

LONGEST_SLEEP = 0.2  # s, until a process without streams sees a signal
QUIET, LOOK = (
    1.0,
    0.05,
    # s without a message of a stream, after which it is looked for each LOOK s, and not each
    # millisecond
)
SERVED = 0.005  # s from one service of the graph to the next, while streams flow
LONGEST_SERVICE = 0.05  # s; only with a SingleThreadedExecutor


class Spinner:
    """The life of the nodes of a process. Messages of streams, and those of /clock and /tf, which
    may come a thousand times a second, wait in the middleware until a turn takes and computes them
    together: a callback for each costs a fifth more in all, and a call of the filter for each more
    than that. Then the process rests as long as the turn took, at least a millisecond. Every SERVED
    s everything else of the graph, requests, timers, transforms, is served by an executor of rclpy,
    in the order in which it came, and nothing can be passed over: a mark is put at the end of its
    queue, and it is run until the mark comes. Where no stream has said anything for a while, the
    process sleeps in the executor. (`docs/measured.md` has what was measured.)

    longest_wait : s, the longest that anything has waited since this was set to 0.0.
    """

    def __init__(self, nodes: list[StreamNode], turns: RoundRobin | None = None) -> None:
        """nodes : a list that is kept up to date."""
        self.longest_wait = 0.0
        self._nodes, self._turns = nodes, turns
        self._executor = SingleThreadedExecutor() if EventsExecutor is None else EventsExecutor()
        self._served = time.monotonic()
        for node in nodes:
            self._serve_node(node)

    def replace(self, gone: Iterable[StreamNode], new: Iterable[StreamNode]) -> None:
        """Leave some nodes, and serve others."""
        for node in gone:
            self._executor.remove_node(node)
            self._nodes.remove(node)
        for node in new:
            self._nodes.append(node)
            self._serve_node(node)

    def _serve_node(self, node: StreamNode) -> None:
        node.spinner = self
        self._executor.add_node(node)

    def spin(self, stop: Future) -> None:
        """Live until the future `stop` is done, or the context ends."""
        taken, sleep, quiet = (
            -math.inf,
            LONGEST_SLEEP if self._turns is None else LOOK,
            True,
        )  # taken : when a turn last took anything
        while not stop.done() and self._nodes[0].context.ok():
            if quiet or time.monotonic() >= self._served + SERVED:
                self._guarded(self._serve)
            rest, now = self._turns.take() if self._turns is not None else None, time.monotonic()
            taken = taken if rest is None else now
            quiet = now >= taken + QUIET
            if quiet:
                self._guarded(self._executor.spin_once, timeout_sec=sleep)
                self._served = time.monotonic()
            else:
                time.sleep(rest or self._turns.PERIOD)  # type: ignore[union-attr]  # without turns it is quiet

    def close(self) -> None:
        """Leave the nodes."""
        for node in self._nodes:
            self._executor.remove_node(node)
        self._executor.shutdown()

    def _serve(self) -> None:
        """Everything that has come so far."""
        if EventsExecutor is None:
            self._serve_each()
        else:
            mark = self._executor.create_task(
                _nothing
            )  # tasks wait in the same queue as everything else
            while not mark.done():
                self._executor.spin_once(timeout_sec=0.0)
        now = time.monotonic()
        self.longest_wait, self._served = max(self.longest_wait, now - self._served), now
        for node in self._nodes:
            node.take_clock()

    def _serve_each(self) -> None:
        """With the SingleThreadedExecutor, which has no queue: one of everything that waits, until
        nothing does, or for a while.
        """
        until, found = time.monotonic() + LONGEST_SERVICE, True
        while found and time.monotonic() < until:
            found = False
            try:
                while True:
                    handler, *_ = self._executor.wait_for_ready_callbacks(timeout_sec=0.0)
                    found = True
                    handler()
                    handler.result()
            except TimeoutException:
                pass

    def _guarded(self, serve: Callable[..., None], **arguments: Any) -> None:
        """Requests to services are decoded by rclpy, which raises what cannot be."""
        try:
            serve(**arguments)
        except implementation.RCLError as error:
            self._nodes[0].warn_at_times("request", f"passed over what could not be taken: {error}")


def _nothing() -> None:
    """What a mark does."""
