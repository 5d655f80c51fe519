# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""No command is silent: it prints a message within 2 s, and then at least every 10 s.

Only the computing time of the command counts. If it has to wait for a core, other processes use the
same cores. Then it may take twice as long to compute.
"""

import os
from pathlib import Path
import selectors
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools import command_lines
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.config import corners

# s, limits of the first message and of each silence; then the computing time that is measured if
# the command is silent, also on a busy machine
FIRST, EVERY = 2.0, 11.0
LONG_ENOUGH = 2.0 * (FIRST + EVERY)
PATIENCE = 120.0  # s, limit for a command to end after an interrupt
# share of time waiting for a core above which the machine counts as busy
CROWD = 0.05
WORDS = {  # command: its arguments
    "calibrate": "flight.bag --out calibrated",
    "check": "wrong.bag",
    "convert": "flight.bag --out other.bag",
    "debias": "fit flight.bag --out map.npz",
    "demo": "--out out",
    "diagnose": "flight.bag --out diagnosis",
    "evaluate": "flight.bag",
    "export": "--survey anchors.yaml --effects effects.yaml --onnx bias.onnx",
    "fly": "--flights 2 --jobs 1",
    "inject": "flight.bag --effect anchor_delay --value 3=0.3 --out late.bag",
    "localize": "flight.bag --smooth --residuals --out localized",
    "map_anchors": "flight.bag --survey two.yaml --out map",
    "plan": "anchors.yaml --improve --out maps",
    "simulate": "--duration 300 --out long.bag",
    "survey": "flight.bag --out surveyed",
    "train": "flight.bag --model paper --out model",
}
ELSEWHERE = {"replay"}  # these wait for the time of a recording


def test_every_command_is_here():
    commands = {
        path.stem for path in (Path(command_lines.__file__).parent / "commands").glob("[a-z]*.py")
    }
    assert commands == WORDS.keys() | ELSEWHERE


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """Return a folder with a flight, a flight with wrong TDOA signs, and anchors."""
    folder = tmp_path_factory.mktemp("desk")
    flight = simulate(SimulationConfig(seed=1, duration=120.0))
    write_bag(flight, folder / "flight.bag")
    np.negative(flight.tdoa.d, out=flight.tdoa.d)
    write_bag(flight, folder / "wrong.bag")
    corners().to_yaml(folder / "anchors.yaml")
    corners().only([0, 2]).to_yaml(folder / "two.yaml")
    EffectSet((EFFECTS["anchor_delay"]({"3": 0.3}),)).to_yaml(folder / "effects.yaml")
    return folder


def computed(pid):
    """Return the processor time of a process and its children, s."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK") + sum(map(computed, children))


def waited(pid):
    """Return the time that the main thread of a process has waited for a core, s."""
    try:
        return 1e-9 * int(Path(f"/proc/{pid}/schedstat").read_text().split()[1])
    except (FileNotFoundError, ProcessLookupError):
        return 0.0


def end(process):
    """Interrupt a command, then kill the rest of its process group.

    On an interrupt, the command ends its own child processes. A kill would leave nodes in other
    process groups.
    """
    for number, patience in ((signal.SIGINT, PATIENCE), (signal.SIGKILL, None)):
        try:
            os.killpg(process.pid, number)
            process.communicate(timeout=patience)
        except (ProcessLookupError, subprocess.TimeoutExpired):
            pass


def silences(name, words, folder):
    """Run a command, and measure its silences in computing time.

    Returns the share of time waiting for a core, and [s] before each message and the end. Measuring
    stops at the first message after FIRST, or after LONG_ENOUGH.
    """
    out, process = [], None
    line = [sys.executable, "-m", "uwb_tdoa_tools.main", name, *words]
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with subprocess.Popen(line, cwd=folder, start_new_session=True, **pipes) as process:
        selector = selectors.DefaultSelector()
        selector.register(process.stdout, selectors.EVENT_READ)
        then, clock, before, crowd = time.monotonic(), 0.0, 0.0, 0.0
        began = then
        spoken = 0.0
        while True:
            heard = selector.select(0.2)
            now, used = time.monotonic(), max(before, computed(process.pid))
            clock, then, before = clock + min(now - then, used - before), now, used
            crowd = max(crowd, waited(process.pid) / (now - began))
            if heard:
                out.append(clock - spoken)
                spoken = clock
                if not os.read(process.stdout.fileno(), 1 << 16) or clock > FIRST:
                    break
            if clock > LONG_ENOUGH:
                out.append(clock - spoken)
                break
        end(process)
    return crowd, out


@pytest.mark.slow
@pytest.mark.parametrize("name", WORDS)
def test_nobody_waits_in_silence(desk, name):
    if name == "demo":
        pytest.importorskip("rclpy")
    crowd, (first, *others) = silences(name, WORDS[name].split(), desk)
    slower = 2.0 if crowd > CROWD else 1.0
    print(
        f"{name}: first word after {first:.1f} s, then at most {max(others, default=0.0):.1f} "
        "s of silence"
    )
    assert first < FIRST * slower and max(others, default=0.0) < EVERY * slower, (first, others)
