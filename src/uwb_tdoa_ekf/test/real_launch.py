# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The real ros2 command: from the ROS installation, or built once from ../shared/ros2cli."""

import fcntl
from importlib.util import find_spec
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
import threading

from programs import run
import pytest

ROOT = Path(__file__).resolve().parents[3]
FOLDER, MADE = ROOT.parent / "shared" / "ros2cli", ROOT / "build" / "ros2cli"
WITH = "psutil", "argcomplete", "packaging"  # required by ros2cli
PATIENCE = 180.0  # s, limit for every wait
# asyncio prints this if SIGINT comes between two statements of the loop of launch. Then launch ends
# with exit code 1, even if all nodes end well.
FAULT_OF_LAUNCH = "Task was destroyed but it is pending!"
# Its code is executed, so only the user or root may write to it.
OURS = (
    FOLDER.is_dir()
    and FOLDER.stat().st_uid in (os.getuid(), 0)
    and not FOLDER.stat().st_mode & 0o022
)
WHY_NOT = (
    None
    if shutil.which("ros2") or OURS and all(map(find_spec, WITH))
    else f"no ros2 command: .venv/bin/python -m pip install {' '.join(WITH)}"
    if OURS
    else "no ros2 command, and no ../shared/ros2cli of yours alone beside the checkout"
)


def ros2():
    """Return the first words of a ros2 command."""
    if WHY_NOT:
        pytest.skip(WHY_NOT)
    if shutil.which("ros2"):
        return ["ros2"]
    setup = MADE / "install" / "local_setup.bash"
    MADE.mkdir(parents=True, exist_ok=True)
    with open(MADE / "lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not setup.exists():  # launch_ros imports composition_interfaces
            command = [
                sys.executable,
                "-m",
                "colcon",
                "--log-base",
                MADE / "log",
                "build",
                "--merge-install",
            ]
            command += [
                "--base-paths",
                FOLDER / "src",
                "--build-base",
                MADE / "build",
                "--install-base",
                MADE / "install",
            ]
            command += [
                "--cmake-args",
                "-G",
                "Ninja",
                "-DBUILD_TESTING=OFF",
                f"-DPython3_EXECUTABLE={sys.executable}",
            ]
            made = run(*command, cwd=ROOT)
            assert made.returncode == 0, made.stdout + made.stderr
    return [
        "bash",
        "-c",
        'source "$0" && exec "$@"',
        str(setup),
        sys.executable,
        str(FOLDER / "ros2"),
    ]


class Launch:
    """A running `ros2 launch` in its own process group, as in a terminal.

    lines : output of launch and its nodes.
    over : whether all processes have ended.
    """

    def __init__(self, folder, *words, path=()):
        """Start `ros2 launch`.

        Parameters
        ----------
        folder : Path
            Empty folder for temporary files and logs.
        words : str
            Arguments of `ros2 launch`.
        path : sequence of Path
            Folders in front of PATH.
        """
        self.temporary = folder / "temporary"
        self.temporary.mkdir()
        variables = {
            "TMPDIR": str(self.temporary),
            "ROS_LOG_DIR": str(folder / "log"),
            "PYTHONUNBUFFERED": "1",
        }
        variables["PATH"] = os.pathsep.join([*map(str, path), os.environ["PATH"]])
        # Without a terminal, launch forwards Ctrl-C. Nodes then receive it twice.
        self._terminal, stdin = os.openpty()
        self.process = subprocess.Popen(
            [*ros2(), "launch", *words],
            env={**os.environ, **variables},
            stdin=stdin,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        os.close(stdin)
        self.lines, self._news, self.over = [], threading.Condition(), False
        self.reader = threading.Thread(target=self._collect, daemon=True)
        self.reader.start()

    def _collect(self):
        for line in self.process.stdout:
            with self._news:
                self.lines.append(line)
                self._news.notify_all()
        with self._news:
            self.over = True
            self._news.notify_all()

    @property
    def said(self):
        return "".join(self.lines)

    def wait(self, text, count=1):
        """Wait until a text was printed `count` times."""
        with self._news:
            self._news.wait_for(lambda: self.over or self.said.count(text) >= count, PATIENCE)
        assert self.said.count(text) >= count, f"waited for {text}: {self.said}"

    def ended(self):
        """Wait for the end and return the exit code."""
        code = self.process.wait(timeout=PATIENCE)
        self.reader.join(timeout=PATIENCE)
        return code

    def interrupt(self):
        """Send Ctrl-C and check that all nodes end cleanly."""
        started = self.said.count("process started with pid")
        os.killpg(self.process.pid, signal.SIGINT)
        code = self.ended()
        if FAULT_OF_LAUNCH in self.said:
            # Lines of nodes begin with "["; the traceback of launch does not.
            lines = [line for line in self.lines if line.startswith("[")]
        else:
            lines = self.lines
            assert code == 0, self.said
        assert not any("Traceback" in line for line in lines), self.said
        assert (
            self.said.count("process has finished cleanly") + self.said.count("process has died")
            == started
        ), self.said

    def pid_of(self, node):
        """Return the process id of the last started node with this name."""
        line = [
            line
            for line in self.lines
            if f"[{node}-" in line and "process started with pid [" in line
        ][-1]
        return int(line.rpartition("[")[2].partition("]")[0])

    def close(self):
        """Kill all remaining processes."""
        try:
            os.killpg(self.process.pid, signal.SIGKILL)
        except ProcessLookupError:
            pass
        self.process.wait()
        self.reader.join(timeout=PATIENCE)
        self.process.stdout.close()
        os.close(self._terminal)
