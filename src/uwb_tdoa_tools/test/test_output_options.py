# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""No command writes through a link or overwrites its input."""

from importlib import import_module
import re

from documented import TOOLS, main
from output_attacks import ATTACKS, attack, content, outputs, parsers, place, unknown  # noqa: F401
import pytest

from uwb_tdoa_tools import cli
from uwb_tdoa_tools.cli import OutputBag, OutputFile, OutputFileInFolder, OutputFolder

PARSERS = {}
for _name, _module in TOOLS.items():
    PARSERS |= parsers((_name,), import_module(_module).parser())
OUTPUTS = [(words, action) for words, parser in PARSERS.items() for action in outputs(parser)]


@pytest.mark.parametrize("words", PARSERS, ids=" ".join)
def test_every_option_that_takes_a_path_is_an_output_or_read(words):
    assert unknown(PARSERS[words]) == []


def test_every_writing_command_is_tested():
    assert len(OUTPUTS) > 25 and {words[0] for words, _ in OUTPUTS} == {*TOOLS} - {"replay"}
    assert {action.type for _, action in OUTPUTS} == {*ATTACKS}


@pytest.mark.parametrize(
    ("words", "action"),
    OUTPUTS,
    ids=[f"{' '.join(words)} {action.dest}" for words, action in OUTPUTS],
)
def test_no_command_writes_through_a_link_or_over_what_it_reads(place, capsys, words, action):
    attack(lambda line: main(words[0], line), words, PARSERS[words], action, place, capsys)


@pytest.mark.parametrize("kind", [OutputFile, OutputFileInFolder, OutputFolder, OutputBag])
def test_other_places_can_be_written(place, kind):
    inputs = [str(place / "bag"), str(place / "flights" / "one.log"), "x" * 5000, 3, None]
    outs = ["new", "flights/new", "home/new"] + ["/dev/stdout"] * (kind is OutputFile)
    outs += ["no/new"] * (kind is OutputFileInFolder)
    for out in outs:
        parser = cli.parser("write", "Write.")
        parser.add_argument("--out", type=kind)
        parser.set_defaults(inputs=inputs)
        assert cli.run(lambda args: 0, parser, ["--out", str(place / out)]) == 0


@pytest.mark.parametrize(
    ("kind", "out", "said"),
    [
        (OutputFile, "/proc/out", "cannot be written .*: /proc"),  # fails for root, too
        (OutputFolder, "/proc/out", "cannot be written .*: /proc"),
        (OutputFolder, "file/out", "cannot be made, as .*file is a file"),
        (OutputFile, "home", "is a directory; give a file"),
        (OutputFile, "no/file", "its directory does not exist"),
        (OutputFileInFolder, "file/no/out", "cannot be made, as .*file is a file"),
    ],
)
def test_a_place_that_cannot_be_written_to_is_refused_before_the_work(
    place, capsys, kind, out, said
):
    before, parser = content(place), cli.parser("write", "Write.")
    parser.add_argument("--out", type=kind)
    assert cli.run(None, parser, ["--out", str(place / out)]) == 2
    assert re.search(said, capsys.readouterr().err) and content(place) == before
