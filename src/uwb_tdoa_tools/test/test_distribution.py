# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The distribution `uwb-tdoa`: a wheel in an environment with its requirements only, without ROS.

The environments lie in build/distribution. Each is reused until the requirements, the pins or
Python change. Each run installs the current wheel.
"""

from functools import cache
from importlib import import_module
import os
from pathlib import Path
import re
import shutil
import sys

from documented import ROOT
import programs
import pytest

from uwb_tdoa_bias.common.errors import version
from uwb_tdoa_bias.effects import EFFECTS
from uwb_tdoa_tools import main
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.command_lines import COMMAND, RUN
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

pytestmark = pytest.mark.slow

HERE = f"{sys.version_info.major}.{sys.version_info.minor}"
NO_INDEX = r"NewConnectionError|NameResolution|Timeout|ProxyError|from versions: none"
KEPT = ("HOME", "TMPDIR", "PIP_", "OPENBLAS_")  # beginnings of variables; BLAS selects kernels


def run(*words, folder=None, codes=(0,)):
    """Run a program like a user without ROS, and return its output."""
    plain = {name: value for name, value in os.environ.items() if name.startswith(KEPT)}
    done = programs.run(*words, cwd=folder, env={**plain, "PATH": "/usr/bin:/bin"})
    if re.search(NO_INDEX, done.stderr) and "pip" in words:
        pytest.skip("no package index can be reached")
    assert done.returncode in codes, (words, done.stdout, done.stderr)
    return done.stdout


def python_of(number):
    """Return a Python of this version that can make an environment, or skip the test."""
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = [Path(sys.base_prefix, f"bin/python{number}"), shutil.which(f"python{number}")]
    for python in (*found, *sorted(pyenv.glob(f"{number}*/bin/python"))):
        if python and Path(python).exists():
            if run(python, "-I", "-c", "import ensurepip; print(1)", codes=(0, 1, 127)):
                return python
    pytest.skip(f"no Python {number} here")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "pip", "wheel", "--no-deps", "-w", folder, ROOT, folder=folder)
    (path,) = folder.glob("*.whl")
    return path


@cache
def installed(wheel, number):
    """Return the folder with the programs of an environment with the wheel and our pins."""
    place, python = ROOT / "build" / "distribution" / number, python_of(number)
    lines = (ROOT / "requirements.txt").read_text().splitlines()
    pins = "\n".join(line for line in lines if re.match(r"[\w.-]+==", line))
    wheel.with_name("pins.txt").write_text(pins)
    needed = f"{python}\n{pins}\n{(ROOT / 'pyproject.toml').read_text()}"
    made_for = place / "needs.txt"
    fresh = not made_for.exists() or made_for.read_text() != needed
    if fresh:
        shutil.rmtree(place, ignore_errors=True)
        run(python, "-m", "venv", "--without-pip", place)
    pip = (sys.executable, "-m", "pip", "--python", place / "bin" / "python", "install")
    pip += ("--no-compile", "--only-binary", ":all:", "-c", wheel.with_name("pins.txt"), wheel)
    run(*pip, *(() if fresh else ("--no-deps", "--force-reinstall")))
    made_for.write_text(needed)
    return place / "bin"


# Prints the help of each command, and reads a bag.
OF_ALL = """
from uwb_tdoa_tools import main
import uwb_tdoa as uwb
for name in main.NAMES:
    assert main.main([name, "--help"]) == 0
print(len(uwb.read("flight.bag").tdoa) > 1000, uwb.__version__)
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Return a folder with a bag that has our message types, and its anchors. One is late."""
    folder = tmp_path_factory.mktemp("recording")
    settings = {"duration": 12.0, "imu_rate": 100.0, "start_in_air": True, "seed": 4}
    flight = simulate(SimulationConfig(truth_rate=50.0, bias=False, multipath=False, **settings))
    write_bag(EFFECTS["anchor_delay"]({"3": 0.3}).inject(flight), folder / "flight.bag")
    flight.anchors.to_yaml(folder / "anchors.yaml")
    return folder


@pytest.mark.parametrize("number", ["3.10", "3.11", "3.12"])
def test_every_command_starts_in_an_empty_environment(wheel, recording, number):
    programs = installed(wheel, number)
    ours = {path.name for path in programs.iterdir()}
    assert COMMAND in ours and not ours & set(main.NAMES)  # `convert` is a program of ImageMagick
    assert run(programs / COMMAND, "--version") == f"uwb-tdoa of uwb_tdoa {version()}\n"
    told = run(programs / "python", "-I", "-c", OF_ALL, folder=recording)
    assert told.endswith(f"True {version()}\n")
    assert all(f"usage: uwb-tdoa {name} " in told for name in main.NAMES)


# arguments of each command, with the files that it writes; exit codes
WORK = {
    "check": (["flight.bag", "--json", "OUT/check.json"], (0,)),
    "evaluate": (["flight.bag", "--json", "OUT/evaluate.json", "--tum", "OUT/tum"], (0,)),
    "localize": (["flight.bag", "--smooth", "--out", "OUT/localized"], (0, 1)),
    "diagnose": (["flight.bag", "--most", "4000", "--out", "OUT/diagnosis"], (0,)),
    "survey": (["flight.bag", "--out", "OUT/surveyed"], (2,)),  # it refuses such a short flight
    "plan": (["anchors.yaml", "--step", "1", "--out", "OUT/plan"], (0,)),
}
FIGURES = ".json", ".csv", ".tum", ".yaml", ".html"


def figures(folder):
    """Return {path: content} of all files with figures below a folder; its path is replaced."""
    return {
        path.relative_to(folder): path.read_bytes().replace(str(folder).encode(), b"OUT")
        for path in sorted(folder.rglob("*"))
        if path.suffix in FIGURES
    }


def test_figures_are_those_with_ros_bit_by_bit(wheel, recording, tmp_path, monkeypatch, capsys):
    """The commands of the sources run in this process. Those of the wheel run as programs."""
    tool = installed(wheel, HERE) / COMMAND
    monkeypatch.chdir(recording)
    monkeypatch.setenv(RUN, COMMAND)
    with_ros, without = tmp_path / "with", tmp_path / "without"
    for name, (words, codes) in WORK.items():
        for out in (with_ros, without):
            out.mkdir(exist_ok=True)
        ours, theirs = ([w.replace("OUT", str(o)) for w in words] for o in (with_ros, without))
        capsys.readouterr()
        assert import_module(f"uwb_tdoa_tools.commands.{name}").main(ours) in codes
        printed = capsys.readouterr().out.replace(str(with_ros), "OUT")
        other = run(tool, name, *theirs, codes=codes).replace(str(without), "OUT")
        assert printed.split() == other.split(), name  # line breaks depend on the folder
    assert figures(with_ros) == figures(without) and len(figures(without)) >= 9
    assert "anchor_delay" in (without / "diagnosis" / "effects.yaml").read_text()
