"""The linters of ament, where they are installed: flake8 as .ci/flake8.ini says, and the form of docstrings."""

import ast
from pathlib import Path
import re

import pytest

from documented import ROOT

SOURCES = [
    str(ROOT / name)
    for name in ("src/uwb_tdoa_bias/uwb_tdoa_bias", "src/uwb_tdoa_ekf/uwb_tdoa_ekf", "src/uwb_tdoa_tools/uwb_tdoa_tools", "studies")
]
# Module docstrings, blank lines, indentation, quotes. What a docstring says, and how it begins, is not for a linter.
DOCSTRINGS = "D100 D104 D201 D202 D204 D207 D300 D301 D412 D414".split()


LONGEST = 140  # characters of a line, as CONTRIBUTING.md says
IN_QUOTES = re.compile(rf"^.{{{LONGEST - 40},}}[\"']")  # a text crosses that column, or ends near it


def test_no_line_is_longer_than_contributing_says():
    files = [path for folder in ("src", "studies") for path in (ROOT / folder).rglob("*.py")]
    lines = [(path, number, line) for path in files for number, line in enumerate(path.read_text().splitlines(), 1)]
    long = [f"{path.relative_to(ROOT)}:{number}" for path, number, line in lines if len(line) > LONGEST and not IN_QUOTES.match(line)]
    assert len(files) > 500 and not long


MOST_ARGUMENTS = 7  # of a function, as CONTRIBUTING.md says; self and cls are none


def arguments(function):
    named = [one.arg for one in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)]
    return named[1:] if named[:1] in (["self"], ["cls"]) else named


def test_no_function_has_more_arguments_than_contributing_says():
    files = [path for source in SOURCES for path in Path(source).rglob("*.py")]
    functions = [(path, node) for path in files for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.FunctionDef)]
    assert len(functions) > 2500
    assert not [f"{path.relative_to(ROOT)}: {node.name}" for path, node in functions if len(arguments(node)) > MOST_ARGUMENTS]


@pytest.mark.slow
def test_flake8(monkeypatch):
    main = pytest.importorskip("ament_flake8.main").main_with_errors
    monkeypatch.chdir(ROOT / "src")
    files = [str(ROOT / name) for name in ("src", "studies", "docs", "conftest.py")]
    code, errors = main(argv=["--config", str(ROOT / ".ci" / "flake8.ini"), *files])
    assert code == 0, "\n".join(errors)


@pytest.mark.slow
def test_docstrings(monkeypatch, capsys):
    main = pytest.importorskip("ament_pep257.main").main
    monkeypatch.chdir(ROOT / "src")
    code = main(argv=["--select", *DOCSTRINGS, "--", *SOURCES])
    wrong = re.findall(r"^.*: D\d{3}: .*$", "".join(capsys.readouterr()), re.MULTILINE)
    assert code == 0 and not wrong, "\n".join(wrong)
