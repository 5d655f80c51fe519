# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Run the nodes of a process until Ctrl-C; serve their streams and the rest of the graph."""

from __future__ import annotations

import argparse
import gc
import math
import signal
import sys
import time
from typing import TYPE_CHECKING, Any, Protocol

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor, TimeoutException
from rclpy.impl.implementation_singleton import rclpy_implementation as implementation
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from ..common.errors import InputError
from ..common.executable import interrupt
from ..common.text import line_of

if TYPE_CHECKING:
    from collections.abc import Callable, Collection, Iterable, Sequence
    from types import FrameType

    from rclpy import Future

    from .node import StreamNode


try:  # since rclpy 7.1.4; a message takes a quarter of the time
    from rclpy.experimental import EventsExecutor
except ImportError:
    EventsExecutor = None  # type: ignore[assignment]  # None marks an older rclpy

LONGEST_SLEEP = 0.2  # s, until a process without streams reacts to a signal
# s without a message of a stream, after which the process checks streams each LOOK s instead of
# each millisecond.
QUIET, LOOK = (1.0, 0.05)
SERVED = 0.005  # s between services of the graph while streams have messages
LONGEST_SERVICE = 0.05  # s; only with a SingleThreadedExecutor
PERIOD = 0.001  # s, smallest rest after a turn
# s. After a turn the process rests as long as the turn took, at most so long: then a busy process
# takes more messages per turn.
LONGEST_REST = 0.01


class Taking(Protocol):
    """Takes arrived messages; `take` returns whether any arrived or still wait."""

    def take(self) -> bool: ...


class StreamPoller:
    """Lets nodes take their arrived messages, one node after the other.

    `run` calls the `turns` of a node, which is a StreamPoller.
    """

    PERIOD = PERIOD

    def __init__(self, streams: Collection[Taking]) -> None:
        """Set the streams: Streams, or other objects with take()."""
        self._streams = streams

    def take(self) -> float | None:
        """Run one turn, and return the rest after it, s; None if nothing arrived."""
        began = time.monotonic()
        if not any([streams.take() for streams in self._streams]):
            return None
        return min(max(time.monotonic() - began, PERIOD), LONGEST_REST)


class Spinner:
    """Serves the nodes of a process.

    Messages of streams, /clock and /tf may come 1000 times per second. They wait in the middleware
    until a turn takes and computes them together. A callback for each message would cost a fifth more
    in all. A call of the filter for each would cost even more. After a turn the process rests as long
    as the turn took, at least 1 ms.

    Every SERVED s an executor of rclpy serves the rest of the graph in the order of arrival: requests,
    timers, transforms. A mark at the end of its queue ensures completeness: the executor runs until
    it reaches the mark. While no stream has messages, the process sleeps in the executor.
    `docs/notebook/measured.md` has the measurements.

    longest_wait : s, longest wait of any request since this was set to 0.0
    """

    def __init__(self, nodes: list[StreamNode], turns: StreamPoller | None = None) -> None:
        """Start to serve nodes; `nodes` is a list that stays up to date."""
        self.longest_wait = 0.0
        self._nodes, self._turns = nodes, turns
        self._executor = SingleThreadedExecutor() if EventsExecutor is None else EventsExecutor()
        self._served = time.monotonic()
        for node in nodes:
            self._serve_node(node)

    def replace(self, gone: Iterable[StreamNode], new: Iterable[StreamNode]) -> None:
        """Stop serving some nodes, and serve others."""
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
        """Serve the nodes until the future `stop` is done, or the context ends."""
        # taken : s, time of the last turn with messages
        taken, sleep, quiet = (-math.inf, LONGEST_SLEEP if self._turns is None else LOOK, True)
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
                time.sleep(rest or self._turns.PERIOD)  # type: ignore[union-attr]  # not None: without turns the process is quiet

    def close(self) -> None:
        """Stop serving the nodes."""
        for node in self._nodes:
            self._executor.remove_node(node)
        self._executor.shutdown()

    def _serve(self) -> None:
        """Serve everything that arrived so far."""
        if EventsExecutor is None:
            self._serve_each()
        else:
            # Tasks wait in the same queue as everything else.
            mark = self._executor.create_task(_nothing)
            while not mark.done():
                self._executor.spin_once(timeout_sec=0.0)
        now = time.monotonic()
        self.longest_wait, self._served = max(self.longest_wait, now - self._served), now
        for node in self._nodes:
            node.take_clock()

    def _serve_each(self) -> None:
        """Serve one waiting item at a time until none waits, at most LONGEST_SERVICE s.

        For the SingleThreadedExecutor, which has no queue for a mark.
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
        """Call `serve`, and log requests that rclpy cannot decode."""
        try:
            serve(**arguments)
        except implementation.RCLError as error:
            self._nodes[0].warn_at_times("request", f"passed over what could not be taken: {error}")


def _nothing() -> None:
    """Do nothing: the task of a mark."""


def run(
    node_class: type[StreamNode], description: str | None, argv: Sequence[str] | None = None
) -> int:
    """Run a node until SIGINT or SIGTERM, and return the exit code.

    The code is 0, or 2 for bad usage or an InputError. It is 128 plus the signal's number if the
    signal came before the node was ready.

    Parameters
    ----------
    node_class : callable of the arguments of the process -> StreamNode, in an initialised rclpy. It has
        the executable's NAME, and may have `members` and `turns`, a StreamPoller.
    description : for --help
    argv : arguments, default: sys.argv[1:]
    """
    name = node_class.NAME
    arguments = [name, *(sys.argv[1:] if argv is None else argv)]
    parser = argparse.ArgumentParser(
        prog=name, description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    interruptible = True
    stop: Future = Future()  # holds the number of the signal

    # rclpy's own handler would end the context while a callback still publishes
    def on_signal(number: int, frame: FrameType | None) -> None:
        if not stop.done():
            stop.set_result(number)
        if interruptible:
            interrupt(number, frame)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    nodes: list[StreamNode] = []
    spinner: Spinner | None = None
    try:
        _init(parser, arguments)
        node = node_class(arguments)
        nodes = [node, *node.members]
        spinner = Spinner(nodes, getattr(node, "turns", None))
        gc.collect()
        gc.freeze()  # numba's objects are never garbage; searching them takes 0.1 s
        gc.enable()
        interruptible = False
        if stop.done():
            raise KeyboardInterrupt
        for each in reversed(nodes):  # from here on, signals end the node in good order
            each.say_ready()
        spinner.spin(stop)
    except SystemExit as ended:  # argparse has printed the error or the help
        return ended.code or 0  # type: ignore[return-value]  # argparse exits with a number
    except InputError as error:
        print(f"{name}: error: {line_of(error)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 128 + stop.result()
    except ExternalShutdownException:
        pass
    finally:
        interruptible = False
        if spinner is not None:
            spinner.close()
        for each in nodes:
            each.destroy_node()
        rclpy.try_shutdown()
    return 0


def _init(parser: argparse.ArgumentParser, arguments: list[str]) -> None:
    try:
        parser.parse_args(remove_ros_args(arguments)[1:])
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
    except (
        implementation.RCLError,
        implementation.RCLInvalidROSArgsError,
        implementation.UnknownROSArgsError,
    ) as error:
        raise InputError(refusal(error)) from error


def refusal(error: Exception) -> str:
    """Return a sentence on why rclpy did not start: its arguments, or the folder of its log."""
    if "log directory" in str(error):
        reason = str(error).partition(", at ")[0]
        return f"{reason}; name a folder that you can write to: export ROS_LOG_DIR=/tmp/ros-log"
    return f"--ros-args: {error}."
