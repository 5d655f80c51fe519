# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""`./dev launch` without ROS."""

import os
import runpy
import signal
import subprocess
import time

from documented import ROOT
import programs
import pytest

pytest.importorskip("uwb_tdoa_msgs.msg")

from uwb_tdoa_bias.common.errors import Failure, InputError  # noqa: E402
from uwb_tdoa_ekf.launching import LAUNCH_FILES, start  # noqa: E402
from uwb_tdoa_tools.live.session import (  # noqa: E402
    own_domain,  # noqa: E402
    parameter_of,
    session,
)
from uwb_tdoa_tools.simulation.config import corners

FILE = ROOT / ".dev" / "launch.py"
SCRIPT = runpy.run_path(str(FILE))
PATIENCE = 120.0  # s, limit of each wait


@pytest.mark.parametrize(
    ("file", "word", "sentence"),
    [
        ("tdoa.launch.py", "anchor_file:=a.yaml", "is no launch argument"),
        ("tdoa.launch.py", "a.yaml", "is no launch argument"),
        ("tdoa.launch.py", "respawn:=perhaps", "must be one of true, false"),
        ("tdoa.launch.py", "rviz:=true", "needs an installation of ROS 2"),
        ("tags.launch.py", "processes:=2", "tags: is missing"),
    ],
)
def test_wrong_arguments_are_one_sentence(file, word, sentence):
    with pytest.raises(InputError, match=sentence):
        SCRIPT["given"](LAUNCH_FILES[file].arguments, [word])


@pytest.fixture
def run(tmp_path, monkeypatch):
    """Return run(script, **arguments), a RunningNode whose executable is a shell script."""
    folder = tmp_path / "lib" / "uwb_tdoa_ekf"
    folder.mkdir(parents=True)
    monkeypatch.setitem(
        SCRIPT["RunningNode"].__init__.__globals__, "get_package_prefix", lambda _: tmp_path
    )
    nodes = []

    def made(script, **arguments):
        (folder / "ekf_node").write_text(f"#!/bin/sh\n{script}\n")
        (folder / "ekf_node").chmod(0o755)
        values = SCRIPT["given"](LAUNCH_FILES["tdoa.launch.py"].arguments, []) | arguments
        nodes.append(SCRIPT["RunningNode"](start("ekf_node", "tag1", {}), values, {**os.environ}))
        return nodes[-1]

    yield made
    SCRIPT["end"](nodes)


def until(condition):
    """Wait for condition()."""
    limit = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < limit
        time.sleep(0.05)


def test_a_node_that_refuses_what_it_is_given_ends_everything(run):
    node = run("exit 2")
    with pytest.raises(Failure, match="tag1/ekf_node refuses what it is given"):
        until(lambda: not node.look())
    other = run("exit 2", on_exit="stay")
    until(lambda: not other.look())


def test_a_node_that_crashes_is_started_again(run, tmp_path):
    log = tmp_path / "log"
    log.touch()
    node = run(f"echo started >> {log}; exit 3")
    until(lambda: node.look() and log.read_text().count("started") > 1)


@pytest.mark.slow
def test_an_interrupt_ends_all_nodes(tmp_path):
    corners().to_yaml(tmp_path / "anchors.yaml")
    words = "namespace:=tag1", "body_frame:=drone", f"anchors_file:={tmp_path / 'anchors.yaml'}"
    with own_domain(), session("test", []) as (node, _):
        launched = programs.start(
            FILE, "uwb_tdoa_ekf", "tdoa.launch.py", *words, stderr=subprocess.STDOUT
        )
        try:
            until(lambda: node.count_publishers("/tag1/odometry"))
            until(lambda: node.count_publishers("/tag1/uwb/anchors"))
            assert parameter_of(node, "/tag1/ekf_node", "body_frame") == "drone"
            expected = {(name, "/tag1") for name in ("anchors_node", "bias_node", "ekf_node")}
            until(lambda: expected <= {*node.get_node_names_and_namespaces()})
        finally:
            launched.send_signal(signal.SIGINT)
            said, _ = launched.communicate(timeout=PATIENCE)
    pids = [int(line.rpartition(" ")[2]) for line in said.splitlines() if " with pid " in line]
    assert launched.returncode == 0 and len(pids) == 3 and "Traceback" not in said, said
    for pid in pids:
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)
