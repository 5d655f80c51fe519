# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The distribution `uwb-tdoa`: a wheel in an environment with its requirements only, without ROS.

The environments lie in build/distribution. Each is reused until the requirements of the wheel, the
pins or Python change. Each run installs the current wheel.
"""

from functools import cache
import hashlib
from importlib import import_module
import json
import os
from pathlib import Path
import re
import shutil
import subprocess
import sys
import zipfile

from documented import ROOT
import pytest

from uwb_tdoa_bias.common.text import version
from uwb_tdoa_bias.effects import EFFECTS
from uwb_tdoa_tools import main
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.command_lines import COMMAND, RUN
from uwb_tdoa_tools.simulation import SimulationConfig, simulate

pytestmark = pytest.mark.slow

HERE = f"{sys.version_info.major}.{sys.version_info.minor}"
NO_INDEX = r"NewConnectionError|NameResolution|Timeout|ProxyError|from versions: none"


def kept(*beginnings):
    """Return the environment variables whose names have such prefixes.

    Some variables select the kernels of BLAS.
    """
    return {name: value for name, value in os.environ.items() if name.startswith(beginnings)}


def run(*words, folder=None, code=0, **variables):
    """Run a program like a user without ROS, and return its output."""
    plain = {name: os.environ[name] for name in ("HOME", "TMPDIR") if name in os.environ}
    plain |= kept("PIP_", "OPENBLAS_")
    done = subprocess.run(
        list(map(str, words)),
        cwd=folder,
        env={**plain, "PATH": "/usr/bin:/bin", **variables},
        capture_output=True,
        text=True,
    )
    if re.search(NO_INDEX, done.stderr) and "pip" in words:
        pytest.skip("no package index can be reached")
    assert done.returncode == code, (words, done.stdout, done.stderr)
    return done.stdout


def python_of(number):
    """Return a Python of this version that can make an environment.

    Skip the test if there is none.
    """
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv")) / "versions"
    found = [sys.base_prefix + f"/bin/python{number}", shutil.which(f"python{number}")]
    found += sorted(pyenv.glob(f"{number}*/bin/python"))
    code = f"import ensurepip, sys, venv; assert '%d.%d' % sys.version_info[:2] == '{number}'"
    for candidate in filter(None, found):
        if (
            Path(candidate).exists()
            and not subprocess.run([candidate, "-I", "-c", code], capture_output=True).returncode
        ):
            return candidate
    pytest.skip(f"no Python {number} here")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "pip", "wheel", "--no-deps", "-w", folder, ROOT, folder=folder)
    (path,) = folder.glob("*.whl")
    return path


@cache
def installed(wheel, number):
    """Return the folder with the programs of an environment.

    It has the wheel and its requirements, with our pins.
    """
    place, python = ROOT / "build" / "distribution" / number, python_of(number)
    pins = wheel.with_name("pins.txt")
    lines = (ROOT / "requirements.txt").read_text().splitlines()
    pins.write_text("\n".join(line for line in lines if re.match(r"[\w.-]+==", line)))
    pip = (sys.executable, "-m", "pip", "--python", place / "bin" / "python", "install")
    # bytecode of unused modules is not needed
    pip += ("--no-compile", "--only-binary", ":all:", "-c", pins)
    needed, made_for = needs(wheel, pins, python), place / "needs.txt"
    if not made_for.exists() or made_for.read_text() != needed:
        shutil.rmtree(place, ignore_errors=True)
        run(python, "-m", "venv", "--without-pip", place)
        run(*pip, wheel)
        made_for.write_text(needed)
    else:
        run(*pip, "--no-deps", "--force-reinstall", wheel)
    return place / "bin"


def needs(wheel, pins, python):
    """Return a digest of everything that determines an environment, except the wheel."""
    with zipfile.ZipFile(wheel) as held:
        (name,) = (each for each in held.namelist() if each.endswith(".dist-info/METADATA"))
        lines = held.read(name).splitlines()
    required = b"\n".join(line for line in lines if line.startswith(b"Requires-"))
    of_python = run(python, "-I", "-c", "import sys; print(sys.version, sys.base_prefix)")
    return hashlib.sha256(b"\0".join([required, pins.read_bytes(), of_python.encode()])).hexdigest()


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Return a folder with a bag that has our message types, and its anchors.

    One anchor is late. With more errors, the search of diagnose takes longer.
    """
    folder = tmp_path_factory.mktemp("recording")
    settings = {"duration": 12.0, "imu_rate": 100.0, "start_in_air": True, "seed": 4}
    flight = simulate(SimulationConfig(truth_rate=50.0, bias=False, multipath=False, **settings))
    write_bag(EFFECTS["anchor_delay"]({"3": 0.3}).inject(flight), folder / "flight.bag")
    flight.anchors.to_yaml(folder / "anchors.yaml")
    return folder


def test_the_wheel_holds_the_packages_and_our_messages(wheel):
    assert wheel.name == f"uwb_tdoa-{version()}-py3-none-any.whl"
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.partition("/")[0] for name in names}
    packages = {"uwb_tdoa", "uwb_tdoa_bias", "uwb_tdoa_ekf", "uwb_tdoa_tools"}
    assert tops == packages | {f"uwb_tdoa-{version()}.dist-info"}
    held = {name.rpartition("/")[2] for name in names if name.endswith(".msg")}
    assert held == {path.name for path in (ROOT / "src/uwb_tdoa_msgs/msg").glob("*.msg")}
    assert not any("/test/" in name for name in names)
    for package in packages - {"uwb_tdoa"}:
        sources = ROOT / "src" / package / package
        files = {path.relative_to(sources).as_posix() for path in sources.rglob("*.*")}
        files = {name for name in files if not re.search(r"__pycache__|\.nb[ic]$", name)}
        assert {f"{package}/{name}" for name in files} <= set(names)


# Prints a line for each command that ends successfully with its help.
HELP_OF_ALL = """
from contextlib import redirect_stdout
import io
from uwb_tdoa_tools import main
for name in main.NAMES:
    said = io.StringIO()
    with redirect_stdout(said):
        try:
            main.main([name, "--help"])
        except SystemExit as ended:
            assert not ended.code, name
    assert said.getvalue().startswith(f"usage: uwb-tdoa {name} "), said.getvalue()
    print(name)
"""


@pytest.mark.parametrize("number", ["3.10", "3.11", "3.12"])
def test_every_command_starts_in_an_empty_environment(wheel, recording, tmp_path, number):
    programs = installed(wheel, number)
    ours = {path.name for path in programs.iterdir()}
    assert COMMAND in ours and not ours & set(main.NAMES)  # `convert` is a program of ImageMagick
    tool = programs / COMMAND
    assert run(tool, "--version") == f"uwb-tdoa of uwb_tdoa {version()}\n"
    assert run(tool, "check", "--help").startswith("usage: uwb-tdoa check ")
    helped = run(programs / "python", "-I", "-c", HELP_OF_ALL)
    assert helped.split() == list(main.NAMES)
    assert "complete " in run(tool, "--completion")
    code = "import uwb_tdoa as uwb; print(len(uwb.read('flight.bag').tdoa) > 1000, uwb.__version__)"
    told = run(programs / "python", "-I", "-c", code, folder=recording)
    assert told.split() == ["True", version()]


# arguments of each command, with the files that it writes; exit code
WORK = {
    "check": (["flight.bag", "--json", "OUT/check.json"], 0),
    "evaluate": (["flight.bag", "--json", "OUT/evaluate.json", "--tum", "OUT/tum"], 0),
    "localize": (["flight.bag", "--smooth", "--out", "OUT/localized"], None),
    "diagnose": (["flight.bag", "--most", "4000", "--out", "OUT/diagnosis"], 0),
    "survey": (["flight.bag", "--out", "OUT/surveyed"], 2),  # it refuses such a short flight
    "plan": (["anchors.yaml", "--step", "1", "--out", "OUT/plan"], 0),
}
FIGURES = ".json", ".csv", ".tum", ".yaml", ".html"


def figures(folder):
    """Return {path: content} of all files with figures below a folder.

    The path of the folder is replaced.
    """
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
    outs = [tmp_path / side for side in ("with", "without")]
    for out in outs:
        out.mkdir()
    for name, (words, code) in WORK.items():
        ours, theirs = ([word.replace("OUT", str(out)) for word in words] for out in outs)
        capsys.readouterr()
        ended = import_module(f"uwb_tdoa_tools.commands.{name}").main(ours)
        said = capsys.readouterr()
        done = subprocess.run(
            [tool, name, *theirs],
            env={**kept("HOME", "OPENBLAS_"), "PATH": "/usr/bin:/bin"},
            capture_output=True,
            text=True,
        )
        assert done.returncode in ((0, 1) if code is None else (code,)), done.stderr
        # line breaks depend on the length of the folder
        printed = [
            " ".join(text.replace(str(out), "OUT").split())
            for text, out in zip((said.out, done.stdout), outs)
        ]
        assert ended == done.returncode, (name, said.err, done.stderr)
        assert printed[0] == printed[1], (name, said.err, done.stderr)
    with_ros, without = map(figures, outs)
    assert with_ros.keys() == without.keys()
    for path, content in with_ros.items():
        assert content == without[path], path
    assert json.loads((tmp_path / "without" / "evaluate.json").read_text())["runs"]
    assert "anchor_delay" in (tmp_path / "without" / "diagnosis" / "effects.yaml").read_text()
    assert len(with_ros) >= 9
