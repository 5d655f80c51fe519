# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Every executable: help, examples, documented commands, and Ctrl-C during the start."""

import argparse
from importlib import import_module
import os
from pathlib import Path
import re
import runpy
import shlex
import shutil
import signal
import subprocess
import sys

import pytest
import yaml

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from documented import PAGES, ROOT, commands  # noqa: E402

from uwb_tdoa_tools import cli  # noqa: E402
from uwb_tdoa_tools.bags.bag import write_bag  # noqa: E402
from uwb_tdoa_tools.simulation import SimulationConfig, simulate  # noqa: E402
from uwb_tdoa_tools.simulation.rooms import corners

NODES = {
    "anchors_node": "uwb_tdoa_bias.anchors_node",
    "autopilot_node": "uwb_tdoa_tools.autopilot_node",
    "bias_node": "uwb_tdoa_bias.bias_node",
    "debias_node": "uwb_tdoa_ekf.debias_node",
    "ekf_node": "uwb_tdoa_ekf.ekf_node",
    "localization_node": "uwb_tdoa_ekf.localization_node",
    "vehicle_node": "uwb_tdoa_tools.vehicle_node",
}
MEMBERS = {"localization_node": ("bias_node", "ekf_node")}  # it also takes their parameters
COMMANDS = {"compile_nodes": "uwb_tdoa_ekf.compile_nodes"} | {
    path.stem: f"uwb_tdoa_tools.commands.{path.stem}"
    for path in sorted((ROOT / "src/uwb_tdoa_tools/uwb_tdoa_tools/commands").glob("[a-z]*.py"))
}
EVERY = NODES | COMMANDS
TOOLS = [name for name, module in COMMANDS.items() if module.startswith("uwb_tdoa_tools.")]


def parser_of(name):
    if name == "ros2":  # of ./dev, with the same output as ROS 2
        return runpy.run_path(str(ROOT / ".dev" / "ros2.py"))["parser"]()
    return import_module(COMMANDS[name]).parser()


def subcommands(parser):
    """Return {name: parser} of the subcommands of a parser."""
    found = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    return found[0].choices if found else {}


def parses(name, words):
    """Return whether the parser of an executable accepts the words. Print the error if not."""
    try:
        parser_of(name).parse_args(cli.without_ros_arguments(words))
    except SystemExit as stop:
        return stop.code in (0, None)  # --help, --version
    return True


# --- help ---


@pytest.mark.parametrize("name", EVERY)
def test_help(name, capsys):
    assert import_module(EVERY[name]).main(["--help"]) == 0
    told = capsys.readouterr().out
    assert told.startswith(f"usage: {name} ") and "Traceback" not in told
    assert name in NODES or "examples:\n" in told


@pytest.mark.parametrize("name", COMMANDS)
def test_help_of_its_own_commands(name, capsys):
    for part in subcommands(parser_of(name)):
        assert import_module(COMMANDS[name]).main([part, "--help"]) == 0
        assert capsys.readouterr().out.startswith(f"usage: {name} {part} ")


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, words",
    [("ekf_node", [EVERY["ekf_node"]]), ("check", ["uwb_tdoa_tools.commands", "check"])],
)
def test_help_as_a_process(name, words):
    done = subprocess.run(
        [sys.executable, "-m", *words, "--help"], capture_output=True, text=True, timeout=600
    )
    assert (done.returncode, done.stderr) == (0, "") and done.stdout.startswith(f"usage: {name} ")


@pytest.mark.parametrize("words", [[], ["chek"], ["__main__"]])
def test_an_unknown_command_as_a_process_is_named(words):
    line = [sys.executable, "-m", "uwb_tdoa_tools.commands", *words]
    done = subprocess.run(line, capture_output=True, text=True, timeout=600)
    assert done.returncode == 1 and "expected one of: calibrate, check, " in done.stderr
    assert "Traceback" not in done.stderr


# --- examples and documentation ---


@pytest.mark.parametrize("name", COMMANDS)
def test_every_example_is_a_command_line(name):
    examples = parser_of(name).epilog.splitlines()[1:]
    assert examples
    for example in examples:
        words = shlex.split(example)
        assert parses(name, words[words.index(name) + 1 :]), example


def parameters(name):
    """Return the parameter names of a node, from its parameter file.

    The tests of the nodes check this file.
    """
    package = NODES[name].partition(".")[0]
    (content,) = yaml.safe_load(
        (ROOT / "src" / package / "config" / f"{name}.yaml").read_text()
    ).values()
    return set(content["ros__parameters"]).union(*map(parameters, MEMBERS.get(name, ())))


@pytest.fixture(scope="module")
def documented(tmp_path_factory):
    """Return [(page, executable, arguments)] of our commands in the documentation."""
    found = []
    for page in PAGES:
        for where, (first, *words) in commands(page, EVERY, tmp_path_factory.mktemp(page.stem)):
            if first in ("./dev", "ros2"):
                verb, *words = words
                if verb in ("topic", "node", "param") or (first, verb) == ("./dev", "ros2"):
                    found.append((where, "ros2", [verb, *words][first == "./dev" :]))
                elif (first, verb) == ("./dev", "demo"):
                    found.append((where, "demo", words))
                elif verb == "run":
                    assert words[0] == EVERY[words[1]].partition(".")[0], (where, words)
                    found.append((where, words[1], words[2:]))
                else:
                    assert verb in (
                        "test",
                        "build",
                        "shell",
                        "site",
                        "study",
                        "help",
                        "launch",
                        "bag",
                        "service",
                    ), (where, verb)
            elif first == "uwb-tdoa":
                if words != ["--completion"]:
                    assert words[0] in TOOLS, (where, words)
                    found.append((where, words[0], words[1:]))
            else:
                found.append((where, first, words))
    return found


def test_the_documentation_shows_every_executable(documented):
    assert {name for _, name, _ in documented} == {*EVERY, "ros2"}
    assert {name for where, name, _ in documented if where == "reference.md"} >= set(EVERY)
    assert len(documented) > 60


def test_every_documented_command_is_a_command_line(documented):
    for where, name, words in documented:
        if name in NODES:
            given = re.findall(r"-p (\w+):=", " ".join(words))
            assert (
                words[:1] == ["--ros-args"]
                and given
                and set(given) <= parameters(name) | {"use_sim_time"}
            ), (where, name, words)
        elif words:  # without arguments, it is the name of the executable in a sentence
            assert parses(name, words), (where, name, words)


FIRST_PAGES = "README.md", "guide.md", "reference.md"
CHEAP = ("check", "convert", "debias", "evaluate", "inject", "plan", "simulate")


@pytest.fixture
def hall(tmp_path, monkeypatch):
    """Return a working directory with simulated versions of the documented recordings."""
    monkeypatch.chdir(tmp_path)
    corners().to_yaml("anchors.yaml")
    for speed, name in (
        (1.0, "flight"),
        (0.8, "other"),
    ):  # the same radio: a map of another one would increase the error and not be written
        config = SimulationConfig(
            seed=4,
            duration=18.0,
            imu_rate=100.0,
            truth_rate=50.0,
            start_in_air=True,
            multipath=False,
            speed=speed,
        )
        write_bag(simulate(config), f"{name}.bag")
    shutil.copytree("flight.bag", "FLIGHT.log")
    Path("SURVEY.txt").symlink_to("anchors.yaml")
    return tmp_path


@pytest.mark.slow
def test_the_cheap_ones_of_the_first_pages_run(documented, hall, capsys):
    ran = []
    for where, name, words in documented:
        if (
            where in FIRST_PAGES
            and name in CHEAP
            and "--live" not in words
            and "flight3" not in words
        ):
            written = Path(words[words.index("--out") + 1]) if "--out" in words else None
            if written is not None and written.exists():
                words = [*words, "--force"]
            assert import_module(COMMANDS[name]).main(words) == 0, (
                name,
                words,
                capsys.readouterr().err,
            )
            ran.append(name)
    assert set(ran) == set(CHEAP)
    for name in ("simulate", "inject"):
        assert import_module(COMMANDS[name]).main(["--list"]) == 0


# --- interrupts ---


def installed(name):
    package = EVERY[name].partition(".")[0]
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        file = Path(prefix) / "lib" / package / name
        if prefix and file.is_file():
            return file
    pytest.skip("the workspace is not built and sourced")


HALT = """
import re, sys, time
class Halt:
    def find_spec(self, name, path=None, target=None):
        if re.fullmatch(r"numpy\\.version|yaml\\.error|rclpy\\.\\w+", name):
            print("importing", flush=True)
            time.sleep(600)
sys.meta_path.insert(0, Halt())
"""


@pytest.mark.parametrize("name", ["bias_node", "ekf_node", "evaluate"])
def test_an_interrupt_while_it_imports_is_quiet(name, tmp_path):
    """The interrupt comes during an import of a library, which the test blocks.

    One executable of each package is enough: all start in the same way (test_layout.py).
    """
    (tmp_path / "sitecustomize.py").write_text(HALT)
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")]),
    }
    process = subprocess.Popen(
        [sys.executable, installed(name)],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "importing\n"
    process.send_signal(signal.SIGINT)
    out, said = process.communicate(timeout=120)
    assert process.returncode == 130 and out == ""
    assert [line for line in said.splitlines() if line != f"{name}: starting"] == []
