# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Command lines that are printed to be copied.

Each runs unchanged, and reduces the error where it promises that.
"""

import ast
from dataclasses import replace
from functools import cache
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
import re
import shlex

from documented import ROOT
import numpy as np
import pytest

from uwb_tdoa_bias.common.survey import read_survey
from uwb_tdoa_bias.effects import EffectSet
from uwb_tdoa_ekf.core.config import FilterConfig
from uwb_tdoa_ekf.monitoring.finding import Finding
from uwb_tdoa_tools import command_lines, diagnosis
from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.calibrating import between
from uwb_tdoa_tools.checking import report
from uwb_tdoa_tools.commands import diagnose, evaluate, survey
from uwb_tdoa_tools.evaluating import Evaluator
from uwb_tdoa_tools.readers.inputs import Reading

READS = {
    "anchors_file": read_survey,
    "effects_file": EffectSet.from_yaml,
    "--params-file": FilterConfig.from_yaml,
}
LINE = re.compile(r"\./dev run uwb_tdoa_\w+ .*$", re.MULTILINE)


@pytest.fixture
def desk(tmp_path, monkeypatch):
    """Return a working directory, with the settings of ./dev run."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv(command_lines.RUN, "./dev run")
    return tmp_path


def lines_of(text):
    """Return the command lines in printed text, with wrapped lines joined."""
    return [line.strip() for line in LINE.findall(re.sub(r"\n {10}(?! )", " ", text))]


def run(line):
    """Run a line unchanged. For a node, read its files instead."""
    (dev, verb, package, name, *words) = shlex.split(line)
    assert (dev, verb) == ("./dev", "run")
    if name.endswith("_node"):
        assert words[0] == "--ros-args" and package == command_lines.PACKAGES[name]
        for option, value in zip(words[1::2], words[2::2]):
            parameter, _, file = value.partition(":=") if option == "-p" else (option, "", value)
            READS[parameter](Path(file))
        return
    assert package == "uwb_tdoa_tools"
    assert import_module(f"uwb_tdoa_tools.commands.{name}").main(words) == 0, line


def test_lines_are_quoted_and_begin_as_the_user_began(monkeypatch):
    monkeypatch.delenv(command_lines.RUN, raising=False)
    assert (
        command_lines.tool("check", "a flight.bag")
        == "ros2 run uwb_tdoa_tools check 'a flight.bag'"
    )
    monkeypatch.setenv(command_lines.RUN, "../dev run")
    assert command_lines.node("ekf_node", {"effects_file": "e.yaml"}, ["p.yaml"]) == (
        "../dev run uwb_tdoa_ekf ekf_node --ros-args -p effects_file:=e.yaml --params-file p.yaml"
    )


def test_remedies_begin_as_the_user_began(monkeypatch):
    monkeypatch.setenv(command_lines.RUN, "./dev run")
    monkeypatch.setattr(command_lines.shutil, "which", lambda name: None)
    for line, runs in (
        ("ros2 topic hz imu/data", "./dev ros2 topic hz imu/data"),
        (
            "record a minute in which the tag is carried",
            "record a minute in which the tag is carried",
        ),
        ("id -= 1", "id -= 1"),
    ):
        assert command_lines.as_it_runs(line) == runs
        assert (
            list(report.lines(Finding("rule", "error", "cause", "evidence", line, 0.0)))[2]
            == f"      remedy: {runs}"
        )
    monkeypatch.delenv(command_lines.RUN)
    assert command_lines.as_it_runs("ros2 topic hz imu/data") == "ros2 topic hz imu/data"


# --- all that any tool or node may print: from the sources ---

PACKAGES = [
    ROOT / "src" / name / name for name in ("uwb_tdoa_bias", "uwb_tdoa_ekf", "uwb_tdoa_tools")
]
TOOLS = tuple(path.stem for path in (PACKAGES[2] / "commands").glob("[a-z]*.py"))
# Modules whose printed lines are run: below, and in test_first_hour_without_truth.py, test_demo.py
# and test_first_map.py
PRINT = {
    *(f"commands/{name}.py" for name in ("calibrate", "diagnose", "map_anchors", "survey")),
    "flying/demo.py",
}


@cache
def sources():
    """Return [(name, syntax tree)] of all installed modules."""
    paths = [
        (path.relative_to(package).as_posix(), path)
        for package in PACKAGES
        for path in package.rglob("*.py")
    ]
    return [(name, ast.parse(path.read_text())) for name, path in paths]


def texts(tree):
    """Yield the strings of a module that may be printed, with "value" for each inserted value.

    Docstrings and the examples of --help are left out. These examples start with the command prefix
    of the user.
    """
    passed = {
        id(part)
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and "parser" in ast.unparse(node.func)
        for part in ast.walk(node)
    }
    inside = {
        id(part)
        for node in ast.walk(tree)
        if isinstance(node, ast.JoinedStr)
        for part in node.values
    }
    for node in ast.walk(tree):
        if id(node) in passed | inside:
            continue
        if isinstance(node, ast.JoinedStr):
            yield "".join(
                part.value if isinstance(part, ast.Constant) else "value" for part in node.values
            )
        elif (
            isinstance(node, ast.Constant)
            and isinstance(node.value, str)
            and not node.value.startswith("\n")
        ):
            yield node.value


def test_whoever_prints_lines_to_copy_is_tested_here():
    made = {
        name
        for name, tree in sources()
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and getattr(node.value, "id", "") == "command_lines"
        and node.attr in ("tool", "node", "node_lines", "evaluate_line", "lines_of_use")
    }
    assert made == PRINT


@pytest.mark.slow
def test_no_text_is_a_command_that_does_not_run_as_it_stands():
    """A command that begins like ROS must run with ./dev ros2, too.

    It must have no gap for the user to fill.
    """
    pytest.importorskip("rclpy")
    spec = spec_from_file_location("dev_ros2", ROOT / ".dev" / "ros2.py")
    ros2 = module_from_spec(spec)
    spec.loader.exec_module(ros2)
    found = [(name, text) for name, tree in sources() for text in texts(tree)]
    commands = [
        (name, text)
        for name, text in found
        if re.match(r"(ros2|\./dev) \w+ \S|(" + "|".join(TOOLS) + r") (?:\S*[./]\S* )*--\w", text)
    ]
    assert len(commands) >= 3
    for name, text in commands:
        line, *_ = text.split("  #")
        begin, *words = shlex.split(line)
        assert begin == "ros2" and not any(re.fullmatch("[A-Z]{3,}", word) for word in words), (
            name,
            text,
        )
        assert ros2.parser().parse_args(words), (name, text)


@pytest.mark.slow
def test_every_line_that_diagnose_prints_runs_as_it_stands(diagnosed, desk, capsys, monkeypatch):
    """The working directory is not --out, and the survey and the parameters are in files."""
    monkeypatch.setattr(diagnosis, "diagnose", lambda *_: diagnosed)
    (flight,) = diagnosed.flights
    flight.anchors.to_yaml("tape.yaml")
    write_bag(flight, "a flight.bag")
    words = ["a flight.bag", "--survey", "tape.yaml", "--without", "height", "--out", "made/in"]
    assert diagnose.main(words) == 0
    lines = lines_of(capsys.readouterr().out)
    assert len(lines) == 3
    for line in lines:
        assert "made/in/effects.yaml" in line and ("ekf_node.yaml" in line or "bias_node" in line)
        run(line)


@pytest.mark.slow
def test_the_line_that_survey_prints_makes_the_error_of_a_measured_flight_smaller(
    desk, shared_data, capsys, monkeypatch
):
    """The working directory is not --out. A file and the second bag hold anchors with tape errors.

    The line runs as it stands, and then with the second flight.
    """
    for trial in (1, 2):
        flight = Reading(shared_data / "surveys").one(
            shared_data / "util" / f"const1-trial{trial}-tdoa2.csv.gz"
        )
        flight = between(flight, flight.tdoa.t[0], flight.tdoa.t[0] + 45.0)
        tape = 0.1 * np.random.default_rng(100).standard_normal(flight.anchors.positions.shape)
        taped = flight.anchors.at(flight.anchors.positions + tape)
        write_bag(flight if trial == 1 else replace(flight, anchors=taped), f"flight {trial}.bag")
    taped.to_yaml("tape.yaml")
    assert survey.main(["flight 1.bag", "--survey", "tape.yaml", "--out", "made/in"]) == 0
    (line,) = lines_of(capsys.readouterr().out)
    assert "made/in/effects.yaml" in line and "ekf_node.yaml" in line
    run(line)
    errors = []
    judge = Evaluator.__call__
    monkeypatch.setattr(
        Evaluator, "__call__", lambda self, one: errors.append(judge(self, one)) or errors[-1]
    )
    words = shlex.split(line.replace("flight 1.bag", "flight 2.bag"))[4:]
    assert evaluate.main(["flight 2.bag"]) == evaluate.main(words) == 0
    before, after = (one.row["rmse_3d"] for one in errors)
    assert after < 0.7 * before
    assert (
        "made/in/anchors.yaml count here, whatever anchors the bag holds" in capsys.readouterr().err
    )
