# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Less capable machines: no POSIX-only modules, and a home directory that is read-only.

An ASCII locale, and names with spaces and umlauts: test_writers.py. Another user: test_dev.py.
"""

import os
import subprocess
import sys

import pytest
from test_layout import ROS, modules

from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

# Modules that are missing on Windows or macOS. They are hidden before any import.
HIDE = """
import os, signal, sys
for name in "fcntl grp pwd pty resource syslog termios tty".split():
    sys.modules[name] = None
for name in "O_DIRECTORY O_NOFOLLOW O_PATH fchdir getuid killpg sched_getaffinity".split():
    vars(os).pop(name, None)
for name in "ITIMER_REAL SIGALRM SIGKILL setitimer".split():
    vars(signal).pop(name, None)
"""
NOWHERE = "/proc/nowhere"  # even root cannot write there


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """A bag of a short flight."""
    path = tmp_path_factory.mktemp("bags") / "short.bag"
    settings = {"duration": 8.0, "imu_rate": 100.0, "truth_rate": 50.0, "start_in_air": True}
    write_bag(simulate(SimulationConfig(**settings)), path)
    return path


def run(code, *words, folder, **variables):
    return subprocess.run(
        [sys.executable, "-c", code, *map(str, words)],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": "1", **variables},
        capture_output=True,
        text=True,
    )


@pytest.mark.slow
def test_all_that_needs_no_ros_is_imported_without_posix(tmp_path):
    off_line = [name for name in modules() if name not in ROS]
    done = run(
        f"{HIDE}\nimport importlib\nfor n in {off_line}: importlib.import_module(n)",
        folder=tmp_path,
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stderr


START = (
    "from uwb_tdoa_bias.common.executable import executable\n"
    "name, *words = sys.argv[1:]\n"
    "sys.exit(executable(f'uwb_tdoa_tools.commands.{name}')(words))"
)


@pytest.mark.slow
def test_commands_run_without_posix(bag, tmp_path):
    for name, words in (
        ("check", [bag, "--json", "check.json"]),
        ("localize", [bag, "--jobs", "1", "--out", "out"]),
    ):
        done = run(f"{HIDE}\n{START}", name, *words, folder=tmp_path)
        assert done.returncode in (0, 1) and "Traceback" not in done.stderr, done.stderr
    assert (tmp_path / "check.json").stat().st_size and list((tmp_path / "out").glob("*.png"))


def test_a_network_is_refused_where_its_trial_has_no_limits(tmp_path):
    code = (
        f"{HIDE}\nfrom uwb_tdoa_bias.correction.trial import tried_out\n"
        "from uwb_tdoa_bias.correction.session import Unplayable\n"
        "try:\n    tried_out(b'model')\nexcept Unplayable as error:\n    print(error)"
    )
    done = run(code, folder=tmp_path)
    assert done.stdout.startswith("this system does not limit the memory"), done.stderr


@pytest.mark.slow
def test_a_command_needs_no_home_to_write_to(bag, tmp_path):
    """The cache of numba lies elsewhere here.

    Without it, compilation takes minutes and prints a message.
    """
    kept = os.environ.get("NUMBA_CACHE_DIR") or os.path.expanduser("~/.cache/uwb_tdoa")
    homeless = {"HOME": NOWHERE, "XDG_CACHE_HOME": NOWHERE, "NUMBA_CACHE_DIR": kept}
    done = run(
        f"import sys\n{START}",
        *("evaluate", bag, "--plot", "error.png"),
        folder=tmp_path,
        **homeless,
    )
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert (tmp_path / "error.png").stat().st_size > 1000


def test_a_node_says_where_its_log_may_go(tmp_path):
    pytest.importorskip("rclpy")
    pytest.importorskip("uwb_tdoa_msgs.msg")
    code = (
        "import sys\nfrom uwb_tdoa_bias.common.executable import node_executable\n"
        "sys.exit(node_executable('uwb_tdoa_bias.anchors_node')())"
    )
    kept = {name: value for name, value in os.environ.items() if not name.startswith("ROS_LOG")}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env={**kept, "HOME": NOWHERE, "ROS_HOME": NOWHERE},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2 and "Traceback" not in done.stderr, done.stderr
    last = done.stderr.splitlines()[-1]
    assert "log directory" in last and last.endswith("export ROS_LOG_DIR=/tmp/ros-log")
