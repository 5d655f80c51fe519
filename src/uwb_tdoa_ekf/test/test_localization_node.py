# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Both nodes of several tags in one process."""

import pytest

pytest.importorskip("uwb_tdoa_msgs.msg")

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
import rclpy  # noqa: E402
from rclpy.serialization import serialize_message  # noqa: E402
from rig import make_rig, recording  # noqa: E402, F401

from uwb_tdoa_bias.ros.node import Spinner  # noqa: E402
from uwb_tdoa_ekf import localization_node  # noqa: E402
from uwb_tdoa_ekf.localization_node import LocalizationNode, _without_own_remappings  # noqa: E402
from uwb_tdoa_msgs.msg import AnchorArray  # noqa: E402


def test_what_is_without_own_remappings_nodes_of_the_process():
    arguments = [
        "x",
        "--ros-args",
        "-r",
        "__ns:=/a",
        "-p",
        "lag:=0.2",
        "--remap",
        "__node:=y",
        "-r",
        "imu/data:=/imu",
    ]
    assert _without_own_remappings(arguments) == [
        "x",
        "--ros-args",
        "-p",
        "lag:=0.2",
        "-r",
        "imu/data:=/imu",
    ]


@pytest.mark.slow
def test_tags_that_hear_the_same_say_the_same_each_in_its_namespace(make_rig):
    flight, rig, heard = recording(seconds=3.0), make_rig(), []
    shared = [
        part
        for topic in ("imu/data", "uwb/tdoa", "uwb/anchors")
        for part in ("-r", f"{topic}:=/{rig.namespace}/{topic}")
    ]
    rig.node.create_subscription(Odometry, "other/odometry", heard.append, 1000)
    rig.start("localization_node", localization_node=["-p", 'tags:=["", "other"]', *shared])
    rig.wait(lambda: rig.node.count_publishers(f"/{rig.namespace}/other/odometry"), "the other tag")
    rig.send_anchors(flight.anchors)
    rig.play(flight)
    rig.counts("ekf_node", TDOAs_received=len(flight.tdoa))
    rig.wait(lambda: len(heard) == len(rig.odometry), "the odometry of the other tag")
    assert [m.pose for m in heard] == [m.pose for m in rig.odometry] and len(heard) > 300
    assert {m.child_frame_id for m in heard} == {"other/base_link"}


@pytest.fixture
def started():
    """Return started(*arguments), which starts a LocalizationNode with these ROS arguments.

    Its Spinner serves the node.
    """
    nodes, spinners = [], []

    def start(*arguments):
        arguments = ["--ros-args", *arguments]
        rclpy.init(args=arguments)
        node = LocalizationNode(["localization_node", *arguments])
        nodes.extend([node, *node.members])
        spinners.append(Spinner(nodes, node.turns))
        return node

    yield start
    for spinner in spinners:
        spinner.close()
    for node in nodes:
        node.destroy_node()
    rclpy.try_shutdown()


def served(node):
    """Return the full names of all running nodes of its tags."""
    return {each.get_fully_qualified_name() for tag in node._tags for each in tag.members}


def test_a_tag_that_cannot_be_started_does_not_take_the_others_along(started, tmp_path):
    (tmp_path / "bad.yaml").write_text("/a/ekf_node: {ros__parameters: {lag: -1.0}}")
    node = started("-p", "tags:=[a, b]", "--params-file", str(tmp_path / "bad.yaml"))
    assert served(node) == {"/b/bias_node", "/b/ekf_node"}
    level, text, values = node._report()
    assert (
        level == DiagnosticStatus.ERROR
        and "tag 'a' has failed and is not started again: lag" in text
    )
    assert values == {"tags": 2, "not served": text}
    node.turns.take()
    assert served(node) == {"/b/bias_node", "/b/ekf_node"}


@pytest.mark.parametrize("where", ["a turn", "a callback"])
def test_a_tag_that_fails_in_flight_does_not_take_the_others_along(started, monkeypatch, where):
    def defect(*_):
        raise ValueError("some defect")

    node = started("-p", "tags:=[a, b]")
    (first, _), others = node._tags[0].members, node._tags[1].members
    if where == "a turn":
        monkeypatch.setattr(first.streams, "take", defect)
    else:
        monkeypatch.setattr(first._anchors._latched, "_callback", defect)
        first._anchors._latched.subscription.callback(serialize_message(AnchorArray()))
    node.turns.take()  # notes the failure
    node.turns.take()
    assert served(node) == {"/b/bias_node", "/b/ekf_node"} and node._tags[1].members == others
    assert "tag 'a' has failed and is started again in 1 s: some defect" in node._report()[1]
    monkeypatch.setattr(node._tags[0], "_due", 0.0)
    node.turns.take()
    assert served(node) == {f"/{tag}/{name}_node" for tag in "ab" for name in ("bias", "ekf")}
    assert node._report()[0] == DiagnosticStatus.OK and node._tags[1].members == others


@pytest.mark.parametrize(
    "error", [OSError("no space left on device"), RuntimeError("failed to create subscription")]
)
def test_whatever_is_raised_at_the_start_of_one_tag_concerns_that_tag_alone(
    started, monkeypatch, error
):
    """Possible errors are an OSError of a file and an RCLError of the middleware."""
    real, failing = localization_node.EkfNode, [True]

    def node_of(*arguments, namespace, **options):
        if namespace == "/a" and failing.pop():
            raise error
        return real(*arguments, namespace=namespace, **options)

    monkeypatch.setattr(localization_node, "EkfNode", node_of)
    node = started("-p", "tags:=[a, b]")
    assert served(node) == {"/b/bias_node", "/b/ekf_node"}
    assert f"tag 'a' has failed and is started again in 1 s: {error}" in node._report()[1]
    failing.append(False)
    monkeypatch.setattr(node._tags[0], "_due", 0.0)
    node.turns.take()
    assert served(node) == {f"/{tag}/{name}_node" for tag in "ab" for name in ("bias", "ekf")}
