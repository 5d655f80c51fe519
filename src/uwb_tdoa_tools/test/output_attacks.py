# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Attacks on the outputs of commands: links, inputs and parts of bags in place of an output."""

import argparse
from pathlib import Path
import re

import pytest

from uwb_tdoa_tools.cli import Output, OutputBag, OutputFile, OutputFileInFolder, OutputFolder

READ = set(  # options and arguments that name inputs, or no path
    """flights flight input bag map anchors areas survey effects config model peer marks distances holdout odometry beside antenna
    walls places poses coordinates static data columns seed names firmware build""".split()
)
NUMBERS = "int", "float", "positive", "whole_number"  # names of option types
PATHS = re.compile("FILE|DIR|BAG|LOG|CSV|MAP|FLIGHT|IN$|S$|ANCHORS|LIBRARY|DATA|DIRECTORY|FOLDER")


def parsers(words, parser):
    """Return {words: parser} of each command of an ArgumentParser, without groups of commands."""
    inner = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not inner:
        return {words: parser}
    return {
        more: found
        for name, one in inner[0].choices.items()
        for more, found in parsers((*words, name), one).items()
    }


def outputs(parser):
    """Return the options of a parser that name outputs."""
    return [
        action
        for action in parser._actions
        if isinstance(action.type, type) and issubclass(action.type, Output)
    ]


def unknown(parser):
    """Return the names of path options that are neither outputs nor in READ, or are both."""
    found = []
    for action in parser._actions:
        metavar = action.metavar if isinstance(action.metavar, str) else ""
        if (
            action.nargs != 0
            and PATHS.match(metavar)
            and getattr(action.type, "__name__", "") not in NUMBERS
        ):
            found += [action.dest] if (action.dest in READ) == (action in outputs(parser)) else []
    return found


@pytest.fixture
def place(tmp_path):
    """Return a folder with recordings, a bag, a file, and links to other files.

    Everything in it must stay unchanged.
    """
    bag, flights, home = tmp_path / "bag", tmp_path / "flights", tmp_path / "home"
    for folder in (bag, flights, home, tmp_path / "holds", tmp_path / "linked"):
        folder.mkdir()
    (bag / "metadata.yaml").write_text("precious")
    (bag / "one.mcap").write_text("precious")
    (flights / "one.log").write_text("precious")
    (home / "bashrc").write_text("precious")
    (tmp_path / "file").write_text("precious")
    (tmp_path / "hard").hardlink_to(tmp_path / "file")
    (tmp_path / "link").symlink_to(home / "bashrc")
    (tmp_path / "to nothing").symlink_to(home / "new")
    (tmp_path / "to a folder").symlink_to(home)
    (tmp_path / "holds" / "read.log").write_text("precious")
    (tmp_path / "linked" / "anchors.yaml").symlink_to(home / "bashrc")
    return tmp_path


LINKS = [
    ("link", "is a link to {0}/home/bashrc"),
    ("to nothing", "is a link to {0}/home/new"),
    ("to a folder", "is a link to {0}/home"),
]
ATTACKS = {  # [(output, input or None, error message)]
    OutputFile: [
        *((name, None, said) for name, said in LINKS),
        ("file", "file", "{0}/file: is {0}/file, which is read"),
        ("flights/../file", "file", "is {0}/file, which is read"),
        ("hard", "file", "{0}/hard: is {0}/file, which is read"),
        ("bag/metadata.yaml", "bag", "lies in {0}/bag, which is read"),
        ("bag/new.json", "bag", "lies in {0}/bag, which is read"),
        ("bag/new.json", None, "would change the bag {0}/bag"),
        ("flights/one.log", "flights", "lies in {0}/flights, which is read"),
    ],
    OutputFolder: [
        *((name, None, said) for name, said in LINKS),
        ("linked", None, "{0}/linked/anchors.yaml: is a link to {0}/home/bashrc"),
        ("bag", "bag", "{0}/bag: is {0}/bag, which is read"),
        ("bag/new", "bag", "lies in {0}/bag, which is read"),
        ("bag/new", None, "would change the bag {0}/bag"),
        ("flights", "flights", "is {0}/flights, which is read"),
        ("holds", "holds/read.log", "is {0}/holds/read.log, which is read"),
        ("file", "file", "is {0}/file, which is read"),
    ],
    OutputBag: [
        *((name, None, said) for name, said in LINKS),
        ("bag", "bag", "{0}/bag: is {0}/bag, which is read"),
        ("bag/new", "bag", "lies in {0}/bag, which is read"),
        ("flights", "flights", "is {0}/flights, which is read"),
        ("flights/one.log", "flights", "lies in {0}/flights, which is read"),
    ],
}
ATTACKS[OutputFileInFolder] = ATTACKS[OutputFile]


def line(words, parser, attacked, out, read):
    """Return a command line with an output and, if given, an input.

    Returns None if the command has no option for the input.
    """
    line, reads = [], read is None
    for action in parser._actions:
        own = getattr(action.type, "__name__", "")
        if action is attacked:
            values = [out]
        elif (
            not reads
            and action.dest in READ
            and action.nargs != 0
            and not action.choices
            and own not in NUMBERS
        ):
            values, reads = [read] * (action.nargs if isinstance(action.nargs, int) else 1), True
        elif action.required and isinstance(action.type, type) and issubclass(action.type, Output):
            values = [Path(out).parent / "other"]
        elif action.required and action.nargs != "*":
            values = [
                next(iter(action.choices))
                if action.choices
                else "1"
                if own in NUMBERS
                else "nowhere"
            ]
        else:
            continue
        line += [*action.option_strings[:1], *map(str, values)]
    forced = (
        ["--force"] if any("--force" in action.option_strings for action in parser._actions) else []
    )
    return [*words[1:], *forced, *line] if reads else None


def content(folder):
    return {
        path: path.read_bytes() if path.is_file() else path.is_dir() for path in folder.rglob("*")
    }


def attack(main, words, parser, action, place, capsys):
    """Attack an output of a command in the folder `place`.

    The command must refuse each attack and change nothing. main : callable(arguments)
    """
    before = content(place)
    for out, read, said in ATTACKS[action.type]:
        arguments = line(words, parser, action, place / out, read and place / read)
        if arguments is not None:
            assert main(arguments) == 2, (out, read)
            err = capsys.readouterr().err
            assert said.format(place) in err and "usage:" not in err, (out, read)
            assert content(place) == before, (out, read)
