# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Format and rules of the sources in ruff.toml, and the number of arguments of a function."""

import ast
import subprocess
import sys

from documented import ROOT
import pytest

SOURCES = [
    ROOT / "src/uwb_tdoa_bias/uwb_tdoa_bias",
    ROOT / "src/uwb_tdoa_ekf/uwb_tdoa_ekf",
    ROOT / "src/uwb_tdoa_tools/uwb_tdoa_tools",
    ROOT / "studies",
]
MOST_ARGUMENTS = 7  # arguments of a function (CONTRIBUTING.md), without self and cls


def arguments(function):
    named = [
        one.arg
        for one in (*function.args.posonlyargs, *function.args.args, *function.args.kwonlyargs)
    ]
    return named[1:] if named[:1] in (["self"], ["cls"]) else named


def test_no_function_has_more_arguments_than_contributing_says():
    functions = [
        (path, node)
        for source in SOURCES
        for path in source.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.FunctionDef)
    ]
    assert len(functions) > 1500
    assert not [
        f"{path.relative_to(ROOT)}: {node.name}"
        for path, node in functions
        if len(arguments(node)) > MOST_ARGUMENTS
    ]


@pytest.mark.parametrize("command", [["format", "--check"], ["check"]], ids=" ".join)
def test_ruff(command):
    pytest.importorskip("ruff")
    done = subprocess.run(
        [sys.executable, "-m", "ruff", *command, "--no-cache"],
        cwd=ROOT,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stdout + done.stderr
