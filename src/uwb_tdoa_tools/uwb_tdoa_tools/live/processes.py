# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Start executables as processes in a private ROS domain, and read their /diagnostics.

`run_live` runs a bag through both nodes, and records their output.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
import json
import os
from pathlib import Path
import random
import re
import shutil
import signal
import subprocess
import time
from typing import Any

from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from diagnostic_msgs.msg import DiagnosticArray
from domain_coordinator import domain_id
import rclpy
from rclpy.node import Node
from rclpy.serialization import deserialize_message

from uwb_tdoa_bias.common.errors import Failure
from uwb_tdoa_bias.common.files import refuse_output
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_ekf.results import VERDICTS

from ..bags.files import open_bag
from .session import Stop, recorded_odometry, session, taken

STOP_LIMIT, PATIENCE = 10.0, 60.0  # s from SIGINT to SIGKILL; the latter if it must end well
LOOK = 10.0  # s between two looks at what is waited for, and between two lines about it
READY = re.compile(r"\]: ready\b")  # in the log of a node
TAIL = 8192  # bytes of a log that are looked at
BUSY = 0.2  # share of the time beyond which a process computes; nodes that wait take 0.02


class LiveError(Failure):
    """A process failed or made no progress. The message names it and the file of its output."""


@contextmanager
def variables(values: dict[str, str]) -> Iterator[None]:
    """Set environment variables for the block and the processes that it starts."""
    before = {name: os.environ.get(name) for name in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def own_domain() -> Iterator[None]:
    """Use a free ROS domain on this machine only, for the block and the processes that it starts.

    The domain is drawn at random: in the first free one DDS may still list nodes that ended just now.
    """
    with (
        domain_id(lambda: random.randint(1, 100)) as number,
        variables({"ROS_DOMAIN_ID": str(number), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}),
    ):
        yield


def wait(
    limit: float | None,
    what: str,
    processes: Processes,
    node: Node,
    condition: Callable[[], object],
    say: Callable[[str], object] = lambda text: None,
    goes_on: Callable[[], object] = lambda: None,
) -> None:
    """Serve the node until condition().

    Parameters
    ----------
    limit : float or None
        s without progress. Progress is a change of `goes_on()`, or a starting process that computes,
        as a node that compiles does.
    what : str
        The awaited event, in words.
    say : callable
        Called every few seconds with the event and the state of the processes.

    Raises
    ------
    LiveError
        If a process ended that should run, or after `limit`.
    """
    looked = moved = time.monotonic()
    worked, sign = processes.busy_times(), goes_on()
    while not condition():
        processes.check()
        now = time.monotonic()
        if now - looked > LOOK:
            working, before, work = now - looked, worked, processes.busy_times()
            busy = any(work[title] - before.get(title, 0.0) > BUSY * working for title in work)
            looked, worked = now, work
            say(f"waiting for {what}: {processes.describe()}")
            if busy or goes_on() != sign:
                moved, sign = now, goes_on()
        if limit is not None and now - moved > limit:
            raise LiveError(
                f"waited {limit:g} s for {what}, and nothing went on ({processes.describe()}); "
                f"their output is in {processes.folder}/*.log."
            )
        rclpy.spin_once(node, timeout_sec=0.05)
    processes.check()


class DiagnosticsListener:
    """Hold the newest status of each node on /diagnostics, and whether it still changes."""

    def __init__(self, node: Node) -> None:
        self._newest: dict[str, dict[str, str]] = {}
        self._repeated: dict[str, int] = {}
        self._subscription = node.create_subscription(
            DiagnosticArray, "/diagnostics", self._take, 10
        )

    def _take(self, message: DiagnosticArray) -> None:
        for status in message.status:
            name = status.name.strip("/")
            values = {pair.key: pair.value for pair in status.values}
            before, counts = self._newest.get(name, {}), _counts(values)
            same = bool(before) and all(before.get(key) == value for key, value in counts.items())
            self._repeated[name] = self._repeated.get(name, 0) + 1 if same else 0
            self._newest[name] = values

    def poll(self) -> None:
        """Take the messages that have arrived, of a node that is not spun."""
        for data, _ in taken(self._subscription):
            self._take(deserialize_message(data, DiagnosticArray))

    def repeated(self, name: str) -> int:
        """Return how often a node has reported unchanged counters since `forget`."""
        return self._repeated.get(name, 0)

    def newest(self, name: str) -> dict[str, str]:
        """Return {key: text} of a node; empty before its first status."""
        return self._newest.get(name, {})

    def forget(self) -> None:
        """Start again to count repetitions of a status.

        Messages that wait to be read are dropped. They are older than this call: a node that was not spun
        would seem settled before anything happened.
        """
        for _ in taken(self._subscription):
            pass
        self._repeated.clear()

    def counts(self) -> dict[str, dict[str, str]]:
        """Return all counters of the nodes, for comparison with earlier ones."""
        return {name: _counts(values) for name, values in self._newest.items()}

    def is_settled(self) -> bool:
        """Return whether each node has published the same counters twice: no message is on the way."""
        return len(self._repeated) == len(self._newest) and all(self._repeated.values())


def _counts(values: dict[str, str]) -> dict[str, str]:
    return {key: value for key, value in values.items() if value.isdigit()}


class Processes(AbstractContextManager["Processes"]):
    """Run executables of our packages, each in a separate process group, with its output in a file.

    The context manager ends each process that it started.
    """

    def __init__(self, folder: str | Path, stop: Stop) -> None:
        self.folder = Path(folder)
        self._stop = stop
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._may_end: dict[str, Sequence[int]] = {}

    def __exit__(self, *_: object) -> None:
        for title in list(self._running)[::-1]:
            self._end(title, STOP_LIMIT)

    def start(
        self,
        package: str,
        name: str,
        *arguments: object,
        title: str | None = None,
        may_end_with: Sequence[int] = (),
    ) -> subprocess.Popen[bytes]:
        """Start an executable and return its Popen.

        Parameters
        ----------
        title : str or None
            Name of the process, default the name of the executable; its output goes to `file(title)`.
        may_end_with : sequence of int
            Exit codes that are no failure.
        """
        try:
            program = Path(get_package_prefix(package)) / "lib" / package / name
        except PackageNotFoundError as error:
            raise LiveError(
                f"{package} is not installed; build and source the workspace."
            ) from error
        title = title or name
        refuse_output(self.file(title))
        with open(self.file(title), "wb") as log:
            self._running[title] = subprocess.Popen(
                [str(part) for part in (program, *arguments)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
            )
        self._may_end[title] = may_end_with
        return self._running[title]

    def pid(self, title: str) -> int:
        """Return the process id of a running executable."""
        return self._running[title].pid

    def file(self, title: str) -> Path:
        """Return the file with the output of a process."""
        return self.folder / f"{title.replace('/', '.')}.log"

    def check(self) -> None:
        """Raise LiveError if a process ended that should run, and KeyboardInterrupt after a signal."""
        if self._stop:
            raise KeyboardInterrupt
        for title, process in self._running.items():
            code = process.poll()
            if code is not None and code not in self._may_end[title]:
                raise self._failure(title, code)

    def busy_times(self) -> dict[str, float]:
        """Return {title: s of processor time, or of waiting for a core} of the starting processes."""
        return {
            title: _busy_time(process.pid)
            for title, process in self._running.items()
            if not READY.search(self._log_tail(title))
        }

    def describe(self) -> str:
        """Describe the last output of each starting process; of all if none is starting."""
        titles = [
            title for title in self._running if not READY.search(self._log_tail(title))
        ] or list(self._running)
        return "; ".join(
            f"{title}: {_last_line(self._log_tail(title)) or 'starting'}" for title in titles
        )

    def stop(self, title: str) -> None:
        """Interrupt a process and wait for it. Raises LiveError if its exit code is not 0."""
        code = self._end(title, PATIENCE)
        if code != 0:
            raise self._failure(title, code)

    def _end(self, title: str, limit: float) -> int:
        process = self._running.pop(title)
        for number, patience in ((signal.SIGINT, limit), (signal.SIGKILL, None)):
            if process.poll() is None:
                os.killpg(process.pid, number)
                try:
                    process.wait(patience)
                except subprocess.TimeoutExpired:
                    continue
        return process.returncode

    def _log_tail(self, title: str) -> str:
        """Return the end of the output."""
        with open(self.file(title), "rb") as log:
            log.seek(max(0, os.fstat(log.fileno()).st_size - TAIL))
            return log.read().decode(errors="replace").strip()

    def _failure(self, title: str, code: int) -> LiveError:
        last = " ".join(self._log_tail(title).splitlines()[-1:])
        return LiveError(
            f"{title} ended with code {code} ({last}); all of its output is in {self.file(title)}."
        )


def _last_line(log: str) -> str:
    """Return the last line of a log, without level, time and name."""
    return re.sub(r"^(\[[^]]*\] ?)+: ", "", (log.splitlines() or [""])[-1])


def _busy_time(pid: int) -> float:
    """Return the s that the threads of a process ran or were ready to run.

    On a loaded machine, a process that computes is ready nearly all the time.
    """
    total = 0
    for file in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        try:
            ran, waited, _ = file.read_text().split()
        except (OSError, ValueError):  # that thread has ended
            continue
        total += int(ran) + int(waited)
    return 1e-9 * total


INPUTS = ("/uwb/anchors", "/uwb/tdoa", "/imu/data")
# Matches that must exist before the first message: topic -> (publishers, subscriptions)
MATCHED = {
    "/imu/data": (0, 1),
    "/uwb/tdoa": (0, 1),
    "/uwb/anchors": (0, 2),
    "/uwb/tdoa_corrected": (1, 1),
    "/odometry": (1, 2),
}
# A replay can wait, a robot cannot: here no link may lose a message, and the replay waits for a
# stream that falls behind.
# s of stamps; hold: see config/bias_node.yaml
HOLD_BACK = {"bias_node": {"hold": 9.975}, "ekf_node": {"lag": 10.0}}
RELIABLE = {
    "bias_node": (
        "/uwb/tdoa.subscription",
        "/odometry.subscription",
        "/uwb/tdoa_corrected.publisher",
    ),
    "ekf_node": (
        "/imu/data.subscription",
        "/uwb/tdoa_corrected.subscription",
        *(f"/{of.topics[0][0]}.subscription" for of in SENSORS.values()),
        "/odometry.publisher",
    ),
}
DEPTH = 1_000_000  # messages that may wait in a subscription
READY_LIMIT = 60.0  # s without progress; the first start compiles the filter, which is progress
MATCH_LIMIT = 300.0  # s; a slow machine takes long to find the nodes
SETTLE_LIMIT = (
    60.0  # s for the diagnostics of the nodes to settle, without a change of the counters
)


@dataclass(frozen=True)
class LiveRun:
    """Result of `run_live`.

    Attributes
    ----------
    recorded : Path
        Bag with `odometry`.
    bias, ekf : dict
        {key: text}, the last diagnostics of each node.
    """

    recorded: Path
    bias: dict[str, str]
    ekf: dict[str, str]


def run_live(
    bag: str | Path,
    folder: str | Path,
    rate: float = 1.0,
    bias_parameters: dict[str, Any] | None = None,
    ekf_parameters: dict[str, Any] | None = None,
    say: Callable[[str], object] = print,
) -> LiveRun:
    """Replay a bag through bias_node and ekf_node, and record their odometry.

    The nodes run in a ROS domain without other users, on this machine only.

    Parameters
    ----------
    bag : path
        The bag to replay.
    folder : path
        Where `recorded_bag` and the output of the processes (`*.log`) go.
    rate : float
        Times as fast as recorded.
    bias_parameters, ekf_parameters : dict or None
        {name: value} for the nodes.
    say : callable
        Called with sentences about the progress.

    Returns
    -------
    LiveRun

    Raises
    ------
    LiveError
        If a process fails or makes no progress.
    KeyboardInterrupt
        After a signal.
    """
    with open_bag(bag) as reader:
        present = {connection.topic for connection in reader.connections}
        total = sum(
            connection.msgcount
            for connection in reader.connections
            if connection.topic == "/uwb/tdoa"
        )
    inputs = [topic for topic in INPUTS if topic in present]
    recorded = Path(folder) / "recorded_bag"
    if recorded.exists():
        shutil.rmtree(recorded)
    with (
        own_domain(),
        session("demo", []) as (node, stop),
        recorded_odometry(node, recorded),
        Processes(folder, stop) as processes,
    ):
        diagnostics = DiagnosticsListener(node)
        processes.start("uwb_tdoa_bias", "bias_node", *_parameters("bias_node", bias_parameters))
        processes.start("uwb_tdoa_ekf", "ekf_node", *_parameters("ekf_node", ekf_parameters))
        say("starting the nodes")
        wait(
            READY_LIMIT,
            "the nodes to find each other",
            processes,
            node,
            lambda: _is_ready(node, diagnostics),
            say,
        )
        say(f"replaying {bag} at rate {rate:g}")
        options = (
            "--rate",
            rate,
            "--follow",
            "odometry",
            "--wait-matched",
            MATCH_LIMIT,
            "--wait-topics",
            *inputs,
        )
        replay = processes.start("uwb_tdoa_tools", "replay", bag, *options, may_end_with=(0, 1))
        wait(
            None,
            "the end of the replay",
            processes,
            node,
            lambda: replay.poll() is not None,
            lambda _: say(_played(diagnostics, total)),
        )
        diagnostics.forget()
        wait(
            SETTLE_LIMIT,
            "the nodes to finish",
            processes,
            node,
            diagnostics.is_settled,
            say,
            diagnostics.counts,
        )
        for name in ("ekf_node", "bias_node"):
            processes.stop(name)
    return LiveRun(recorded, diagnostics.newest("bias_node"), diagnostics.newest("ekf_node"))


def accounts(
    bias: dict[str, str], ekf: dict[str, str], flight: Flight, recorded: int
) -> dict[str, int]:
    """Count the messages of a replayed Flight by outcome, from the last diagnostics of both nodes.

    Parameters
    ----------
    recorded : int
        Number of recorded odometries.

    Returns
    -------
    dict
        {verdict: TDOAs, "waiting": TDOAs, "lost": TDOAs, "early": TDOAs corrected before their pose
        was there, "imu_late": samples, "imu_lost": samples, "sensors_late": values of the other
        sensors, "odometry_lost": messages}.
    """
    counts = {name: int(ekf[name]) for name in (*VERDICTS.values(), "waiting")}
    counts["waiting"] += int(bias["waiting"])  # for poses, which end with the first of the streams
    counts["lost"] = len(flight.tdoa) - sum(counts.values())
    samples = 0 if flight.imu is None else len(flight.imu)
    return counts | {
        "early": int(bias["released before their pose"]),
        "imu_late": int(ekf["imu_late"]),
        "imu_lost": samples - int(ekf["IMU samples received"]),
        "sensors_late": sum(int(ekf.get(f"{name}_late", 0)) for name in SENSORS),
        "odometry_lost": int(ekf["odometry published"]) - recorded,
    }


def _parameters(name: str, values: dict[str, Any] | None) -> list[str]:
    """Return command-line arguments for the parameters of a node. JSON is also YAML."""
    values = HOLD_BACK[name] | (values or {})
    for end in RELIABLE[name]:
        values |= {
            f"qos_overrides.{end}.reliability": "reliable",
            f"qos_overrides.{end}.depth": DEPTH,
        }
    return [
        "--ros-args",
        *(part for key, value in values.items() for part in ("-p", f"{key}:={json.dumps(value)}")),
    ]


def _played(diagnostics: DiagnosticsListener, total: int) -> str:
    """State in words how many TDOAs of the bag bias_node has received."""
    received = int(diagnostics.newest("bias_node").get("received", 0))
    return f"{100.0 * received / max(total, 1):.0f} % of the flight is through"


def _is_ready(node: Node, diagnostics: DiagnosticsListener) -> bool:
    found = diagnostics.newest("ekf_node").get("publishers of uwb/tdoa_corrected", "0") != "0"
    return (
        found
        and bool(diagnostics.newest("bias_node"))
        and all(
            node.count_publishers(topic) >= publishers
            and node.count_subscribers(topic) >= subscriptions
            for topic, (publishers, subscriptions) in MATCHED.items()
        )
    )
