# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""No study writes through a link, or over what it reads."""

from output_attacks import attack, outputs, parsers, place, unknown  # noqa: F401
import pytest

from studies import __main__ as studies

PARSER = studies.parser()
PARSERS = parsers(("study",), PARSER)
OUTPUTS = [(words, action) for words, parser in PARSERS.items() for action in outputs(parser)]


def test_every_option_that_takes_a_path_is_an_output_or_read():
    assert {
        words: unknown(parser) for words, parser in PARSERS.items() if unknown(parser)
    } == {} and len(OUTPUTS) > 15


@pytest.mark.parametrize(
    ("words", "action"),
    OUTPUTS,
    ids=[f"{' '.join(words[1:])} {action.dest}" for words, action in OUTPUTS],
)
def test_no_study_writes_through_a_link_or_over_what_it_reads(
    place, capsys, monkeypatch, words, action
):  # noqa: F811
    monkeypatch.setattr(studies, "parser", lambda: PARSER)  # made once
    attack(studies.main, words, PARSERS[words], action, place, capsys)
