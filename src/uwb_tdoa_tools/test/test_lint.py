# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Format and rules of the sources (ruff.toml), types (.ci/mypy.ini), arguments and licences."""

import ast
import re

from documented import ROOT
from programs import python
import pytest

MOST_ARGUMENTS = 7  # arguments of a function (CONTRIBUTING.md), without self and cls
LICENCE = "# SPDX-License-Identifier: Apache-2.0\n"
# Each comment is the kind of error that mypy must find in its line.
WRONG = """
from nav_msgs.msg import Odometry
from std_srvs.srv import Trigger
from uwb_tdoa_bias.common.errors import version
from uwb_tdoa_bias.ros.cdr import decode
from uwb_tdoa_bias.ros.node import StreamNode
from uwb_tdoa_bias.ros.topics import Input
from uwb_tdoa_msgs.msg import AnchorArray, Tdoa, TdoaCorrected

version() + 1  # operator

def take(message: Odometry) -> None:
    message.pose.pose.positon  # attr-defined
    message.header.stamp = 1.0  # assignment
    message.pose.covariance[0].x
    for pose in message.pose.covariance: ...

def take_row(tdoa: Tdoa, data: bytes) -> float:
    decode(data, TdoaCorrected).distance_difference  # attr-defined
    return tdoa.header  # return-value

def take_texts(texts: list[str]) -> None: ...

def subscribe(node: StreamNode) -> None:
    Input(node, Odometry, "odometry", take, 10)
    Input(node, Tdoa, "odometry", take, 10)  # arg-type
    Input(node, Odometry, "odometry", take_texts, 10, bytes)  # misc
    node.create_subscription(Odometry, "odometry", take, 10)
    node.create_subscription(Tdoa, "odometry", take, 10)  # arg-type

def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
    response.succes = True  # attr-defined
    return response

Tdoa(anchor_a=1, anchor_b=2, distance_difference=0.5)
Tdoa(anchor_a="1")  # arg-type
Tdoa(anchor=1)  # call-arg
AnchorArray(anchors=[Tdoa()])  # list-item
""".strip()
ERROR = re.compile(r"^(.*):(\d+): error: .*\[([\w-]+)\]$", re.MULTILINE)


def run(*words):
    done = python(*words, cwd=ROOT)
    return done.returncode, done.stdout + done.stderr


def sources(*folders):
    """Return [(path, text)] of all Python files that are not empty."""
    paths = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    return [(path, path.read_text()) for path in paths if path.stat().st_size]


def test_no_function_has_more_arguments_than_contributing_says():
    packages = [f"src/uwb_tdoa_{name}/uwb_tdoa_{name}" for name in ("bias", "ekf", "tools")]
    for path, text in sources(*packages, "studies"):
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                given = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                names = {argument.arg for argument in given} - {"self", "cls"}
                assert len(names) <= MOST_ARGUMENTS, (path, node.name)


def test_each_source_names_its_licence():
    assert [path for path, text in sources("src") if LICENCE not in text[:200]] == []


@pytest.mark.parametrize("command", [["format", "--check"], ["check"]], ids=" ".join)
def test_ruff(command):
    pytest.importorskip("ruff")
    code, said = run("-m", "ruff", *command, "--no-cache")
    assert code == 0, said


@pytest.mark.slow
def test_types(monkeypatch):
    """mypy finds the errors of a wrong module, and no other.

    That module always has the same path, because mypy caches it. mypy leaves millions of objects
    in its process.
    """
    pytest.importorskip("mypy")
    pytest.importorskip("rclpy")
    assert run(".ci/stubs.py", "build/typings")[0] == 0
    wrong = ROOT / "build/wrong/wrong_annotations.py"
    wrong.parent.mkdir(exist_ok=True)
    wrong.write_text(WRONG)
    monkeypatch.setenv("MYPYPATH", str(wrong.parent))
    words = ["--config-file", ".ci/mypy.ini", "--show-absolute-path"]
    for name in ("uwb_tdoa", "uwb_tdoa_bias", "uwb_tdoa_ekf", "uwb_tdoa_tools", wrong.stem):
        words += ["-p", name]
    _, said = run("-m", "mypy", *words)
    comments = (line.partition("  # ")[2] for line in WRONG.splitlines())
    expected = {(str(wrong), str(k), kind) for k, kind in enumerate(comments, 1) if kind}
    assert set(ERROR.findall(said)) == expected, said
