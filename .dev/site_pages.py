# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Make the pages of the site that are not in docs/, and the equations. mkdocs.yml names this file as a hook.

The reference is made from the sources: options of the commands, parameter files of the nodes, messages,
and docstrings of `uwb_tdoa`. Links between files of the repository lead to their pages. LaTeX becomes
MathML, so that no browser needs a script or a font for it.
"""

from __future__ import annotations

import argparse
import html
from importlib import import_module
import inspect
import os
from pathlib import Path
import posixpath
import re
import sys

from latex2mathml.converter import convert
from mkdocs.structure.files import File

ROOT = Path(__file__).resolve().parents[1]
SRC = ROOT / "src"
PAGES = {  # {file at the top of the repository: its page}
    "README.md": "index.md",
    "CHANGELOG.md": "project/changelog.md",
    "CONTRIBUTING.md": "project/contributing.md",
    "SECURITY.md": "project/security.md",
}
NO_NAVIGATION = "---\nhide:\n  - navigation\n---\n"  # beside the text: the first page has none
NODES = ("bias_node", "ekf_node", "localization_node", "anchors_node", "debias_node")
NODES += ("autopilot_node", "calibration_node", "vehicle_node")
# code, where nothing is a link; or the indent of a line; or the end of a link, with its text if that is the name of a page
PART = re.compile(
    r"(^```.*?^```$|`[^`\n]*`)|(^ +(?=\S))|(\[\w+\.md)?\]\(([^)\s:]+)\)", re.MULTILINE | re.DOTALL
)
EQUATION = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


KIND = re.compile(r"^- \*\*(.*?)\*\*:(.*?)(?=^- \*\*|^\n)", re.MULTILINE | re.DOTALL)


# --- events of mkdocs ---


def on_config(config):
    """Take the navigation from the list in README.md: kinds of pages, groups, and pages."""
    nav = [{"Home": "index.md"}]
    for kind, text in KIND.findall((ROOT / "README.md").read_text("utf-8")):
        first, *groups = re.split(r"^  - ", text, flags=re.MULTILINE)
        pages = linked(first, "README.md")
        pages += [{group.partition(":")[0]: linked(group, "README.md")} for group in groups]
        if kind == "Reference":
            pages[1:1] = [f"reference/{name}.md" for name in REFERENCE]
        elif kind == "Notebook":
            pages += linked((ROOT / "docs" / pages[0]).read_text("utf-8"), f"docs/{pages[0]}")
        nav.append({kind: pages})
    config.nav = [*nav, {"Project": [*list(PAGES.values())[1:], "release.md"]}]
    return config


def on_files(files, config):
    """Add the pages that are not in docs/, and turn the links of all pages to the pages of the site."""
    for source, page in PAGES.items():
        head = NO_NAVIGATION if page == "index.md" else ""
        text = head + (ROOT / source).read_text("utf-8")
        files.append(File.generated(config, page, content=text))
    sources = {page: source for source, page in PAGES.items()}
    for file in files.documentation_pages():
        source = sources.get(file.src_uri, f"docs/{file.src_uri}")
        file.content_string, others = with_links(file.content_string, source, file.src_uri)
        for other in others - set(files.src_uris):
            path = ROOT / other.removeprefix("repository/").removesuffix(".txt")
            files.append(File.generated(config, other, abs_src_path=str(path)))
    for name, made in REFERENCE.items():
        files.append(File.generated(config, f"reference/{name}.md", content=made()))
    return files


def on_page_content(content, **_):
    """Turn the equations of a page into MathML."""
    return EQUATION.sub(lambda found: mathml(html.unescape(found[2]), found[1] == "div"), content)


# --- links and equations ---


def with_links(text, source, page):
    """Return the text of a page for the site, and the files outside docs/ to which it has links.

    source : path of the page in the repository
    page : its path in the site
    """
    others = set()

    def turned(found):
        if found[2]:  # lists in lists: GitHub takes an indent of 2, Python-Markdown needs 4
            return 2 * found[2]
        if found[1] and not found[1].startswith("```"):  # code in tables: GitHub escapes bars in it
            return found[1].replace(r"\|", "|")
        path, hash_, anchor = (found[4] or "").partition("#")
        if not path:
            return found[0]
        target = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
        if (ROOT / target).is_dir():
            target += "/README.md"
        place = PAGES.get(target, target.removeprefix("docs/"))
        if place == target:
            place = f"repository/{target}.txt"
            others.add(place)
        start = posixpath.dirname(page) or "."
        text = f"[{title(ROOT / target)}" if found[3] else ""
        return f"{text}]({posixpath.relpath(place, start)}{hash_}{anchor})"

    return PART.sub(turned, text), others


def linked(text, source):
    """Return the pages to which a text has links, in their order."""
    folder = posixpath.dirname(source)
    targets = re.findall(r"\]\(([^)#]+\.md)\)", text)
    return [posixpath.join(folder, one).removeprefix("docs/") for one in targets]


def title(path):
    """Return the first heading of a page."""
    return re.search(r"^# (.*)", path.read_text("utf-8"), re.MULTILINE)[1]


def mathml(latex, block):
    """Return the MathML of an equation."""
    names = re.sub(r"\\texttt\{[^}]*\}", lambda found: found[0].replace(r"\_", "_"), latex)
    made = convert(names, display="block" if block else "inline")
    return f'<div class="equation">{made}</div>' if block else made


# --- the reference ---


def commands():
    """Return the page of the commands: what --help prints."""
    os.environ["COLUMNS"] = "100"
    sys.path[:0] = [str(SRC / name) for name in ("uwb_tdoa_bias", "uwb_tdoa_ekf", "uwb_tdoa_tools")]
    folder = SRC / "uwb_tdoa_tools" / "uwb_tdoa_tools" / "commands"
    parts = [
        "# Commands",
        "What `--help` prints. [Executables](../reference.md#executables) lists all in a table.",
    ]
    for name in sorted(path.stem for path in folder.glob("[a-z]*.py")):
        parser = import_module(f"uwb_tdoa_tools.commands.{name}").parser()
        parts.append(f"## {name}\n\n```text\n{parser.format_help()}```")
        parts += [
            f"### {name} {part}\n\n```text\n{own.format_help()}```"
            for part, own in own_commands(parser)
        ]
    return "\n\n".join(parts) + "\n"


def own_commands(parser):
    """Return [(name, parser)] of the commands of a command."""
    groups = [
        action for action in parser._actions if isinstance(action, argparse._SubParsersAction)
    ]
    return [one for group in groups for one in group.choices.items()]


def parameters():
    """Return the page of the parameters: those of the parameter file of each node."""
    parts = [
        "# Parameters",
        "Every parameter of the nodes with its default, made from their parameter files.",
    ]
    for name in NODES:
        (path,) = SRC.glob(f"*/config/{name}.yaml")
        head, _, body = path.read_text("utf-8").partition("ros__parameters:\n")
        parts += [f"## {name}", " ".join(re.findall(r"^# (.*)", head, re.MULTILINE))]
        for block in body.split("\n\n"):
            parts += parts_of(block.rstrip("\n"))
    return "\n\n".join(parts) + "\n"


def parts_of(block):
    """Return what shows a block of a parameter file: its heading, its table, and its notes."""
    rows, heading, notes = [], [], []
    for line in block.splitlines():
        key = re.match(r"\s+(\w+): *(.*?) +# (.*)", line)
        if key:
            rows.append([key[1], key[2], key[3]])
        elif rows and line.startswith("    # ("):  # the rest of a meaning
            rows[-1][2] += f" {line.strip(' #')}"
        else:
            (notes if rows else heading).append(line.removeprefix("    "))
    if not rows:
        heading, notes = [], heading
    parts = [f"### {line.strip(' #')}" for line in heading]
    if rows:
        lines = [f"| `{name}` | `{value}` | {escaped(text)} |" for name, value, text in rows]
        parts.append("\n".join(["| parameter | default | meaning |", "|---|---|---|", *lines]))
    return [*parts, *(["\n".join(["```yaml", *notes, "```"])] if notes else [])]


def escaped(text):
    """Return a comment as Markdown that shows it as it is."""
    return re.sub(r"([*_<|])", r"\\\1", text)


def messages():
    """Return the page of the messages and services: their definitions."""
    parts = [
        "# Messages",
        "The messages and services of `uwb_tdoa_msgs`, with units, frames and signs.",
    ]
    for path in sorted(
        (SRC / "uwb_tdoa_msgs").glob("*/*.[ms][sr][gv]"), key=lambda path: (path.suffix, path.stem)
    ):
        parts.append(f"## {path.stem}\n\n```text\n{path.read_text('utf-8')}```")
    return "\n\n".join(parts) + "\n"


def python():
    """Return the page of the Python module: the docstrings of its public names, and of what they return."""
    import uwb_tdoa

    values = [getattr(uwb_tdoa, name) for name in uwb_tdoa.__all__]
    functions = [f"::: uwb_tdoa.{value.__name__}" for value in values if inspect.isfunction(value)]
    classes = [value for value in values if inspect.isclass(value)]
    returned = [getattr(import_module(module), name) for module, name in RETURNED.items()]
    text = "The public names of the module `uwb_tdoa`. [From Python](../python.md) shows how to use them."
    parts = ["# Python", text, "## Functions", *functions, "## Classes", *map(directive, classes)]
    return "\n\n".join([*parts, "## Results of functions", *map(directive, returned)])


def directive(value):
    """Return the line that mkdocstrings replaces by the documentation of a class."""
    return f"::: {value.__module__}.{value.__qualname__}"


RETURNED = {  # {module: class} of records that are no public names, but results of public functions
    "uwb_tdoa_ekf.monitoring.finding": "Finding",
    "uwb_tdoa_tools.scoring.metrics": "Score",
    "uwb_tdoa_tools.diagnosis": "Diagnosis",
    "uwb_tdoa_tools.calibrating": "Calibration",
}
REFERENCE = {"commands": commands, "parameters": parameters, "messages": messages, "python": python}
