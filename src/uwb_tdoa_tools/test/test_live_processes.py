# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Start, output and end of the processes of a live run."""

from contextlib import nullcontext
import os
import signal
import time
from types import SimpleNamespace

import pytest

pytest.importorskip("rclpy")
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue  # noqa: E402

from uwb_tdoa_tools.live import session as live  # noqa: E402


@pytest.fixture
def start(tmp_path, monkeypatch):
    """Return start(name, script lines), which runs a shell script as an executable of a package.

    All processes end after the test.
    """
    folder = tmp_path / "lib" / "some_package"
    folder.mkdir(parents=True)
    monkeypatch.setattr(live, "get_package_prefix", lambda package: str(tmp_path))
    asked = []

    with live.Processes(tmp_path, asked) as started:

        def start(name, *lines, **options):
            (folder / name).write_text("\n".join(("#!/bin/sh", *lines, "")))
            (folder / name).chmod(0o755)
            return started.start("some_package", name, **options)

        start.processes, start.asked = started, asked
        yield start


def wait_for_output(file, text):
    until = time.monotonic() + 120.0
    while text not in file.read_text():
        assert time.monotonic() < until, f"{text!r} never came"
        time.sleep(0.01)


@pytest.mark.parametrize(
    ("lines", "may_end_with", "said"),
    [
        (
            ["echo starting", "echo no such file >&2", "exit 3"],
            (),
            r"node ended with code 3 \(no such file\); all of its output is in .*log",
        ),
        (["exit 0"], (), "node ended with code 0"),
        (["exit 1"], (0,), "node ended with code 1"),
        (["exit 0"], (0,), None),
    ],
)
def test_a_process_that_ends_with_another_code_than_it_may_is_named(
    start, lines, may_end_with, said
):
    start("node", *lines, may_end_with=may_end_with).wait(120)
    with pytest.raises(live.LiveError, match=said) if said else nullcontext():
        start.processes.check()


def test_stop_interrupts_the_whole_group(start, tmp_path):
    node = start("node", "trap 'echo interrupted; exit 0' INT", "sleep 60 &", "echo ready", "wait")
    wait_for_output(tmp_path / "node.log", "ready")
    start.processes.stop("node")
    assert node.returncode == 0
    assert "interrupted" in (tmp_path / "node.log").read_text()


def test_a_process_that_ignores_the_interrupt_is_killed(start, tmp_path, monkeypatch):
    monkeypatch.setattr(live, "PATIENCE", 0.2)
    node = start("node", "trap '' INT", "echo ready", "while true; do sleep 1; done")
    wait_for_output(tmp_path / "node.log", "ready")
    with pytest.raises(live.LiveError, match="node ended with code -9"):
        start.processes.stop("node")
    assert node.returncode == -signal.SIGKILL


def test_domains_are_drawn_at_random():
    """With a fixed domain, a run could receive messages of the previous run."""

    def number():
        with live.own_domain():
            return os.environ["ROS_DOMAIN_ID"]

    assert len({number() for _ in range(8)}) > 1


def test_a_signal_to_us_ends_the_run(start):
    start.processes.check()
    start.asked.append(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        start.processes.check()


# --- waiting ---


class NobodySpeaks:
    """A stand-in for rclpy. Its node has nothing to process."""

    @staticmethod
    def spin_once(node, timeout_sec):
        time.sleep(0.01)


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(live, "rclpy", NobodySpeaks)
    monkeypatch.setattr(live, "LOOK", 0.2)


COMPILING = ("echo 'compiling, which is done once: 40%, 20 s'", "while true; do :; done")
READY = "echo '[INFO] [1.5] [node]: ready; correcting with: none'"


@pytest.mark.slow
def test_a_process_that_compiles_is_waited_for_without_limit(start, quick, tmp_path):
    start("node", *COMPILING)
    wait_for_output(tmp_path / "node.log", "compiling")
    until, told = time.monotonic() + 2.5, []
    live.wait(
        1.0,
        "the node",
        start.processes,
        None,
        lambda: told and time.monotonic() > until,
        told.append,
    )
    assert set(told) == {"waiting for the node: node: compiling, which is done once: 40%, 20 s"}


@pytest.mark.parametrize(
    "lines",
    [["sleep 600"], [READY, *COMPILING[1:]]],
    ids=["it sleeps", "it is ready, and busy otherwise"],
)
def test_without_progress_the_wait_ends(start, quick, tmp_path, lines):
    start("node", *lines)
    if READY in lines:
        wait_for_output(tmp_path / "node.log", "ready")
    with pytest.raises(
        live.LiveError, match=r"waited 0.5 s for the node, and nothing went on \(node: "
    ):
        live.wait(0.5, "the node", start.processes, None, lambda: False)


@pytest.mark.slow
def test_changing_counters_extend_the_wait(start, quick):
    start("node", READY, "sleep 600")
    until = time.monotonic() + 2.0
    live.wait(
        0.5,
        "the counts",
        start.processes,
        None,
        lambda: time.monotonic() > until,
        goes_on=lambda: int(10 * time.monotonic()),
    )


class Queue(nullcontext):
    """The handle of a subscription with messages in its queue."""

    def __init__(self):
        super().__init__()
        self.messages = []

    def take_message(self, *_):
        return self.messages.pop(0) if self.messages else None


class NoNode:
    def __init__(self):
        self.queue = Queue()

    def create_subscription(self, *_):
        return SimpleNamespace(handle=self.queue, msg_type=None)


def status(node, **values):
    pairs = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
    return DiagnosticArray(status=[DiagnosticStatus(name=f"/{node}", values=pairs)])


def test_settled_when_every_node_repeats_its_counts():
    diagnostics = live.DiagnosticsListener(node := NoNode())
    diagnostics._take(status("bias_node", received=5, rate="3.0 Hz"))
    diagnostics._take(status("ekf_node", received=4, rate="3.0 Hz"))
    node.queue.messages += ["said before", "said before, too"]
    diagnostics.forget()
    assert not node.queue.messages  # old messages cannot settle it
    assert not diagnostics.is_settled()
    diagnostics._take(status("bias_node", received=5, rate="0.0 Hz"))
    assert not diagnostics.is_settled()  # ekf_node has not published yet
    diagnostics._take(status("ekf_node", received=5, rate="0.0 Hz"))
    assert not diagnostics.is_settled()  # it has received one more
    diagnostics._take(status("ekf_node", received=5, rate="0.0 Hz"))
    assert diagnostics.is_settled()
    assert diagnostics.newest("ekf_node") == {"received": "5", "rate": "0.0 Hz"}
