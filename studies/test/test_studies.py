# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""All studies: their help, their examples, and the commands that the documentation shows."""

import shlex

from documented import PAGES, commands
import pytest

from studies.__main__ import STUDIES, main, parser


def parses(words):
    """Whether the words are a valid command line. Prints the error if not."""
    try:
        parser().parse_args(words)
    except SystemExit as stop:
        return stop.code == 0
    return True


@pytest.mark.parametrize("words", [[], *([name] for name in STUDIES)], ids=" ".join)
def test_help(words, capsys):
    assert main([*words, "--help"]) == 0
    assert capsys.readouterr().out.startswith(" ".join(["usage: study", *words]))


def test_every_example_is_a_command_line_and_every_study_has_one():
    examples = [shlex.split(line) for line in parser().epilog.splitlines()[1:]]
    assert {name for _, _, name, *_ in examples} == set(STUDIES)
    for begin, verb, *words in examples:
        assert (begin, verb) == ("./dev", "study") and parses(words), words


@pytest.fixture(scope="module")
def documented(tmp_path_factory):
    """[(page, words)] of the studies in the documentation."""
    shown = [
        found for page in PAGES for found in commands(page, (), tmp_path_factory.mktemp(page.stem))
    ]
    return [
        (page, words[2:]) for page, words in shown if words[:2] == ["./dev", "study"] and words[2:]
    ]


def test_the_documentation_shows_every_study(documented):
    assert {words[0] for _, words in documented} == set(STUDIES)


def test_every_documented_study_is_a_command_line(documented):
    for page, words in documented:
        assert parses(words), (page, words)
