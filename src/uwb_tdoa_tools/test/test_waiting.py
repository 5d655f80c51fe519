# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Nobody waits in silence: each command says something within 2 s, and goes on to say something
every 5 s.

Time counts as long as the command itself computes. Where it has to wait for a core, others compute
on the same ones, and it takes up to twice as long to compute, too.
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
from uwb_tdoa_tools.simulation.rooms import corners

# s; the last: of computing, after which enough is known of what does not end before
FIRST, EVERY = 2.0, 5.0
LONG_ENOUGH = FIRST + EVERY
PATIENCE = 120.0  # s for a command that is interrupted to end
# of the time that a command has waited for a core, from which on others compute on the same ones
CROWD = 0.05
WORDS = {  # command: words after it
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
    "plan": "anchors.yaml --improve move --out maps",
    "simulate": "--duration 300 --out long.bag",
    "survey": "flight.bag --out surveyed",
    "train": "flight.bag --model structured --out model",
}
ELSEWHERE = {"replay"}  # what these wait for is the time of a recording


def test_every_command_is_here():
    commands = {
        path.stem for path in (Path(command_lines.__file__).parent / "commands").glob("[a-z]*.py")
    }
    assert commands == WORDS.keys() | ELSEWHERE


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A folder with a flight, another one whose TDOAs have the wrong sign, and anchors."""
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
    """s of processor time of a process and of the processes that it has started."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
    except (FileNotFoundError, ProcessLookupError):
        return 0.0
    return sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK") + sum(map(computed, children))


def waited(pid):
    """s that the main thread of a process has waited for a core."""
    try:
        return 1e-9 * int(Path(f"/proc/{pid}/schedstat").read_text().split()[1])
    except (FileNotFoundError, ProcessLookupError):
        return 0.0


def end(process):
    """Interrupt a command, so that it ends what it has started, nodes in process groups of their
    own among it, which a kill would leave behind; and kill what is left of its group.
    """
    for number, patience in ((signal.SIGINT, PATIENCE), (signal.SIGKILL, None)):
        try:
            os.killpg(process.pid, number)
            process.communicate(timeout=patience)
        except (ProcessLookupError, subprocess.TimeoutExpired):
            pass


def silences(name, words, folder):
    """[s] of computing until each thing that a command says, and until its end, or LONG_ENOUGH; and
    the share of time that it had to wait for a core. What is said within EVERY of LONG_ENOUGH ends
    it: no silence after that could be too long.
    """
    out, process = [], None
    line = [sys.executable, "-m", f"uwb_tdoa_tools.commands.{name}", *words]
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
                if not os.read(process.stdout.fileno(), 1 << 16) or clock > LONG_ENOUGH - EVERY:
                    break
            if clock > LONG_ENOUGH or clock - spoken > 2.0 * EVERY:
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
