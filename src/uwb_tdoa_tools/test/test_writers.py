# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The suite writes files through `common/files.py`: completely or not at all, always in UTF-8."""

import ast
from dataclasses import replace
import json
import os
import re

from documented import ROOT
from known_effects import clean_flight
from programs import python
import pytest

from uwb_tdoa_tools.bags.bag import write_bag

SOURCES = [
    ROOT / "src" / name / name for name in ("uwb_tdoa_bias", "uwb_tdoa_ekf", "uwb_tdoa_tools")
] + [ROOT / "studies"]
ELSEWHERE = {  # these files are not handed to a user directly
    "uwb_tdoa_bias/common/files.py",
    "uwb_tdoa_tools/bags/files.py",  # files unpacked in a temporary folder
    "uwb_tdoa_tools/live/session.py",  # output of a process
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


@pytest.mark.slow
@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])  # of the output
def test_evaluate_reads_and_writes_files_in_an_ascii_locale(tmp_path, encoding):
    """The names of the flight, of its folder and of the files have non-ASCII characters.

    The other commands write by the same functions.
    """
    bag = tmp_path / "zwei flüge — 二" / "bag"
    bag.parent.mkdir()
    write_bag(replace(clean_flight(100, 16.0), name="flüge"), bag)
    words = ("evaluate", bag, "--json", "é.json", "--plot", "é è.png", "--tum", "ü ü")
    line = ["-m", "uwb_tdoa_tools.main", *words]
    variables = os.environ | ASCII | {"PYTHONIOENCODING": encoding}
    done = python(*line, cwd=tmp_path, env=variables, encoding=encoding)
    assert done.returncode == 0 and "Traceback" not in done.stderr, done.stderr
    assert list((tmp_path / "ü ü").glob("*.tum")) and (tmp_path / "é è.png").stat().st_size > 1000
    text = (tmp_path / "é.json").read_bytes().decode("utf-8")
    assert json.loads(text)["runs"][0]["flight"].startswith("flüge")
