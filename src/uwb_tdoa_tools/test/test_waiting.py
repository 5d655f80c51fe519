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
from uwb_tdoa_tools.cli import EVERY
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.config import corners

FIRST = 2.0  # s, limit of the first message
DURATION = 40.0  # s of a flight. Users have two minutes: they wait three times as long.
OF_FLIGHTS = EVERY / 3.0  # s between two messages of a command that reads such a flight
MORE = 1.0  # s, limit of a silence beyond the time between two messages
PATIENCE = 120.0  # s, limit for a command to end after an interrupt
# share of time waiting for a core above which the machine counts as busy
CROWD = 0.05
# runs a command with another time between two messages
PROGRAM = "import sys; from uwb_tdoa_tools import cli, main; cli.EVERY = {}; sys.exit(main.main())"
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
    "simulate": "--duration 100 --out long.bag",
    "survey": "flight.bag --out surveyed",
    "train": "flight.bag --model paper --out model",
}
OWN_TIME = {"demo", "fly", "plan"}  # take as long whatever a flight lasts
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
    flight = simulate(SimulationConfig(seed=1, duration=DURATION))
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


def silences(name, words, every, folder):
    """Run a command that prints a message every some seconds, and measure its silences.

    Returns the share of time waiting for a core, and [s] of computing before each message and the end.
    Measuring stops at the first message after FIRST. It also stops after twice the limits of the first
    message and of a silence.
    """
    out, process = [], None
    line = [sys.executable, "-c", PROGRAM.format(every), name, *words]
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
            if clock > 2.0 * (FIRST + every + MORE):
                out.append(clock - spoken)
                break
        end(process)
    return crowd, out


@pytest.mark.slow
@pytest.mark.parametrize("name", WORDS)
def test_nobody_waits_in_silence(desk, name):
    if name == "demo":
        pytest.importorskip("rclpy")
    every = EVERY if name in OWN_TIME else OF_FLIGHTS
    crowd, (first, *others) = silences(name, WORDS[name].split(), every, desk)
    slower = 2.0 if crowd > CROWD else 1.0
    print(
        f"{name}: first word after {first:.1f} s, then at most {max(others, default=0.0):.1f} "
        "s of silence"
    )
    limits = FIRST * slower, (every + MORE) * slower
    assert first < limits[0] and max(others, default=0.0) < limits[1], (first, others)
