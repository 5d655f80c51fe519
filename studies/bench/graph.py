# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Measure how fast nodes answer parameter requests, apply an initial pose, and report a stopped
clock, while messages flow.
"""

from __future__ import annotations

from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
import os
from pathlib import Path
import re
import subprocess
import sys
import time
from typing import TYPE_CHECKING, Any

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
from rcl_interfaces.srv import GetParameters
import rclpy

from uwb_tdoa_tools.live.session import LiveError

from .figures import Figure
from .nodes import PACKAGES, READY_LIMIT, ready_at, surroundings
from .usage import cpu_seconds

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from numpy.typing import ArrayLike
    from rclpy.node import Node

    from uwb_tdoa_tools.live.session import Processes

CASES = (  # Hz of /clock, Hz of /tf, whether streams flow, number of busy processes
    (0.0, 0.0, False, 0),
    (0.0, 0.0, True, 0),
    (40.0, 0.0, True, 0),
    (200.0, 0.0, True, 0),
    (1000.0, 0.0, True, 0),
    (1000.0, 500.0, True, 0),
    (1000.0, 500.0, True, 2),
)
NODE = "ekf_node"
ROOT = Path(__file__).resolve().parents[2]
FLIGHT = 30.0  # s, over and over
UNASKED = 5.0  # s in which its CPU is taken
SILENCE = 20.0  # s without an answer, or without a report, after which there will be none
# s
TARGETS = {"get_parameters p99": 0.2, "initialpose, the longest": 0.2, "a pause told after": 1.0}
TARGET_IDLE = 1.0  # % of a core


@dataclass
class Answers:
    """Response times of a node.

    answers, poses : s that each get_parameters, each initialpose took, SILENCE without an answer
    periods : s between reports
    pause : s until a stopped clock was reported, None without a report
    cpu : share of one core
    """

    answers: list[float] = field(default_factory=list)
    poses: list[float] = field(default_factory=list)
    periods: np.ndarray = field(default_factory=lambda: np.empty(0))
    pause: float | None = None
    cpu: float = np.nan


def measure(
    progress: Callable[[str], object], folder: Path, quick: bool = False
) -> Iterator[Figure]:
    """Generator of Figures. progress(text); folder : for the output of the nodes."""
    seconds = 6.0 if quick else 20.0
    for clock, tf, streams, busy in [CASES[0], CASES[3], CASES[-1]] if quick else CASES:
        section = describe(clock, tf, streams, busy)
        progress(section)
        yield from figures(section, ask(folder, seconds, clock, tf, streams, busy), streams)


def describe(clock: float, tf: float, streams: bool, busy: int) -> str:
    """Title of a case."""
    parts = [f"/clock at {clock:g} Hz"] if clock else []
    parts += [f"/tf at {tf:g} Hz"] if tf else []
    parts += ["streams at 1 kHz + 400 Hz"] if streams else []
    parts += [f"{busy} busy loops"] if busy else []
    return f"the rest of the graph, {NODE}: {', '.join(parts) or 'nothing flows'}"


def figures(section: str, found: Answers, streams: bool) -> Iterator[Figure]:
    """Figures of Answers."""

    def of(name: str, unit: str, values: ArrayLike) -> Figure:
        return Figure.of(section, name, unit, values, TARGETS.get(name))

    yield of("get_parameters p50", "s", np.percentile(found.answers, 50, method="nearest"))
    yield of("get_parameters p99", "s", np.percentile(found.answers, 99, method="nearest"))
    yield of("initialpose, the longest", "s", max(found.poses))
    yield Figure.of(section, "from one report to the next", "s", found.periods)
    yield of("the longest from one report to the next", "s", max(found.periods))
    if found.pause is not None:
        yield of("a pause told after", "s", found.pause)
    target = None if streams else TARGET_IDLE
    yield Figure.of(section, f"CPU, {NODE}", "% of a core", 100.0 * found.cpu, target)


def ask(
    folder: Path,
    seconds: float,
    clock: float = 0.0,
    tf: float = 0.0,
    streams: bool = True,
    busy: int = 0,
    arguments: Sequence[str] = (),
) -> Answers:
    """Measure the Answers of an ekf_node for `seconds`.

    clock, tf : Hz, 0.0 for none
    streams : whether the streams of a flying tag arrive, through a bias_node
    busy : number of processes that each use a whole core
    arguments : additional arguments of the ekf_node
    """
    with ExitStack() as stack:
        node, processes = stack.enter_context(surroundings(folder))
        options = ["--ros-args", "-p", f"publish_tf:={'odom' if tf else 'base'}", *arguments]
        if clock:
            options += ["-p", "use_sim_time:=true"]
        log = processes.file(NODE)
        processes.start(PACKAGES[NODE], NODE, *options)
        if streams:
            processes.start(
                PACKAGES["bias_node"],
                "bias_node",
                *(["--ros-args", "-p", "use_sim_time:=true"] if clock else []),
            )
            _wait(
                node,
                READY_LIMIT,
                lambda: ready_at(
                    "bias_node", processes.file("bias_node").read_text(errors="replace")
                ),
            )
        _wait(node, READY_LIMIT, lambda: ready_at(NODE, log.read_text(errors="replace")))
        loads = {"tf": tf, "streams": FLIGHT if streams else 0.0, "clock": clock}
        running = {
            what: stack.enter_context(_load(what, number))
            for what, number in loads.items()
            if number
        }
        for _ in range(busy):
            stack.enter_context(_process([sys.executable, "-I", "-c", "while True: pass"]))
        return _Asking(node, processes, log).ask(seconds, running.get("clock"))


class _Asking:
    def __init__(self, node: Node, processes: Processes, log: Path) -> None:
        self._node, self._processes, self._log = node, processes, log
        self._reports: list[tuple[float, str]] = []  # (arrival, text)
        self._client = node.create_client(GetParameters, f"/{NODE}/get_parameters")
        self._poses = node.create_publisher(PoseWithCovarianceStamped, "/initialpose", 10)
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_report, 10)

    def _on_report(self, message: DiagnosticArray) -> None:
        self._reports += [
            (time.monotonic(), each.message)
            for each in message.status
            if each.name.strip("/") == NODE
        ]

    def ask(self, seconds: float, clock: subprocess.Popen[bytes] | None) -> Answers:
        """clock : Popen of the process that publishes it, or None."""
        out, began = Answers(), time.monotonic()
        _wait(
            self._node,
            SILENCE,
            lambda: len(self._reports) > 2 or time.monotonic() > began + SILENCE - 1.0,
        )
        _wait(self._node, SILENCE, self._client.service_is_ready)
        _wait(self._node, SILENCE, self._poses.get_subscription_count)
        before, began = cpu_seconds(self._processes.pid(NODE)), time.monotonic()
        _wait(self._node, UNASKED + 1.0, _later_than(began + UNASKED))
        out.cpu = (cpu_seconds(self._processes.pid(NODE)) - before) / (time.monotonic() - began)
        began, self._reports = time.monotonic(), []
        while time.monotonic() < began + seconds:
            out.answers.append(self._call())
            if len(out.answers) % 10 == 1:
                out.poses.append(self._tell(len(out.poses)))
            if out.answers[-1] == SILENCE:
                break
            _wait(self._node, 1.0, _later_than(time.monotonic() + 0.05))
        took = time.monotonic() - began
        arrivals = [began, *(arrival for arrival, _ in self._reports), began + took]
        out.periods = np.diff(arrivals[1:-1]) if len(arrivals) > 3 else np.array([took])
        if clock is not None:
            out.pause = self._pause(clock)
        return out

    def _call(self) -> float:
        began, future = (
            time.monotonic(),
            self._client.call_async(GetParameters.Request(names=["tdoa_std"])),
        )
        while not future.done() and time.monotonic() < began + SILENCE:
            rclpy.spin_once(self._node, timeout_sec=0.01)
        return time.monotonic() - began if future.done() else SILENCE

    def _tell(self, number: int) -> float:
        """s until the node has said, by the time of its log, that it does not take a pose in a
        frame of this number.
        """
        message, frame, began = PoseWithCovarianceStamped(), f"nowhere_{number}", time.time()
        message.header.frame_id = frame
        self._poses.publish(message)
        found: list[str] = []

        def said() -> bool:
            found[:] = re.findall(
                r"\[([0-9.]+)\] .*initialpose: not taken: .*", self._log.read_text(errors="replace")
            )[number:]
            return bool(found) or time.time() > began + SILENCE

        _wait(self._node, SILENCE + 1.0, said)
        return float(found[0]) - began if found else SILENCE

    def _pause(self, clock: subprocess.Popen[bytes]) -> float:
        _end(clock)
        stopped = time.monotonic()

        def reported() -> bool:
            paused = any(a > stopped and "paused" in text for a, text in self._reports)
            return paused or time.monotonic() > stopped + SILENCE

        _wait(self._node, SILENCE + 1.0, reported)
        arrivals = [a for a, text in self._reports if a > stopped and "paused" in text]
        return arrivals[0] - stopped if arrivals else SILENCE


@contextmanager
def _load(what: str, number: float) -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "studies.bench.load", what, f"{number:g}"]
    # By PYTHONPATH: with PYTHONSAFEPATH, -m does not look into the present folder.
    found = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])}
    with _process(command, stdout=subprocess.PIPE, env=found) as process:
        assert process.stdout is not None  # it is a pipe
        if not process.stdout.readline():  # a line says that it begins
            raise LiveError(f"the {what} ended before it began: {' '.join(command)}")
        yield process


@contextmanager
def _process(command: Sequence[str], **options: Any) -> Iterator[subprocess.Popen[bytes]]:
    process = subprocess.Popen(command, stdin=subprocess.DEVNULL, **options)
    try:
        yield process
    finally:
        _end(process)


def _end(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is None:
        process.kill()
    process.wait()


def _later_than(t: float) -> Callable[[], bool]:
    """Whether it is later than t, s, by time.monotonic()."""
    return lambda: time.monotonic() > t


def _wait(node: Node, limit: float, condition: Callable[[], object]) -> None:
    until = time.monotonic() + limit
    while not condition():
        if time.monotonic() > until:
            raise LiveError(f"waited {limit:g} s in vain")
        rclpy.spin_once(node, timeout_sec=0.01)
