# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

from pathlib import Path
import time

import numpy as np
import pytest
import yaml

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from tf2_msgs.msg import TFMessage  # noqa: E402
from visualization_msgs.msg import MarkerArray  # noqa: E402

from uwb_tdoa_bias.anchors_node import PARAMETERS, AnchorsNode  # noqa: E402
from uwb_tdoa_bias.bias_node import BiasNode  # noqa: E402
from uwb_tdoa_bias.common.anchors import Anchors  # noqa: E402
from uwb_tdoa_bias.common.errors import InputError  # noqa: E402
from uwb_tdoa_bias.ros.anchors import ANCHORS_QOS, TF_STATIC_QOS, anchors_to_message, same_anchors  # noqa: E402
from uwb_tdoa_msgs.msg import AnchorArray  # noqa: E402

CONFIG = Path(__file__).resolve().parents[1] / "config" / "anchors_node.yaml"
ANCHORS = Anchors([7, 3], [[1, 2, 3], [4, 5, 6]], [[0, 0, 0.6, 0.8], [np.nan] * 4], frame="hall")


@pytest.fixture(autouse=True)
def ros(tmp_path):
    ANCHORS.to_yaml(tmp_path / "anchors.yaml")
    rclpy.init(args=["--ros-args", "-p", f"anchors_file:={tmp_path / 'anchors.yaml'}"])
    yield
    rclpy.shutdown()


def test_whoever_comes_later_gets_anchors_frames_and_markers():
    node, late, got = AnchorsNode(), rclpy.create_node("late"), {}
    for kind, topic, qos in (
        (AnchorArray, "uwb/anchors", ANCHORS_QOS),
        (TFMessage, "/tf_static", TF_STATIC_QOS),
        (MarkerArray, "uwb/anchors/markers", ANCHORS_QOS),
    ):
        late.create_subscription(
            kind, topic, lambda message, kind=kind: got.update({kind: message}), qos
        )
    until = time.monotonic() + 120.0
    while len(got) < 3 and time.monotonic() < until:
        rclpy.spin_once(late, timeout_sec=0.05)
    assert same_anchors(Anchors.from_message(got[AnchorArray]), ANCHORS)
    first, second = got[TFMessage].transforms
    assert (first.header.frame_id, first.child_frame_id, first.transform.rotation.z) == (
        "hall",
        "anchor_7",
        0.6,
    )
    assert (second.child_frame_id, second.transform.rotation.w) == (
        "anchor_3",
        1.0,
    )  # unknown attitude: level
    assert (second.transform.translation.x, second.transform.translation.z) == (4.0, 6.0)
    cubes = [marker for marker in got[MarkerArray].markers if marker.ns == "anchors"]
    assert [(marker.id, marker.pose.position.y) for marker in cubes] == [(7, 2.0), (3, 5.0)]
    assert {marker.text for marker in got[MarkerArray].markers if marker.ns == "numbers"} == {
        "7",
        "3",
    }
    late.destroy_node()
    node.destroy_node()


def test_other_anchors_than_those_of_the_file_name_their_publisher_until_it_is_gone(tmp_path):
    node, player = BiasNode(), rclpy.create_node("player")
    moved = Anchors(ANCHORS.ids, ANCHORS.positions + 0.5, ANCHORS.orientations, frame="hall")
    publisher = player.create_publisher(AnchorArray, "uwb/anchors", ANCHORS_QOS)
    publisher.publish(anchors_to_message(moved))
    until = time.monotonic() + 120.0
    while "/player" not in (node._anchors.refused or ""):
        assert time.monotonic() < until, node._anchors.refused
        rclpy.spin_once(node, timeout_sec=0.05)
    file = tmp_path / "anchors.yaml"
    assert f"convert the bag with --survey {file}" in node._anchors.refused
    assert same_anchors(node._anchors.anchors, ANCHORS)
    player.destroy_node()
    while node._anchors.refused is not None:
        assert time.monotonic() < until
        rclpy.spin_once(node, timeout_sec=0.05)
    node.destroy_node()


def test_every_parameter_is_in_the_parameter_file_with_its_default():
    (written,) = (entry["ros__parameters"] for entry in yaml.safe_load(CONFIG.read_text()).values())
    assert written == {name: parameter.default for name, parameter in PARAMETERS.items()}


def test_without_a_file_it_says_what_to_give():
    rclpy.shutdown()
    rclpy.init()
    with pytest.raises(InputError, match="anchors_file: is empty; give"):
        AnchorsNode()
