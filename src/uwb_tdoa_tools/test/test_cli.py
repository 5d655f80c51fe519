# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import errno
import sqlite3

from programs import start
import pytest

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_tools import cli


def make_parser():
    parser = cli.parser("weigh", "Weigh things.\n\nSecond paragraph.", "weigh 3", "weigh 4 --twice")
    parser.add_argument("number", type=int)
    return parser


def test_help_keeps_line_breaks_and_shows_examples_as_they_run(capsys, monkeypatch):
    monkeypatch.setenv("UWB_TDOA_RUN", "./dev run")
    assert cli.run(None, make_parser(), ["--help"]) == 0
    out = capsys.readouterr().out
    assert "Weigh things.\n\nSecond paragraph." in out
    assert (
        "examples:\n  ./dev run uwb_tdoa_tools weigh 3\n  ./dev run uwb_tdoa_tools weigh 4 "
        "--twice\n"
    ) in out


@pytest.mark.parametrize("returned, code", [(None, 0), (0, 0), (1, 1)])
def test_exit_code_is_what_the_command_returned(returned, code):
    seen = []

    def command(args):
        seen.append(args.number)
        return returned

    assert cli.run(command, make_parser(), ["7"]) == code
    assert seen == [7]


def test_bad_usage_is_two(capsys):
    assert cli.run(None, make_parser(), ["seven"]) == 2
    assert "weigh: error: argument number" in capsys.readouterr().err


@pytest.mark.parametrize(
    "error, sentence",
    [
        (
            InputError("number: 7 is too heavy; give at most 6."),
            "number: 7 is too heavy; give at most 6.",
        ),
        (
            FileNotFoundError(2, "No such file or directory", "scale.csv"),
            "scale.csv: No such file or directory.",
        ),
    ],
)
def test_bad_input_is_one_sentence_and_two(error, sentence, capsys):
    def command(args):
        raise error

    assert cli.run(command, make_parser(), ["7"]) == 2
    assert capsys.readouterr().err == f"weigh: error: {sentence}\n"


def test_interrupt_is_130():
    def command(args):
        raise KeyboardInterrupt

    assert cli.run(command, make_parser(), ["7"]) == 130


def test_a_defect_keeps_its_traceback():
    def command(args):
        raise OSError("no file in it: not the user's doing")

    with pytest.raises(OSError, match="not the user's"):
        cli.run(command, make_parser(), ["7"])


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOSPC, "No space left on device"),
        OSError(errno.ENOSPC, "No space left on device", "out.csv"),
        sqlite3.OperationalError("database or disk is full"),
    ],
)
def test_a_full_disk_is_one_sentence(error, capsys):
    def command(args):
        raise error

    assert cli.run(command, make_parser(), ["7"]) == 2
    assert capsys.readouterr().err == (
        "weigh: error: the disk is full: what was being written is not whole; make room, or "
        "write elsewhere.\n"
    )


def test_a_long_sentence_is_cut(capsys):
    cli.say("weigh", "9" * 1_000_000 + "; give a shorter one.")
    err = capsys.readouterr().err
    assert len(err) < 3000 and err.endswith("; give a shorter one.\n")


def test_a_closed_pipe_is_no_traceback():
    code = (
        "import sys; from uwb_tdoa_tools import cli;"
        "sys.exit(cli.run(lambda args: print('line\\n' * 100000), cli.parser('talk', 'Talk.'), []))"
    )
    talk = start("-c", code)
    talk.stdout.read(10)
    talk.stdout.close()
    err = talk.stderr.read()
    talk.stderr.close()
    assert (talk.wait(timeout=60), err) == (141, "")
