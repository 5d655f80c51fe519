# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Every executable: its help, its examples, the commands of the pages, and Ctrl-C at the start."""

import argparse
from importlib import import_module
import os
from pathlib import Path
import re
import runpy
import shlex
import shutil
import signal

from documented import EXECUTABLES, NODES, ROOT, TOOLS, commands, main, of_pages
from programs import python, start
import pytest
import yaml

from uwb_tdoa_bias.common.errors import written_by
from uwb_tdoa_bias.effects import EFFECTS, EffectSet
from uwb_tdoa_tools import choices, cli, command_lines, main as uwb_tdoa
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.bags.files import PLUGINS
from uwb_tdoa_tools.diagnosis.references import REFERENCES
from uwb_tdoa_tools.flying.vehicle import WORLDS
from uwb_tdoa_tools.simulation import SimulationConfig, simulate
from uwb_tdoa_tools.simulation.config import CONSTELLATIONS, VEHICLE_DEFAULTS, corners
from uwb_tdoa_tools.simulation.vehicles import TRAJECTORIES

pytest.importorskip("uwb_tdoa_msgs.msg")

MEMBERS = {"localization_node": ("bias_node", "ekf_node")}  # it also takes their parameters
# modules that a command imports only for its work; together they take half a second or more
HEAVY = """PIL apsw jinja2 joblib llvmlite matplotlib numba onnx onnxruntime pandas rclpy rosbags scipy
    sklearn tqdm""".split()


def parser_of(name):
    if name == "ros2":  # of ./dev, with the same output as ROS 2
        return runpy.run_path(str(ROOT / ".dev" / "ros2.py"))["parser"]()
    return import_module(EXECUTABLES[name]).parser()


def assert_parses(name, words):
    """Parse a command line; the parser prints the error."""
    try:
        parser_of(name).parse_args(cli.without_ros_arguments(words))
    except SystemExit as stop:
        assert stop.code in (0, None), (name, words)  # --help, --version


# --- help ---


@pytest.mark.parametrize("name", EXECUTABLES)
def test_help_and_its_examples(name, capsys):
    assert main(name, ["--help"]) == 0
    assert capsys.readouterr().out.startswith(f"usage: {name} ")
    if name not in NODES:
        parser = parser_of(name)
        for example in map(shlex.split, parser.epilog.splitlines()[1:]):
            assert_parses(name, example[example.index(name) + 1 :])
        for action in parser._actions:
            for part in action.choices if isinstance(action, argparse._SubParsersAction) else ():
                assert main(name, [part, "--help"]) == 0
                assert capsys.readouterr().out.startswith(f"usage: {name} {part} ")


@pytest.mark.parametrize("name", uwb_tdoa.NAMES)
def test_help_of_uwb_tdoa(name, capsys, monkeypatch):
    monkeypatch.setenv(command_lines.RUN, "./dev run")  # the command changes it
    assert uwb_tdoa.main([]) == 0
    assert f"\n  {name} " in capsys.readouterr().out
    assert uwb_tdoa.main([name, "--help"]) == 0
    told = capsys.readouterr().out
    assert told.startswith(f"usage: uwb-tdoa {name} ") and f"\n  uwb-tdoa {name}" in told
    assert uwb_tdoa.main([name, "--version"]) == 0 and written_by() in capsys.readouterr().out
    assert uwb_tdoa.main([name, "--no-such"]) == uwb_tdoa.main(["chekc"]) == 2
    assert f"uwb-tdoa {name}: error: " in capsys.readouterr().err


def test_help_and_usage_errors_import_nothing_heavy():
    """One new process tests the public module, and then all parsers."""
    code = (
        "import contextlib, importlib, io, sys, uwb_tdoa\n"
        f"print(*sorted({{'numpy', *{HEAVY}}} & sys.modules.keys()))\n"
        f"for name in {list(TOOLS)}:\n"
        "    main = importlib.import_module(f'uwb_tdoa_tools.commands.{name}').main\n"
        "    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):\n"
        "        assert main(['--help']) == 0 and main(['--no-such-option']) == 2, name\n"
        f"    print(name, *sorted(set({HEAVY}) & sys.modules.keys()))\n"
    )
    done = python("-c", code)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.split() == list(TOOLS)


@pytest.mark.parametrize(
    "offered, known",
    [
        (choices.STORAGES, PLUGINS),
        (choices.REFERENCES, REFERENCES),
        (choices.TRAJECTORIES, TRAJECTORIES),
        (choices.CONSTELLATIONS, CONSTELLATIONS),
        (choices.CARRIERS, VEHICLE_DEFAULTS),
        (choices.WORLDS, WORLDS),
    ],
)
def test_options_offer_what_there_is(offered, known):
    assert offered == tuple(known)


@pytest.mark.parametrize(
    "words, offered",
    [
        (["ch"], ["check"]),
        ([""], list(uwb_tdoa.NAMES)),
        (["evaluate", "--sm"], ["--smooth"]),
        (["evaluate", "--align", "fr"], ["frame"]),
        (["check", "fli"], []),  # the shell completes files
    ],
)
def test_a_shell_completes_commands_options_and_values(words, offered):
    line = f"COMP_WORDS=(uwb-tdoa {shlex.join(words)}) COMP_CWORD={len(words)}\n_uwb_tdoa\n"
    script = f"{uwb_tdoa.completion()}\n{line}uwb-tdoa ${{COMPREPLY[@]}}"
    assert commands(script) == [["uwb-tdoa", *offered]]


@pytest.mark.parametrize(
    "called, tool, node, other",
    [
        ("uwb-tdoa", "uwb-tdoa check 'a b'", "ros2 run uwb_tdoa_ekf", "ros2 topic list"),
        ("", "ros2 run uwb_tdoa_tools check 'a b'", "ros2 run uwb_tdoa_ekf", "ros2 topic list"),
        (
            "./dev run",
            "./dev run uwb_tdoa_tools check 'a b'",
            "./dev run uwb_tdoa_ekf",
            "./dev ros2 topic list",
        ),
    ],
)
def test_lines_to_copy_have_the_form_of_the_call(called, tool, node, other, monkeypatch):
    monkeypatch.setenv(command_lines.RUN, called)
    if not called:
        monkeypatch.delenv(command_lines.RUN)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    assert command_lines.tool("check", "a b") == tool
    made = command_lines.node("ekf_node", {"x": 1}, ["p.yaml"])
    assert made == f"{node} ekf_node --ros-args -p x:=1 --params-file p.yaml"
    assert command_lines.as_it_runs("ros2 topic list") == other
    assert command_lines.as_it_runs("id -= 1") == "id -= 1"


# --- the pages ---


def parameters(name):
    """Return the parameter names of a node, from its file, which the tests of the node check."""
    file = ROOT / "src" / NODES[name].partition(".")[0] / "config" / f"{name}.yaml"
    (content,) = yaml.safe_load(file.read_text()).values()
    return set(content["ros__parameters"]).union(*map(parameters, MEMBERS.get(name, ())))


@pytest.fixture(scope="module")
def documented():
    """Return [(page, executable, arguments)] of our commands on all pages."""
    found = []
    for page, (program, *words) in of_pages():
        if program == "./dev" and words[0] == "ros2" or words[:1] in (["topic"], ["param"]):
            found.append((page, "ros2", words[program == "./dev" :]))
        elif program in ("./dev", "ros2") and words[0] == "run":
            assert words[1] == EXECUTABLES[words[2]].partition(".")[0], (page, words)
            found.append((page, words[2], words[3:]))
        elif program == "./dev" and words[0] == "demo":
            found.append((page, "demo", words[1:]))
        elif program == "uwb-tdoa" and words != ["--completion"]:
            found.append((page, words[0], words[1:]))
        elif program in EXECUTABLES:
            found.append((page, program, words))
    return found


def test_every_documented_command_is_a_command_line(documented):
    assert {name for _, name, _ in documented} == {*EXECUTABLES, "ros2"}
    for page, name, words in documented:
        if name in NODES:
            given = set(re.findall(r"-p (\w+):=", " ".join(words)))
            assert given <= parameters(name) | {"use_sim_time"}, (page, name, words)
        elif words:  # without arguments, it is the name of the executable in a sentence
            assert_parses(name, words)


# of the notebook, of measured flights, of live topics, of odometry, and long searches
OTHERS = re.compile("notebook|planning|DATA|FLIGHT(?!.log)|--live|--odometry")
CHEAP = ("check", "convert", "debias", "evaluate", "export", "inject", "plan", "simulate")


@pytest.mark.slow
def test_cheap_commands_of_the_pages_run(documented, tmp_path, monkeypatch, capsys):
    """All commands of these tools whose recordings are simulated here, or made by such a command."""
    monkeypatch.chdir(tmp_path)
    corners().to_yaml("anchors.yaml")
    settings = dict(duration=18.0, imu_rate=100.0, truth_rate=50.0, start_in_air=True)
    for speed, name in ((1.0, "flight_bag"), (0.8, "other_bag")):
        config = SimulationConfig(seed=4, multipath=False, speed=speed, **settings)
        write_bag(simulate(config), name)
    shutil.copytree("flight_bag", "FLIGHT.log")
    Path("SURVEY.txt").symlink_to("anchors.yaml")
    EffectSet((EFFECTS["anchor_delay"]({"3": 0.1}),)).to_yaml("effects.yaml")
    ran = {}
    for page, name, words in documented:
        inputs = [word for word in words if re.search(r"_bag$|\.(log|csv|yaml|npz|onnx)$", word)]
        out = words[words.index("--out") + 1] if "--out" in words else "none"
        there = all(Path(word).exists() for word in inputs if word != out)
        if name in CHEAP and there and words and not OTHERS.search(f"{page} {words}"):
            forced = [*words, "--force"] if out.endswith("_bag") else words
            line = (name, *words)
            if line not in ran:
                ran[line] = main(name, forced)
            assert ran[line] == 0, (page, line, capsys.readouterr().err)
    assert {name for name, *_ in ran} == set(CHEAP)


# --- interrupts ---

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

    One executable of each package is enough: all start in the same way (executables.py).
    """
    part = Path("lib", EXECUTABLES[name].partition(".")[0], name)
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    files = [Path(prefix, part) for prefix in prefixes if Path(prefix, part).is_file()]
    if not files:
        pytest.skip("the workspace is not built and sourced")
    (tmp_path / "sitecustomize.py").write_text(HALT)
    paths = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    process = start(files[0], env={**os.environ, "PYTHONPATH": paths})
    assert process.stdout.readline() == "importing\n"
    process.send_signal(signal.SIGINT)
    out, said = process.communicate(timeout=120)
    assert process.returncode == 130 and out == ""
    assert [line for line in said.splitlines() if line != f"{name}: starting"] == []
