# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The site builds strictly, without a network, and loads nothing from other servers."""

import os
import re

from documented import ROOT, TOOLS
from programs import python
import pytest
import uwb_tdoa

for module in ("material", "mkdocstrings_handlers.python", "latex2mathml"):
    pytest.importorskip(module, reason="./dev site installs it")
pytestmark = pytest.mark.slow  # building the site takes 10 s
# what a page or a style sheet loads from another server, in contrast to links of <a>
LOADED = re.compile(
    r"""<(?!a\b|link rel="(?:prev|next|canonical)")[^>]*(?:src|data|href|poster)="(?:https?:)?//"""
    r"""|(?:url\(|@import\s+)["']?(?:https?:)?//"""
)

SCRIPTS = "iframe-worker.js", "assets/javascripts/bundle"


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """Return {path in the site: text}. A link that leads nowhere ends a strict build."""
    folder = tmp_path_factory.mktemp("site")
    offline = {"http_proxy": "http://127.0.0.1:9", "https_proxy": "http://127.0.0.1:9"}
    words = ("-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", folder)
    done = python(*words, cwd=ROOT, env={**os.environ, **offline, "NO_MKDOCS_2_WARNING": "1"})
    assert done.returncode == 0, done.stdout + done.stderr
    paths = [
        path
        for path in folder.rglob("*")
        if path.suffix in (".html", ".css") or path.name == "search_index.js"
    ]
    return {path.relative_to(folder).as_posix(): path.read_text("utf-8") for path in paths}


def test_nothing_is_loaded_from_elsewhere(site):
    assert len(site) > 60 and LOADED.search('<img src="//x.y/z.png">')
    assert not LOADED.search('<a href="https://x.y">')
    assert [path for path, text in site.items() if LOADED.search(text)] == []


def test_pages_that_are_opened_as_files_can_be_searched(site):
    """A browser reads a script from a file, and no JSON; and it starts no Worker from one."""
    assert site["search/search_index.js"].startswith("var __index = {")
    for path in ("index.html", "notebook/speed.html"):
        up = "../" * path.count("/")
        shim, bundle = (site[path].index(f'<script src="{up}{name}') for name in SCRIPTS)
        assert shim < bundle


def test_indices_are_lowered_without_a_font_for_equations(site):
    assert '<script src="site.js"' in site["filter.html"]
    (name,) = re.findall(r'toggle\("([\w-]+)"', (ROOT / "docs/site.js").read_text())
    assert f".{name} :is(msub, msubsup)" in site["site.css"]


def test_equations_lists_and_the_reference_are_made(site):
    assert site["filter.html"].count("<math") > 60 and "merror" not in site["filter.html"]
    assert "<code>|p - b| - |p - a|</code>" in site["csv.html"]  # bars in a table
    for name in TOOLS:
        assert f"usage: {name} " in site["reference/commands.html"], name
    for name in set(uwb_tdoa.__all__) - {"EFFECTS"}:
        assert re.search(rf'id="[\w.]+\.{name}"', site["reference/python.html"]), name
