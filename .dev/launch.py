# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Start the nodes of a launch file without the launch system of ROS: `./dev launch ...`.

Where ROS 2 is sourced, `ros2 launch` runs.
"""

import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from ament_index_python.packages import get_package_prefix

from uwb_tdoa_bias.common.errors import Failure, InputError
from uwb_tdoa_bias.common.executable import leave_present_folder_out
from uwb_tdoa_ekf.launching import LAUNCH_FILES, Lives, discovery, network
from uwb_tdoa_tools import cli

PACKAGE = "uwb_tdoa_ekf"
LOOK = 0.1  # s between two looks at the nodes
ENDING = 10.0  # s for the nodes to end before they are killed

DESCRIPTION = """Start the nodes of a launch file, as `ros2 launch` does; for those who have no ROS.

Ctrl-C ends all nodes. RViz and bag.launch.py need ROS 2; `./dev run uwb_tdoa_tools replay` plays bags."""


def parser():
    made = cli.parser(
        "launch",
        DESCRIPTION,
        "./dev launch uwb_tdoa_ekf tdoa.launch.py anchors_file:=anchors.yaml",
        "./dev launch uwb_tdoa_ekf tags.launch.py tags:=tags.yaml processes:=auto",
        "./dev launch uwb_tdoa_ekf tdoa.launch.py --show-args",
    )
    made.add_argument("package", choices=[PACKAGE])
    made.add_argument("file", choices=[*LAUNCH_FILES])
    made.add_argument("values", nargs="*", metavar="name:=value", help="launch arguments")
    made.add_argument("-s", "--show-args", action="store_true", help="list the launch arguments")
    return made


def given(arguments, words):
    """Return {name: value} of all launch arguments.

    Parameters
    ----------
    arguments : dict
        As in LaunchFile.
    words : list of str
        name:=value
    """
    values = {name: default for name, (default, _, _) in arguments.items()}
    for word in words:
        name, separator, value = word.partition(":=")
        if not separator or name not in arguments:
            raise InputError(f"{word}: is no launch argument; --show-args lists them.")
        allowed = arguments[name][2]
        if allowed and value not in allowed:
            raise InputError(f"{word}: must be one of {', '.join(filter(None, allowed))}.")
        values[name] = value
    missing = [name for name, value in values.items() if value is None]
    if missing:
        raise InputError(f"{missing[0]}: is missing; give {missing[0]}:=VALUE.")
    if values["rviz"] == "true":
        raise InputError("rviz: needs an installation of ROS 2; leave it out.")
    return values


class RunningNode:
    """One node: its process, and when it is started again after a crash."""

    def __init__(self, start, values, environment):
        folder = Path(get_package_prefix(start.package)) / "lib" / start.package
        names = {
            "__ns": f"/{start.namespace.strip('/')}" if start.namespace else "",
            "__node": start.name,
        }
        remaps = [word for key, name in names.items() if name for word in ("-r", f"{key}:={name}")]
        self._command = [folder / start.executable, "--ros-args", *remaps, *start.words]
        self._environment, self._label = environment, start.label
        self._lives = Lives(start.label, values["respawn"] == "true", values["on_exit"])
        self.run()

    def run(self):
        """Start the process, in a group of its own: Ctrl-C reaches it once, by `end`."""
        self._due, self._began = None, time.monotonic()
        self.process = subprocess.Popen(
            self._command, env=self._environment, stdin=subprocess.DEVNULL, start_new_session=True
        )
        cli.say("launch", f"{self._label} started with pid {self.process.pid}")

    def look(self):
        """Start the node again when it is due, and return whether it lives or will live."""
        if self._due is None and self.process.poll() is not None:
            then = self._lives.ended(self.process.returncode, time.monotonic() - self._began)
            if then.everything:
                raise Failure(then.text)
            if then.text:
                cli.say("launch", then.text)
            self._due = float("inf") if then.again is None else time.monotonic() + then.again
        if self._due is not None and time.monotonic() >= self._due:
            self.run()
        return self._due != float("inf")


def end(nodes):
    """Interrupt all nodes, and wait for them; kill those that do not end."""
    for number, limit in ((signal.SIGINT, ENDING), (signal.SIGKILL, ENDING)):
        living = [node.process for node in nodes if node.process.poll() is None]
        for process in living:
            os.killpg(process.pid, number)
        until = time.monotonic() + limit
        while any(process.poll() is None for process in living) and time.monotonic() < until:
            time.sleep(LOOK)


def _run(args):
    file = LAUNCH_FILES[args.file]
    if args.show_args:
        for name, (default, text, _) in file.arguments.items():
            cli.show(f"{name}:={default or ''}", f"    {text}")
        return
    values = given(file.arguments, args.values)
    starts = file.starts(values)
    leave_present_folder_out()
    environment = {**os.environ, **discovery(os.environ, values["discovery_range"])}
    cli.say("launch", network(environment))
    nodes, stop = [], []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: stop.append(number))
    try:
        for start in starts:
            nodes.append(RunningNode(start, values, environment))
        while not stop and any([node.look() for node in nodes]):
            time.sleep(LOOK)
    finally:
        end(nodes)


if __name__ == "__main__":
    sys.exit(cli.run(_run, parser()))
