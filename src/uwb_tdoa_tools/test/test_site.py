# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The site builds strictly, its links lead somewhere, and it loads nothing from other servers."""

from html.parser import HTMLParser
import os
from pathlib import Path
import re
import subprocess
import sys
from urllib.parse import unquote, urlsplit

from documented import ROOT
import pytest
import yaml

for module in ("material", "mkdocstrings_handlers.python", "latex2mathml"):
    pytest.importorskip(module, reason="./dev site installs it")
pytestmark = pytest.mark.slow  # building the site takes 10 s
KINDS = ("Tutorial", "How-to", "Reference", "Explanation", "Notebook")


class Page(HTMLParser):
    """The ids, links and loaded resources of a page."""

    def __init__(self, path):
        super().__init__()
        self.ids, self.links, self.loaded = set(), [], []
        self.feed(path.read_text("utf-8"))

    def handle_starttag(self, tag, attributes):
        named = dict(attributes)
        self.ids.add(named.get("id"))
        if tag == "a":
            self.ids.add(named.get("name"))
            self.links.append(named.get("href") or "")
        elif tag == "link" and named.get("rel") in ("prev", "next", "canonical"):
            self.links.append(named["href"])
        else:
            self.loaded += [named[key] for key in ("src", "data", "poster") if named.get(key)]
            self.loaded += [named["href"]] if tag == "link" else []
            self.loaded += addresses(named.get("style") or "")


def addresses(css):
    """Return the addresses that a style sheet loads."""
    return re.findall(r"""url\(["']?([^"')]+)|@import\s+["']([^"']+)""", css)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Return {path: Page} of the site, built without a network."""
    folder = tmp_path_factory.mktemp("site")
    offline = {"http_proxy": "http://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9"}
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder],
        cwd=ROOT,
        env={**os.environ, **offline, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return {path: Page(path) for path in sorted(folder.rglob("*.html")) if path.name != "404.html"}


def folder_of(site):
    return Path(os.path.commonpath(site))


def broken(path, page, site):
    """Return the links of a page that lead to no file or no anchor of the site."""
    for link in page.links:
        parts = urlsplit(link)
        if parts.scheme or not link:
            continue
        target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
        anchor = unquote(parts.fragment)
        if not target.exists() or (anchor and target in site and anchor not in site[target].ids):
            yield link


def test_every_link_leads_to_a_page_and_an_anchor(site):
    assert len(site) > 60
    found = {path.name: list(broken(path, page, site)) for path, page in site.items()}
    assert {name: links for name, links in found.items() if links} == {}


def test_nothing_is_loaded_from_elsewhere(site):
    loaded = [link for page in site.values() for link in page.loaded]
    for style in folder_of(site).rglob("*.css"):
        loaded += ["".join(found) for found in addresses(style.read_text("utf-8"))]
    assert len(loaded) > 400
    assert [link for link in loaded if re.match(r"(?!data:)([a-z]+:|//)", str(link))] == []


def test_lists_in_lists_stay_there(site):
    text = (folder_of(site) / "index.html").read_text("utf-8")
    how_to = text.partition("<strong>How-to</strong>")[2].partition("</li>")[0]
    assert "<ul>" in how_to


def test_bars_in_code_of_tables_stay_bars(site):
    text = (folder_of(site) / "csv.html").read_text("utf-8")
    assert "<code>|p - b| - |p - a|</code>" in text


def test_equations_are_mathml(site):
    text = (folder_of(site) / "filter.html").read_text("utf-8")
    assert text.count("<math") > 60 and "arithmatex" not in text
    assert "merror" not in text and "tdoa_std" in text and r"\_" not in text


def test_the_reference_has_every_parameter_command_message_and_public_name(site):
    import uwb_tdoa

    folder = folder_of(site) / "reference"
    text = {path.stem: path.read_text("utf-8") for path in folder.glob("*.html")}
    for path in (ROOT / "src").glob("*/config/*.yaml"):
        (content,) = yaml.safe_load(path.read_text()).values()
        for name in content["ros__parameters"]:
            assert f"<code>{name}</code>" in text["parameters"], name
    for path in (ROOT / "src/uwb_tdoa_tools/uwb_tdoa_tools/commands").glob("[a-z]*.py"):
        assert f"usage: {path.stem} " in text["commands"], path.stem
    for path in (ROOT / "src/uwb_tdoa_msgs").glob("*/*.[ms][sr][gv]"):
        assert f'id="{path.stem.lower()}"' in text["messages"], path.stem
    for name in set(uwb_tdoa.__all__) - {"EFFECTS"}:
        assert re.search(rf'id="[\w.]+\.{name}"', text["python"]), name


def test_the_navigation_has_the_kinds_of_pages(site):
    text = (folder_of(site) / "tutorial.html").read_text("utf-8")
    tabs = text.partition('class="md-tabs__list"')[2].partition("</ul>")[0]
    assert re.findall(r">\s*([\w-]+)\s*</a>", tabs) == ["Home", *KINDS, "Project"]


def test_a_link_that_leads_nowhere_is_found(tmp_path):
    path = tmp_path / "page.html"
    path.write_text('<a href="#a" id="a">x</a><a href="#no">x</a><a href="no.html">x</a>')
    assert list(broken(path, Page(path), {path: Page(path)})) == ["#no", "no.html"]
    assert addresses('@import "http://x.y"; a { background: url(//x.y/z.png) }') == [
        ("", "http://x.y"),
        ("//x.y/z.png", ""),
    ]
