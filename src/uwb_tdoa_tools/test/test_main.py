# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The command `uwb-tdoa`: its help, its subcommands, and its completion in a shell."""

import shutil
import subprocess

import pytest

from uwb_tdoa_bias.common.text import written_by
from uwb_tdoa_tools import cli, command_lines, main


@pytest.fixture(autouse=True)
def restored(monkeypatch):
    monkeypatch.setenv(command_lines.RUN, "./dev run")  # the command changes it


def test_help_lists_every_command(capsys):
    for words in ([], ["--help"]):
        assert main.main(words) == 0
        told = capsys.readouterr().out
        assert told.startswith("usage: uwb-tdoa COMMAND ...")
        for name in main.NAMES:
            (line,) = (line for line in told.splitlines() if line.startswith(f"  {name} "))
            assert line.endswith(".")
    assert main.main(["--version"]) == 0
    assert capsys.readouterr().out == f"uwb-tdoa of {written_by()}\n"


def test_an_unknown_command_is_bad_usage(capsys):
    assert main.main(["chekc"]) == 2
    assert "uwb-tdoa: error: argument COMMAND: invalid choice: 'chekc'" in capsys.readouterr().err


@pytest.mark.parametrize("name", main.NAMES)
def test_a_command_has_its_own_help(name, capsys):
    assert main.main([name, "--help"]) == 0
    told = capsys.readouterr().out
    assert told.startswith(f"usage: uwb-tdoa {name} ") and f"\n  uwb-tdoa {name}" in told
    assert "ros2 run" not in told and "./dev run" not in told


def test_a_command_gets_its_words_and_its_errors_name_it(capsys):
    assert main.main(["check", "no-such-flight.bag"]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("uwb-tdoa check: error: no-such-flight.bag: does not exist")


@pytest.mark.parametrize(
    "called, tool, node",
    [
        ("uwb-tdoa", "uwb-tdoa check a.bag", "ros2 run uwb_tdoa_ekf ekf_node --ros-args -p x:=1"),
        (None, "ros2 run uwb_tdoa_tools check a.bag", "ros2 run uwb_tdoa_ekf ekf_node --ros-args"),
        ("./dev run", "./dev run uwb_tdoa_tools check a.bag", "./dev run uwb_tdoa_ekf ekf_node"),
    ],
)
def test_next_steps_have_the_form_of_the_call(called, tool, node, monkeypatch):
    if called is None:
        monkeypatch.delenv(command_lines.RUN)  # set by the fixture
    else:
        monkeypatch.setenv(command_lines.RUN, called)
    assert command_lines.tool("check", "a.bag") == tool
    assert command_lines.node("ekf_node", {"x": 1}).startswith(node)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    dev = called == "./dev run"
    line = "ros2 topic list"
    assert command_lines.as_it_runs(line) == (f"./dev {line}" if dev else line)
    prog = cli.parser("check", "Check.", "check a.bag")
    assert f"  {tool}" in prog.format_help()


@pytest.fixture(scope="module")
def completed():
    """Return the completions that bash offers for the last word of completed(word, ...)."""
    completion = main.completion()

    def offered(*words):
        line = " ".join(f"'{word}'" for word in words)
        script = (
            f"{completion}\ncomplete -p uwb-tdoa >/dev/null || exit 1\n"
            f"COMP_WORDS=({line}) COMP_CWORD={len(words) - 1}\n"
            '_uwb_tdoa; echo "${COMPREPLY[@]}"'
        )
        done = subprocess.run(["bash", "--norc", "-c", script], capture_output=True, text=True)
        assert (done.returncode, done.stderr) == (0, "")
        return done.stdout.split()

    return offered


def test_a_shell_completes_commands_options_and_values(completed):
    assert completed("uwb-tdoa", "ch") == ["check"]
    assert completed("uwb-tdoa", "") == list(main.NAMES)
    assert completed("uwb-tdoa", "evaluate", "--sm") == ["--smooth"]
    assert completed("uwb-tdoa", "evaluate", "--align", "") == ["none", "time", "frame"]
    assert completed("uwb-tdoa", "evaluate", "--align", "fr") == ["frame"]
    assert "--holdout" in completed("uwb-tdoa", "debias", "--")  # options of its subcommands, too
    assert completed("uwb-tdoa", "check", "fli") == []  # the shell completes files
