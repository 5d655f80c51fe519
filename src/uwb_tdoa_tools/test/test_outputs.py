"""Attacks on what a command writes, over all commands and studies: no output follows a link, or changes an input. The list is made from
the registries, so that a new command and a new option are in it."""

import argparse
from importlib import import_module
from pathlib import Path
import re
import sys

from documented import ROOT
import pytest
from uwb_tdoa_tools import cli
from uwb_tdoa_tools.outputs import Output, OutputBag, OutputFile, OutputFolder

sys.path.append(str(ROOT))  # for studies
from studies import __main__ as studies  # noqa: E402

NAMES = sorted(re.findall(r"uwb_tdoa_tools\.executables:(\w+)", (ROOT / "src" / "uwb_tdoa_tools" / "setup.py").read_text()))
COMMANDS = [name for name in NAMES if not name.endswith("_node")]  # a node writes no file
READ = set(  # options and arguments that name what is read, or no path at all
    """flights flight input bag map anchors survey effects config model peer marks distances holdout odometry beside antenna walls places
    static data diagnosed trained train test cases columns seed names""".split()
)
NUMBERS = "int", "float", "whole_number"  # names of types of options
PATHS = re.compile("FILE|DIR|BAG|LOG|CSV|MAP|FLIGHT|IN$|S$|ANCHORS|LIBRARY|DATA|DIRECTORY|FOLDER")


def parsers():
    """{words: parser} of every command that has options of its own."""
    found = {}

    def add(words, parser):
        inner = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
        if not inner:
            found[words] = parser
        for name, one in inner[0].choices.items() if inner else ():
            add((*words, name), one)

    for name in COMMANDS:
        add((name,), import_module(f"uwb_tdoa_tools.commands.{name}").parser())
    add(("study",), studies.parser())
    return found


PARSERS = parsers()
OUTPUTS = [(words, action) for words, parser in PARSERS.items() for action in parser._actions if isinstance(action.type, type) and issubclass(action.type, Output)]


def test_every_option_that_takes_a_path_is_an_output_or_read():
    unknown = []
    for words, parser in PARSERS.items():
        for action in parser._actions:
            metavar = action.metavar if isinstance(action.metavar, str) else ""
            if action.nargs != 0 and PATHS.match(metavar) and getattr(action.type, "__name__", "") not in NUMBERS:
                unknown += [(*words, action.dest)] if (action.dest in READ) == ((words, action) in OUTPUTS) else []
    assert unknown == []


def test_all_that_write_are_there():
    assert len(OUTPUTS) > 45 and {words[0] for words, _ in OUTPUTS} == {*COMMANDS, "study"} - {"replay"}
    assert {action.type for _, action in OUTPUTS} == {OutputFile, OutputFolder, OutputBag}


@pytest.fixture
def place(tmp_path):
    """A folder with recordings, a bag, a file, and links to what is precious."""
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


LINKS = [("link", "is a link to {0}/home/bashrc"), ("to nothing", "is a link to {0}/home/new"), ("to a folder", "is a link to {0}/home")]
ATTACKS = {  # [(output, what is read, what is said)]
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
}  # fmt: skip


def line(words, attacked, out, read):
    """A command line with an output and, where there is an option for it, what is read; None where there is none."""
    parser, line, reads = PARSERS[words], [], read is None
    for action in parser._actions:
        own = getattr(action.type, "__name__", "")
        if action is attacked:
            values = [out]
        elif not reads and action.dest in READ and action.nargs != 0 and not action.choices and own not in NUMBERS:
            values, reads = [read] * (action.nargs if isinstance(action.nargs, int) else 1), True
        elif action.required and isinstance(action.type, type) and issubclass(action.type, Output):
            values = [Path(out).parent / "other"]
        elif action.required and action.nargs != "*":
            values = [next(iter(action.choices)) if action.choices else "1" if own in NUMBERS else "nowhere"]
        else:
            continue
        line += [*action.option_strings[:1], *map(str, values)]
    forced = ["--force"] if any("--force" in action.option_strings for action in parser._actions) else []
    return [*words[1:], *forced, *line] if reads else None


def content(folder):
    return {path: path.read_bytes() if path.is_file() else path.is_dir() for path in folder.rglob("*")}


@pytest.mark.parametrize(("words", "action"), OUTPUTS, ids=[f"{' '.join(words)} {action.dest}" for words, action in OUTPUTS])
def test_no_command_writes_through_a_link_or_over_what_it_reads(place, capsys, monkeypatch, words, action):
    module, before = studies if words[0] == "study" else import_module(f"uwb_tdoa_tools.commands.{words[0]}"), content(place)
    if words[0] == "study":
        whole = studies.parser()
        monkeypatch.setattr(studies, "parser", lambda: whole)  # made once
    for out, read, said in ATTACKS[action.type]:
        arguments = line(words, action, place / out, read and place / read)
        if arguments is not None:
            assert module.main(arguments) == 2, (out, read)
            err = capsys.readouterr().err
            assert said.format(place) in err and "usage:" not in err, (out, read)
            assert content(place) == before, (out, read)


@pytest.mark.parametrize("kind", [OutputFile, OutputFolder, OutputBag])
def test_other_places_are_no_inputs(place, kind):
    inputs = [str(place / "bag"), str(place / "flights" / "one.log"), "x" * 5000, 3, None]
    for out in ("new", "flights/new", "home/new"):
        parser = cli.parser("write", "Write.")
        parser.add_argument("--out", type=kind)
        parser.set_defaults(inputs=inputs)
        assert cli.run(lambda args: 0, parser, ["--out", str(place / out)]) == 0


def test_standard_output_is_a_file():
    parser = cli.parser("write", "Write.")
    parser.add_argument("--json", type=OutputFile)
    assert cli.run(lambda args: 0, parser, ["--json", "/dev/stdout"]) == 0


@pytest.mark.parametrize(
    ("kind", "out", "said"),
    [
        (OutputFile, "/proc/out", "cannot be written .*: /proc"),  # for root, too
        (OutputFolder, "/proc/out", "cannot be written .*: /proc"),
        (OutputFolder, "file/out", "cannot be made, as .*file is a file"),
        (OutputFile, "home", "is a directory; give a file"),
        (OutputFile, "no/file", "its directory does not exist"),
    ],
)
def test_a_place_that_cannot_be_written_to_is_refused_before_the_work(place, capsys, kind, out, said):
    before, parser = content(place), cli.parser("write", "Write.")
    parser.add_argument("--out", type=kind)
    assert cli.run(None, parser, ["--out", str(place / out)]) == 2
    assert re.search(said, capsys.readouterr().err) and content(place) == before
