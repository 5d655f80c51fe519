# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""What holds for every page of the documentation: links lead somewhere, and a page stays short."""

from pathlib import Path
import re

import pytest

ROOT = Path(__file__).resolve().parents[3]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
LINK = re.compile(r"\]\(([^)\s]+)\)|(?:src|href)=\"([^\"]+)\"")
LONGEST = 150  # lines of a page that people read from top to bottom
# Lines of pages that are longer. They may only become shorter.
LONGER = {
    "architecture.md": 386,
    "effects.md": 488,
    "symptoms.md": 167,
}


def slug(heading):
    """The anchor of a heading, as GitHub makes it."""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading.replace("`", "")).strip().lower()
    return re.sub(r"[^\w\- ]", "", text).replace(" ", "-")


def prose(page):
    """The text of a page without its blocks of code."""
    return re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)


def anchors(page):
    """The anchors of a page."""
    return {slug(heading) for heading in re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)}


def broken(page):
    """The links of a page that lead nowhere."""
    for link in (one or other for one, other in LINK.findall(prose(page))):
        if re.match(r"[a-z]+:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        if not target.exists() or (anchor and anchor not in anchors(target)):
            yield link


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_link_leads_to_a_file_and_a_heading(page):
    assert list(broken(page)) == []


def test_a_page_to_read_is_short_and_a_long_one_becomes_no_longer():
    pages = [page for page in PAGES if page.parent.name != "notebook"]
    lines = {page.name: len(page.read_text().splitlines()) for page in pages}
    most = {name: LONGER.get(name, LONGEST) for name in lines}
    assert {name: count for name, count in lines.items() if count > most[name]} == {}


def test_a_link_that_leads_nowhere_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# A `b` c\n\n[one](#a-b-c) [two](#no) [three](no.md) [four](https://x.y)\n")
    assert list(broken(page)) == ["#no", "no.md"]
