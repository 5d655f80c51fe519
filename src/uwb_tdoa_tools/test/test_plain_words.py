# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The pages use plain words: short sentences, and none of the habits that confused readers."""

import re

from documented import PAGES, ROOT
import pytest

GUIDE = [page for page in PAGES if page.parent.name != "notebook"]
GUIDE += [ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md"]
HIGHEST_GRADE = 7.0  # largest Flesch-Kincaid grade of a page
LONGEST = 25  # words of a sentence
MOST = 0.05  # share of the sentences of a page that may be longer, or have a habit
FEW = 30  # with fewer sentences, two may
HABITS = re.compile(
    r"\b(told|tells?|telling|[Nn]obody|[Ss]omebody|anew|alike|beforehand|thereby|bears? out"
    r"|borne out|for want of|of its own|goes on|go on|(are|is) said|[Ww]hat (is|was|are|were|has)"
    r"|that of|those of|of what|of which|[Oo]ne (that|who|of))\b"
)
# Parts that are not prose: code, tables, headings, pictures, equations.
NO_PROSE = [
    re.compile(r"^```.*?^```$", re.MULTILINE | re.DOTALL),
    re.compile(r"^\s*\|.*$|^#.*$", re.MULTILINE),
    re.compile(r"!\[[^\]]*\]\([^)]*\)"),
    re.compile(r"\$\$.*?\$\$", re.DOTALL),
]
# Parts that count as one word or none: code, equations, numbers, file names, titles of papers.
WORDS = {
    r"\[([^\]]*)\]\([^)]*\)": r"\1",
    r"`[^`]*`|\$[^$\n]+\$": "code",
    r"\*[^*\n]+(\n[^*\n]+)?\*": "title",
    r"\b\w+\.(md|py|yaml|cff)\b": "page",
    r"\d+(\.\d+)+": "5",
    r"\be\.g\.": "for example",
    r"\bet al\.|\beqs?\.|\bch\.|\bS\. ": "",
    r"\*\*": "",
}


def prose(text):
    """Return the paragraphs and items of a page, each with an end of sentence."""
    for pattern in NO_PROSE:
        text = pattern.sub("", text)
    for pattern, instead in WORDS.items():
        text = re.sub(pattern, instead, text)
    blocks = (" ".join(one.split()) for one in re.split(r"\n\s*\n|\n\s*(?:[-*]|\d+\.) ", text))
    return [block if block[-1] in ".!?" else f"{block.rstrip(':;,')}." for block in blocks if block]


def sentences(text):
    return [one for block in prose(text) for one in re.split(r"(?<=[.:;!?])\s+", block)]


def hard(text):
    """Return the sentences of a page that are too long or have a habit."""
    return [one for one in sentences(text) if len(one.split()) > LONGEST or HABITS.search(one)]


@pytest.mark.parametrize("page", GUIDE, ids=lambda page: str(page.relative_to(ROOT)))
def test_few_sentences_are_hard(page):
    text = page.read_text()
    count = len(sentences(text))
    assert len(hard(text)) <= max(MOST * count, 2 if count < FEW else 0), hard(text)


@pytest.mark.parametrize("page", GUIDE, ids=lambda page: str(page.relative_to(ROOT)))
@pytest.mark.filterwarnings("ignore:pkg_resources")
def test_the_grade_of_a_page_is_low(page):
    textstat = pytest.importorskip("textstat", reason=".ci/requirements.lock installs it")
    assert textstat.flesch_kincaid_grade("\n".join(prose(page.read_text()))) <= HIGHEST_GRADE


def test_hard_sentences_are_found():
    long = "word " * 26
    text = (
        f"# What is it\n\n{long.strip()}.\n\nNobody reads `what is` this. It is read.\n\n| told |\n"
    )
    assert hard(text) == [f"{long.strip()}.", "Nobody reads code this."]
    textstat = pytest.importorskip("textstat", reason=".ci/requirements.lock installs it")
    assert textstat.flesch_kincaid_grade("Extraordinarily complicated formulations.") > 15.0
