# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The walk of docs/architecture.md: the files that one TDOA passes through both nodes."""

from pathlib import Path
import re
import sys
import time

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from live import IMU, TDOA, messages  # noqa: E402
import rclpy  # noqa: E402
from rig import Rig, recording, stamp  # noqa: E402
from sensor_msgs.msg import Imu  # noqa: E402

from uwb_tdoa_bias.bias_node import BiasNode  # noqa: E402
from uwb_tdoa_bias.effects import AnchorDelay, EffectSet  # noqa: E402
from uwb_tdoa_ekf.core import engine  # noqa: E402
from uwb_tdoa_ekf.ekf_node import EkfNode  # noqa: E402
from uwb_tdoa_msgs.msg import Tdoa  # noqa: E402

pytestmark = pytest.mark.slow  # starts nodes

DOCUMENT = Path(__file__).resolve().parents[3] / "docs" / "architecture.md"
FILE = re.compile(r"`([\w/]+\.py)`")
OURS = re.compile(r".*/(?:uwb_tdoa_bias|uwb_tdoa_ekf)/(?!test/)(.*\.py)")
SETTLED = 100  # odometry messages until both nodes have the pose and correct TDOAs
TRACED = 10  # TDOAs
PATIENCE = 30.0  # s


@pytest.fixture
def nodes(tmp_path):
    """Give a Flight, BiasNode and EkfNode with its anchors and an effect, and a test node."""
    flight = recording(seconds=3.0)
    flight.anchors.to_yaml(tmp_path / "anchors.yaml")
    EffectSet((AnchorDelay({int(flight.anchors.ids[0]): 0.1}),)).to_yaml(tmp_path / "effects.yaml")
    files = [f"{name}_file:={tmp_path / name}.yaml" for name in ("anchors", "effects")]
    rclpy.init(args=["--ros-args", *(word for file in files for word in ("-p", file))])
    own = [BiasNode(), EkfNode(), rclpy.create_node("source", use_global_arguments=False)]
    yield flight, *own
    for node in own:
        node.destroy_node()
    rclpy.shutdown()


def walking(flight):
    """Yield the messages of a Flight in stamp order: (is a TDOA, message)."""
    imu, tdoa = flight.imu, flight.tdoa
    for t, stream, i in messages(flight):
        if stream == IMU:
            message = Rig.imu_message(imu.gyro[i], imu.accel[i])
        else:
            message = Rig.tdoa_message(tdoa.a[i], tdoa.b[i], tdoa.d[i])
        message.header.stamp = stamp(t)
        yield stream == TDOA, message


def test_a_tdoa_passes_the_files_that_are_documented(nodes):
    flight, bias, ekf, source = nodes
    imu = source.create_publisher(Imu, "imu/data", 1000)
    tdoa = source.create_publisher(Tdoa, "uwb/tdoa", 1000)
    ends = imu, tdoa, bias.output.publisher, ekf.outputs.odometry.publisher
    due = time.monotonic() + PATIENCE
    while not all(end.get_subscription_count() for end in ends):
        assert time.monotonic() < due, "the nodes do not find each other"
        time.sleep(0.01)
    passed, traced, before = set(), 0, 0

    def note(frame, event, _):
        found = OURS.fullmatch(frame.f_code.co_filename)
        if event == "call" and found:
            passed.add(found[1])

    for is_tdoa, message in walking(flight):
        (tdoa if is_tdoa else imu).publish(message)
        settled = ekf.outputs.published > SETTLED
        before, due = ekf.outputs.published, time.monotonic() + 0.1
        sys.setprofile(note if settled else None)
        while is_tdoa and ekf.outputs.published == before and time.monotonic() < due:
            bias.streams.take()
            ekf.streams.take()
        sys.setprofile(None)
        traced += settled and ekf.outputs.published > before
        if traced == TRACED:
            break
    assert traced == TRACED
    section = DOCUMENT.read_text().split("## One TDOA, from topic to odometry")[1].split("\n## ")[0]
    table, beside = section.split("\nBeside the walk")
    rows = [line for line in table.splitlines() if line.startswith("|")]
    walk, looking_up = set(FILE.findall("\n".join(rows))), set(FILE.findall(beside))
    compiled = {file for file in walk - passed if file.startswith("core/")}
    steps = Path(engine.__file__).read_text()  # names the modules of compiled code
    assert all(re.search(rf"\b{Path(file).stem}\.", steps) for file in compiled)
    # Some monitors run once a second.
    watching = {file for file in passed if file.startswith("monitoring/")}
    assert watching and passed - watching == (walk - compiled) | looking_up
    assert len(walk) <= 15 and len(walk | looking_up) <= 23
