"""Run a bag through both nodes, as processes, over ROS topics, and record what they say."""

import json
import os
import shutil
import signal
import subprocess
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import rclpy
from ament_index_python.packages import PackageNotFoundError, get_package_prefix
from diagnostic_msgs.msg import DiagnosticArray
from domain_coordinator import domain_id

from .bag_files import open_bag
from .ros_session import session

INPUTS = ("/uwb/anchors", "/uwb/tdoa", "/imu/data")
# Who must have found whom before the first message: topic -> (publishers, subscriptions)
MATCHED = {
    "/imu/data": (0, 1),
    "/uwb/tdoa": (0, 1),
    "/uwb/anchors": (0, 2),
    "/uwb/tdoa_corrected": (1, 1),
    "/odometry": (1, 2),
}
# A replay can wait, a robot cannot: here no link may lose a message, and a stream that falls behind is waited for.
PATIENCE = {"bias_node": {"hold": 9.975}, "ekf_node": {"lag": 10.0}}  # s of stamps; hold: see config/bias_node.yaml
RELIABLE = {
    "bias_node": ("/uwb/tdoa.subscription", "/odometry.subscription", "/uwb/tdoa_corrected.publisher"),
    "ekf_node": ("/imu/data.subscription", "/uwb/tdoa_corrected.subscription", "/odometry.publisher"),
}
DEPTH = 1_000_000  # messages that may wait in a subscription
READY_LIMIT = 180.0  # s: the very first start compiles the filter
MATCH_LIMIT = 60.0  # s
SETTLE_LIMIT = 600.0  # s: on a slow machine a replay at a high rate leaves a lot to catch up with
STOP_LIMIT = 10.0  # s


class LiveError(Exception):
    """A process of the run failed, or did not get where it should; the message says which and where its output is."""


@dataclass(frozen=True)
class LiveRun:
    """recorded : path of a bag with `odometry`; bias, ekf : {key: text}, the last diagnostics of each node."""

    recorded: Path
    bias: dict
    ekf: dict


def run_live(bag, folder, rate=1.0, bias_parameters=None, ekf_parameters=None, say=print):
    """Start bias_node, ekf_node and record, wait until they have found each other, replay the bag, stop them.

    bag : path of a bag; folder : where the recorded bag (`recorded.bag`) and the output of the processes (`*.log`) go;
    rate : times as fast as recorded; bias_parameters, ekf_parameters : {name: value} for the nodes; say(text) : tells
    what happens now.
    In a ROS domain of its own, on this machine only. Returns a LiveRun. Raises LiveError, and KeyboardInterrupt after a
    signal.
    """
    with open_bag(bag) as reader:
        present = {connection.topic for connection in reader.connections}
    inputs = [topic for topic in INPUTS if topic in present]
    recorded = Path(folder) / "recorded.bag"
    if recorded.exists():
        shutil.rmtree(recorded)
    reservation = domain_id()  # nobody else's as long as this function runs
    environment = {"ROS_DOMAIN_ID": str(reservation.__enter__()), "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    with _variables(environment), session("demo", []) as (node, stop), _Processes(folder, stop) as processes:
        diagnostics = _Diagnostics(node)
        processes.start("uwb_tdoa_bias", "bias_node", *_parameters("bias_node", bias_parameters))
        processes.start("uwb_tdoa_ekf", "ekf_node", *_parameters("ekf_node", ekf_parameters))
        processes.start("uwb_tdoa_tools", "record", "--output", recorded, "odometry")
        say("starting the nodes; the very first start compiles the filter, which takes a minute")
        _wait(READY_LIMIT, "the nodes to find each other", processes, node, lambda: _is_ready(node, diagnostics))
        say(f"replaying {bag} at rate {rate:g}")
        options = ("--rate", rate, "--wait-matched", MATCH_LIMIT, "--wait-topics", *inputs)
        replay = processes.start("uwb_tdoa_tools", "replay", bag, *options, may_end=True)
        _wait(None, None, processes, node, lambda: replay.poll() is not None)
        diagnostics.forget()
        _wait(SETTLE_LIMIT, "the nodes to finish", processes, node, diagnostics.is_settled)
        for name in ("record", "ekf_node", "bias_node"):
            processes.stop(name)
    reservation.__exit__(None, None, None)
    return LiveRun(recorded, diagnostics.newest("bias_node"), diagnostics.newest("ekf_node"))


def _parameters(name, values):
    """Command-line arguments for a node's parameters; JSON is also YAML."""
    values = PATIENCE[name] | (values or {})
    for end in RELIABLE[name]:
        values |= {f"qos_overrides.{end}.reliability": "reliable", f"qos_overrides.{end}.depth": DEPTH}
    return ["--ros-args", *(part for key, value in values.items() for part in ("-p", f"{key}:={json.dumps(value)}"))]


def _is_ready(node, diagnostics):
    found = diagnostics.newest("ekf_node").get("publishers of uwb/tdoa_corrected", "0") != "0"
    return found and diagnostics.newest("bias_node") and all(
        node.count_publishers(topic) >= publishers and node.count_subscribers(topic) >= subscriptions
        for topic, (publishers, subscriptions) in MATCHED.items()
    )  # fmt: skip


def _wait(limit, what, processes, node, condition):
    """Serve the node until condition(); raises LiveError after `limit` s, or if a process has ended that should not."""
    until = None if limit is None else time.monotonic() + limit
    while not condition():
        processes.check()
        if until is not None and time.monotonic() > until:
            raise LiveError(f"waited {limit:g} s for {what}; their output is in {processes.folder}/*.log.")
        rclpy.spin_once(node, timeout_sec=0.05)
    processes.check()


class _Diagnostics:
    """The newest status of each node on /diagnostics, and whether it still changes."""

    def __init__(self, node):
        self._newest, self._repeated = {}, {}
        node.create_subscription(DiagnosticArray, "/diagnostics", self._take, 10)

    def _take(self, message):
        for status in message.status:
            name = status.name.strip("/")
            values = {pair.key: pair.value for pair in status.values}
            counts = {key: value for key, value in values.items() if value.isdigit()}
            before = self._newest.get(name, {})
            same = bool(before) and all(before.get(key) == value for key, value in counts.items())
            self._repeated[name] = self._repeated.get(name, 0) + 1 if same else 0
            self._newest[name] = values

    def newest(self, name):
        """{key: text}; empty before the first status."""
        return self._newest.get(name, {})

    def forget(self):
        """Count anew how often a status has repeated."""
        self._repeated.clear()

    def is_settled(self):
        """Whether each node has said the same counts twice in a row: nothing is on its way any more."""
        return len(self._repeated) == len(self._newest) and all(self._repeated.values())


class _Processes:
    """Executables of our packages, each in a process group of its own, output in a file. Ends what it started."""

    def __init__(self, folder, stop):
        self.folder = Path(folder)
        self._stop, self._running, self._may_end = stop, {}, set()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for name in list(self._running)[::-1]:
            self._end(name)

    def start(self, package, name, *arguments, may_end=False):
        """The Popen of the executable; with may_end, ending with code 0 is no failure."""
        try:
            program = Path(get_package_prefix(package)) / "lib" / package / name
        except PackageNotFoundError as error:
            raise LiveError(f"{package} is not installed; build and source the workspace.") from error
        with open(self.folder / f"{name}.log", "wb") as log:
            self._running[name] = subprocess.Popen(
                [str(part) for part in (program, *arguments)],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True,
            )  # fmt: skip
        if may_end:
            self._may_end.add(name)
        return self._running[name]

    def check(self):
        """Raise LiveError if a process ended that should not have, KeyboardInterrupt if we are asked to end."""
        if self._stop:
            raise KeyboardInterrupt
        for name, process in self._running.items():
            code = process.poll()
            if code is not None and not (code == 0 and name in self._may_end):
                raise self._failure(name, code)

    def stop(self, name):
        """Interrupt a process and wait for it; raises LiveError if it does not end well."""
        code = self._end(name)
        if code != 0:
            raise self._failure(name, code)

    def _end(self, name):
        process = self._running.pop(name)
        for number, patience in ((signal.SIGINT, STOP_LIMIT), (signal.SIGKILL, None)):
            if process.poll() is None:
                os.killpg(process.pid, number)
                try:
                    process.wait(patience)
                except subprocess.TimeoutExpired:
                    continue
        return process.returncode

    def _failure(self, name, code):
        file = self.folder / f"{name}.log"
        last = file.read_text(errors="replace").strip().splitlines()[-1:]
        return LiveError(f"{name} ended with code {code} ({' '.join(last)}); all of its output is in {file}.")


@contextmanager
def _variables(values):
    """Environment variables, for the block and what it starts."""
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
