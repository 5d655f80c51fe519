# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Rules for every page of the documentation.

Links lead somewhere, pages stay short, and the reference lists every topic.
"""

import ast
from pathlib import Path
import re

import pytest

from uwb_tdoa_bias.common.sensors import SENSORS

ROOT = Path(__file__).resolve().parents[3]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
LINK = re.compile(r"\]\(([^)\s]+)\)|(?:src|href)=\"([^\"]+)\"")
LONGEST = 150  # lines of a page for continuous reading
# Lines of longer pages. They may only become shorter.
LONGER = {
    "architecture.md": 386,
    "effects.md": 488,
    "symptoms.md": 167,
}

MAKERS = ("create_publisher", "create_subscription", "create_service", "Input", "StreamInput")
MAKERS += ("StreamOutput",)  # of topics and services
TOPIC = re.compile(r"/?(uwb|imu|odometry|plan|ground_truth|velocity)/[a-z_]+(/[a-z_]+)?")


def slug(heading):
    """Return the anchor of a heading, as GitHub makes it."""
    text = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading.replace("`", "")).strip().lower()
    return re.sub(r"[^\w\- ]", "", text).replace(" ", "-")


def prose(page):
    """Return the text of a page without its code blocks."""
    return re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.MULTILINE | re.DOTALL)


def anchors(page):
    """Return the anchors of a page."""
    return {slug(heading) for heading in re.findall(r"^#+ (.*)$", prose(page), re.MULTILINE)}


def broken(page):
    """Return the links of a page that lead nowhere."""
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


@pytest.mark.parametrize(
    "folder, index", [("docs", "README.md"), ("docs/notebook", "docs/notebook/README.md")]
)
def test_the_list_of_pages_has_every_page(folder, index):
    """The list is also the navigation of the site."""
    start = (ROOT / index).parent
    linked = {
        (start / link.partition("#")[0]).resolve() for link, _ in LINK.findall(prose(ROOT / index))
    }
    assert {*(ROOT / folder).glob("*.md")} - {ROOT / index} - linked == set()


def test_a_link_that_leads_nowhere_is_found(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("# A `b` c\n\n[one](#a-b-c) [two](#no) [three](no.md) [four](https://x.y)\n")
    assert list(broken(page)) == ["#no", "no.md"]


def topics():
    """Return the topics and services of the packages.

    They come from calls in nodes, and from texts that look like a topic.
    """
    found = {topic for sensor in SENSORS.values() for topic, _ in sensor.topics}
    for path in ROOT.glob("src/uwb_tdoa_*/uwb_tdoa_*/**/*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Constant) and TOPIC.fullmatch(str(node.value)):
                found.add(node.value)
            elif isinstance(node, ast.Call) and ast.unparse(node.func).split(".")[-1] in MAKERS:
                found |= {one.value for one in node.args if isinstance(one, ast.Constant)}
    return {str(one).replace("~", "ekf_node").strip("/") for one in found if isinstance(one, str)}


@pytest.mark.slow
def test_the_reference_has_every_topic_and_service():
    text = (ROOT / "docs" / "reference.md").read_text()
    section = text.partition("\n## Topics\n")[2].partition("\n## ")[0]
    listed = {name.strip("/") for name in re.findall(r"`([\w/]+)`", section)}
    missing = topics() - listed
    assert len(topics()) > 20
    assert not missing, f"add rows to Topics of docs/reference.md: {', '.join(sorted(missing))}"


def test_a_page_with_commands_shows_how_they_run_without_ros():
    for page in PAGES:
        text = page.read_text()
        shown = re.findall(r"^\./dev run uwb_tdoa_tools (?!\w+_node|replay)", text, re.MULTILINE)
        if page.parent.name != "notebook" and len(shown) > 1:
            assert "`uwb-tdoa " in text, page.name
