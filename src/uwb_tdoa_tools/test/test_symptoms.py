"""docs/symptoms.md: every sentence that a node can say is there, and no sentence that no node says."""

import re

from documented import ROOT
from number_faults import FAULTS
import pytest
from spoken import rules, sentences

PAGE = (ROOT / "docs" / "symptoms.md").read_text()
TABLE = PAGE.partition("## What the nodes say\n")[2].partition("\n## ")[0]
LINES = [line for line in TABLE.splitlines() if line.startswith("| ")]
ROWS = [[cell.strip() for cell in line.strip("| ").split(" | ")] for line in LINES]
OTHERS = ("anchors:",)  # what is wrong with a survey comes from the one who reads it


def words(text):
    """Without quotes and what stands for values."""
    return re.sub(r"[\s'.,]+", " ", text).strip()


@pytest.mark.parametrize("sentence", sentences())
def test_what_a_node_says_is_on_the_page(sentence):
    assert any(words(sentence) in words(text) for text, *_ in ROWS), (
        f"docs/symptoms.md lacks {sentence!r}"
    )


def test_the_page_says_nothing_else():
    known = [words(sentence) for sentence in sentences()]
    for text, cause, remedy in ROWS[1:]:
        assert cause and remedy
        assert any(sentence in words(text) for sentence in known) or text.startswith(OTHERS), text


def test_every_finding_of_check_is_on_the_page_and_no_other():
    table = PAGE.partition("## What `check` finds\n")[2]
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| `")]
    named = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    of_numbers = {
        rule for fault in FAULTS.values() for rule in fault.rules
    }  # some rules are named after what they are of
    assert len(named) == len(set(named)) and set(named) == rules() | of_numbers


def test_the_reader_of_sentences_sees_some_of_each_node():
    files = set(sentences().values())
    assert {
        "health.py",
        "bias_node.py",
        "debias_node.py",
        "monitor.py",
        "volume.py",
        "outputs.py",
    } <= files
