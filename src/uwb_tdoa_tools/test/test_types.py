# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""mypy with .ci/mypy.ini: the annotations of our packages and folders.

Message types come from the stubs that .ci/stubs.py writes. Skipped without mypy.
"""

import configparser
import re
import subprocess
import sys

from documented import ROOT
import pytest

pytestmark = pytest.mark.slow

# Each comment is the kind of error that mypy must find in its line.
WRONG = """
from nav_msgs.msg import Odometry
from std_srvs.srv import Trigger
from uwb_tdoa_bias.common.text import version
from uwb_tdoa_bias.ros.cdr import decode
from uwb_tdoa_bias.ros.frames import TFMessage, read_transforms
from uwb_tdoa_bias.ros.node import StreamNode
from uwb_tdoa_bias.ros.topics import Input, SubscribingNode
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

def take_transforms(transforms: list[str]) -> None: ...

def subscribe(node: StreamNode, other: SubscribingNode) -> None:
    Input(node, Odometry, "odometry", take, 10)
    Input(node, Tdoa, "odometry", take, 10)  # arg-type
    Input(node, TFMessage, "/tf", take_transforms, 10, read_transforms)  # misc
    node.create_subscription(Odometry, "odometry", take, 10)
    node.create_subscription(Tdoa, "odometry", take, 10)  # arg-type
    other.create_subscription(Odometry, "odometry", take, 10)
    other.create_subscription(Tdoa, "odometry", take, 10)  # arg-type

def answer(request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
    response.succes = True  # attr-defined
    return response

Tdoa(anchor_a=1, anchor_b=2, distance_difference=0.5)
Tdoa(anchor_a="1")  # arg-type
Tdoa(anchor=1)  # call-arg
AnchorArray(anchors=[Tdoa()])  # list-item
""".strip()
ERROR = re.compile(r"^(.*):(\d+): error: .*\[([\w-]+)\]$", re.MULTILINE)


def annotated():
    """Return the packages and folders whose functions must have annotations."""
    found = configparser.ConfigParser()
    found.read(ROOT / ".ci/mypy.ini")
    sections = (
        name for name in found.sections() if found[name].getboolean("disallow_untyped_defs", False)
    )
    return [name.removeprefix("mypy-").removesuffix(".*") for name in sections]


def test_annotations(monkeypatch):
    """The wrong module always has the same path, because mypy caches it.

    mypy runs in a process of its own: it leaves millions of objects, and later tests collect garbage.
    """
    pytest.importorskip("mypy")
    pytest.importorskip("rclpy")
    monkeypatch.chdir(ROOT)
    subprocess.run([sys.executable, ".ci/stubs.py", "build/typings"], check=True)
    assert {"uwb_tdoa_bias", "uwb_tdoa_ekf", "uwb_tdoa_tools"} <= set(annotated())
    wrong = ROOT / "build/wrong/wrong_annotations.py"
    wrong.parent.mkdir(exist_ok=True)
    wrong.write_text(WRONG)
    monkeypatch.setenv("MYPYPATH", str(wrong.parent))
    packages = [word for name in (*annotated(), wrong.stem) for word in ("-p", name)]
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--config-file",
        ".ci/mypy.ini",
        "--show-absolute-path",
    ]
    run = subprocess.run([*command, *packages], capture_output=True, text=True)
    comments = (line.partition("  # ")[2] for line in WRONG.splitlines())
    expected = {(str(wrong), str(k), kind) for k, kind in enumerate(comments, 1) if kind}
    assert set(ERROR.findall(run.stdout)) == expected, run.stdout + run.stderr
