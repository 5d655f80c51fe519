# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The suite writes files through `common/files.py`: completely or not at all, always in UTF-8."""

import ast
from dataclasses import replace
import json
import os
from pathlib import Path
import re
import subprocess
import sys

from documented import ROOT
from known_effects import clean_flight
import pytest

from uwb_tdoa_tools.bags.bag import write_bag

SOURCES = [
    ROOT / "src" / name / name for name in ("uwb_tdoa_bias", "uwb_tdoa_ekf", "uwb_tdoa_tools")
] + [ROOT / "studies"]
ELSEWHERE = {  # these files are not handed to a user directly
    "uwb_tdoa_bias/common/files.py",
    "uwb_tdoa_tools/bags/files.py",  # files unpacked in a temporary folder
    "uwb_tdoa_tools/live/processes.py",  # output of a process
    "studies/fuzz.py",  # input of a reader, in a temporary folder
}
WRITING = re.compile("(?=.*[wax+])[rwaxbt+]{1,3}")  # a mode of `open`
FILLED = ("savefig", "savetxt", "savez", "savez_compressed")  # they accept an open file


def direct(path):
    """Return the lines of a source that write a file directly: [(line, code)]."""
    found = []
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if not isinstance(node, ast.Call):
            continue
        name = (
            node.func.attr if isinstance(node.func, ast.Attribute) else getattr(node.func, "id", "")
        )
        texts = [
            one.value
            for one in (*node.args, *(word.value for word in node.keywords))
            if isinstance(one, ast.Constant)
        ]
        wrong = name in ("open", "fdopen", "FileType") and any(
            isinstance(text, str) and WRITING.fullmatch(text) for text in texts
        )
        wrong |= name in ("write_text", "write_bytes") and isinstance(node.func, ast.Attribute)
        wrong |= name in FILLED and not (
            node.args and isinstance(node.args[0], ast.Name) and node.args[0].id == "file"
        )
        wrong |= name == "dump" and len(node.args) > 1  # json or yaml
        if wrong:
            found.append((node.lineno, ast.unparse(node)))
    return found


def test_nothing_is_written_but_by_the_functions_for_it():
    files = [
        path
        for folder in SOURCES
        for path in folder.rglob("*.py")
        if "test" not in path.relative_to(folder).parts
    ]
    assert len(files) > 250
    direct_ones = {
        path: direct(path)
        for path in files
        if not any(str(path).endswith(name) for name in ELSEWHERE)
    }
    assert not {path: found for path, found in direct_ones.items() if found}


@pytest.mark.parametrize(
    "line",
    [
        "open(p, 'w')",
        "p.open('wb')",
        "p.write_text('a')",
        "p.write_bytes(b'')",
        "figure.savefig(p)",
        "np.savetxt(p, a)",
        "json.dump(a, p)",
    ],
)
def test_a_direct_write_is_found(tmp_path, line):
    (tmp_path / "a.py").write_text(line)
    assert direct(tmp_path / "a.py")


ASCII = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}


def in_ascii(folder, command, *arguments, encoding="ascii"):
    """Run a command in an ASCII locale and return its output.

    encoding : of its output, as a user may choose it
    """
    line = [
        sys.executable,
        "-m",
        "uwb_tdoa_tools.commands",
        command,
        *map(os.fsencode, arguments),
    ]
    variables = os.environ | ASCII | {"PYTHONIOENCODING": encoding}
    done = subprocess.run(line, cwd=folder, env=variables, capture_output=True)
    assert done.returncode == 0 and b"Traceback" not in done.stderr, done.stderr.decode(
        "utf-8", "replace"
    )
    return done.stdout.decode(encoding)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    """Write a bag of a short flight. Its name and folder have spaces and non-ASCII characters."""
    path = tmp_path_factory.mktemp("zwei flüge — 二") / "bag"
    write_bag(replace(clean_flight(100, 24.0), name="flüge"), path)
    return path


def read(path):
    text = Path(path).read_bytes().decode("utf-8")
    return json.loads(text) if str(path).endswith(".json") else text


@pytest.mark.slow
def test_evaluate_writes_its_files_in_an_ascii_locale(bag, tmp_path):
    words = ("--json", "é.json", "--plot", "é è.png", "--tum", "ü ü")
    in_ascii(tmp_path, "evaluate", bag, *words, encoding="latin-1")
    assert list((tmp_path / "ü ü").glob("*.tum")) and (tmp_path / "é è.png").stat().st_size > 1000
    assert read(tmp_path / "é.json")["runs"][0]["flight"].startswith("flüge")


@pytest.mark.slow
def test_localize_writes_its_files_in_an_ascii_locale(bag, tmp_path):
    in_ascii(tmp_path, "localize", bag, "--residuals", "--zones", "2", "--out", "wo_ü")
    assert {path.suffix for path in (tmp_path / "wo_ü").rglob("*")} >= {".png", ".csv", ".tum"}
    written = [
        path
        for path in (tmp_path / "wo_ü").rglob("*")
        if path.suffix in (".csv", ".json", ".txt", ".md", ".tum")
    ]
    assert written and all(read(path) for path in written)


@pytest.mark.slow
def test_diagnose_writes_its_report_in_an_ascii_locale(bag, tmp_path):
    in_ascii(tmp_path, "diagnose", bag, "--out", "out")
    assert not read(tmp_path / "out" / "report.html").isascii()
    assert read(tmp_path / "out" / "effects.yaml")
