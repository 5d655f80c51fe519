# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Every page: links lead somewhere, lists of pages are complete, and sentences are short."""

import re

from documented import PAGES, ROOT
import pytest

LINK = re.compile(r"\]\(([^)\s]+)\)|(?:src|href)=\"([^\"]+)\"")
GUIDE = [page for page in PAGES if page.parent.name != "notebook"]
GUIDE += [ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md"]
LONGEST = 25  # words of a sentence
MOST = 0.05  # share of the sentences of a page that may be longer, or have a habit
FEW = 30  # with fewer sentences, two may
HABITS = re.compile(  # that confused readers
    r"\b(told|tells?|telling|[Nn]obody|[Ss]omebody|anew|alike|beforehand|thereby|bears? out"
    r"|borne out|for want of|of its own|goes on|go on|(are|is) said|[Ww]hat (is|was|are|were|has)"
    r"|that of|those of|of what|of which|[Oo]ne (that|who|of))\b"
)
# Code, tables, headings, pictures and equations are not prose. Links count by their text. Code in
# a sentence, equations, titles, file names and numbers count as one word.
NO_PROSE = re.compile(
    r"^```.*?^```$|\$\$.*?\$\$|^\s*\|[^\n]*$|^#[^\n]*$|!\[[^\]]*\]\([^)]*\)|\*\*"
    r"|\bet al\.|\beqs?\.|\bch\.|\bS\. ",
    re.MULTILINE | re.DOTALL,
)
WORD = re.compile(
    r"`[^`]*`|\$[^$\n]+\$|\*[^*\n]+(\n[^*\n]+)?\*|\b\w+\.(md|py|yaml|cff)\b|\d+(\.\d+)+|\be\.g\."
)


def slug(heading):
    """Return the anchor of a heading, as GitHub makes it."""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading.replace("`", "")).strip().lower()
    return re.sub(r"[^\w\- ]", "", text).replace(" ", "-")


def without_code(page):
    return re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)


def anchors(page):
    return {slug(heading) for heading in re.findall(r"^#+ (.*)$", without_code(page), re.MULTILINE)}


def links(page):
    """Return [(link, target file, anchor)] of the links of a page inside the repository."""
    found = [one or other for one, other in LINK.findall(without_code(page))]
    parts = [(link, *link.partition("#")[::2]) for link in found if not re.match("[a-z]+:", link)]
    return [(link, (page.parent / path if path else page).resolve(), a) for link, path, a in parts]


def broken(page):
    """Return the links of a page that lead nowhere."""
    return [
        link
        for link, target, anchor in links(page)
        if not target.exists() or (anchor and anchor not in anchors(target))
    ]


def hard(text):
    """Return the sentences of a page, and those that are too long or have a habit."""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", NO_PROSE.sub("", text))
    text = WORD.sub("word", text)
    blocks = [" ".join(one.split()) for one in re.split(r"\n\s*\n|\n\s*(?:[-*]|\d+\.) ", text)]
    sentences = [one for block in blocks for one in re.split(r"(?<=[.:;!?])\s+", block) if one]
    return sentences, [one for one in sentences if len(one.split()) > LONGEST or HABITS.search(one)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_to_a_file_and_a_heading(page):
    assert broken(page) == []


@pytest.mark.parametrize(
    "folder, index", [("docs", "README.md"), ("docs/notebook", "docs/notebook/README.md")]
)
def test_the_list_of_pages_has_every_page(folder, index):
    """The list is also the navigation of the site."""
    linked = {target for _, target, _ in links(ROOT / index)}
    assert {*(ROOT / folder).glob("*.md")} - {ROOT / index} - linked == set()


@pytest.mark.parametrize("page", GUIDE, ids=lambda page: str(page.relative_to(ROOT)))
def test_few_sentences_are_hard(page):
    sentences, found = hard(page.read_text())
    assert len(found) <= max(MOST * len(sentences), 2 if len(sentences) < FEW else 0), found


def test_broken_links_and_hard_sentences_are_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# A `b` c\n\n[one](#a-b-c) [two](#no) [three](no.md) [four](https://x.y)\n")
    assert broken(page) == ["#no", "no.md"]
    long = ("word " * 26).strip()
    text = f"# What is it\n\n{long}.\n\nNobody reads `what is` this. It is read.\n\n| told |\n"
    assert hard(text)[1] == [f"{long}.", "Nobody reads word this."]
