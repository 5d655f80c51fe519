# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""debias_node: its parameters, and the node as a separate process over topics."""

from pathlib import Path

from node_parameters import written_and_declared
import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rig import MODULES, make_rig, stamp  # noqa: E402, F401

from uwb_tdoa_bias.common.anchors import Anchors  # noqa: E402
from uwb_tdoa_ekf.debias import BiasMap  # noqa: E402
from uwb_tdoa_ekf.debias_node import DebiasNode  # noqa: E402

CONFIG = Path(__file__).resolve().parents[1] / "config" / "debias_node.yaml"
ANCHORS = Anchors.from_positions([[0, 0, 0], [4, 0, 2], [4, 4, 0], [0, 4, 2], [2, 2, 3]])
# inside the map, half a metre outside, far away
PLACES = [[0.7, 0.7, 0.7], [2.0, 0.7, 0.7], [9.0, 0.7, 0.7]]


@pytest.fixture
def file(tmp_path):
    """Write a map of 1.5 x 1.5 m with a bias of -0.1 and -0.2 m."""
    cell = np.stack(np.meshgrid(range(4), range(4), indexing="ij"), axis=-1).reshape(-1, 2)
    own = {"ids": ANCHORS.ids, "positions": ANCHORS.positions}
    bias = np.tile([-0.1, -0.2], (16, 1))
    BiasMap(0.5 * cell, bias, 0.01 * np.eye(2), 0.5, **own).save(tmp_path / "map.npz")
    ANCHORS.to_yaml(tmp_path / "anchors.yaml")
    return tmp_path / "map.npz"


def parameters_of(file):
    return ["-p", f"map:={file}", "-p", f"anchors_file:={file.parent / 'anchors.yaml'}"]


def odometry(p, speed=0.0):
    message = Odometry(child_frame_id="base_link")
    place, orientation = message.pose.pose.position, message.pose.pose.orientation
    place.x, place.y, place.z = map(float, p)
    # 90 degrees to the left, so forward is +y
    orientation.z = orientation.w = np.sqrt(0.5)
    message.twist.twist.linear.x = speed
    message.pose.covariance = np.arange(36.0) + 100.0 * np.eye(6).ravel()
    return message


def xyz(message):
    p = message.pose.pose.position
    return np.array([p.x, p.y, p.z])


@pytest.fixture
def node(file):
    rclpy.init(args=["--ros-args", *parameters_of(file)])
    node = DebiasNode()
    yield node
    node.destroy_node()
    rclpy.shutdown()


def test_every_parameter_is_in_the_parameter_file_with_its_default_described_and_fixed(node):
    parameters, declared = written_and_declared(node, CONFIG)
    descriptors = [node.describe_parameter(name) for name in declared]
    declared = {
        name: value if np.ndim(value) == 0 else list(value) for name, value in declared.items()
    }
    assert parameters == declared | {"map": "", "anchors_file": ""}
    assert all(descriptor.description and descriptor.read_only for descriptor in descriptors)


@pytest.mark.slow
def test_positions_are_debiased_and_accounted_for(make_rig, file):
    rig = make_rig()
    rig.start("debias_node", debias_node=parameters_of(file))
    sent = [odometry(p) for p in (*PLACES, [0.7, np.nan, 0.7])]
    for k, message in enumerate(sent):
        rig.send("odometry", message, 0.1 * k, "map")
    rig.send("odometry", odometry(PLACES[0]), 0.9, "elsewhere")
    rig.wait(lambda: len(rig.debiased) == 5, "all of them")
    for k, message in enumerate(rig.debiased[:4]):
        assert message.header.stamp == stamp(0.1 * k) and message.header.frame_id == "map"
        assert message.child_frame_id == "base_link" and message.twist == sent[k].twist
        assert message.pose.pose.orientation == sent[k].pose.pose.orientation
    expected = BiasMap.load(file)
    before = np.arange(36.0).reshape(6, 6) + 100.0 * np.eye(6)
    for place, message in zip(PLACES, rig.debiased):
        (p,), (covariance,), _ = expected.correct(np.array([place]), before[None, :3, :3])
        np.testing.assert_allclose(xyz(message), p, atol=1e-12)
        np.testing.assert_allclose(np.reshape(message.pose.covariance, (6, 6))[:3, :3], covariance)
        np.testing.assert_array_equal(np.reshape(message.pose.covariance, (6, 6))[3:], before[3:])
    np.testing.assert_allclose(
        xyz(rig.debiased[0]), np.array(PLACES[0]) - [-0.1, -0.2, 0.0], atol=1e-9
    )
    np.testing.assert_allclose(xyz(rig.debiased[2]), PLACES[2])
    np.testing.assert_array_equal(xyz(rig.debiased[3]), [0.7, np.nan, 0.7])
    # Another frame: the pose is unchanged.
    np.testing.assert_array_equal(xyz(rig.debiased[4]), PLACES[0])
    assert rig.debiased[4].header.frame_id == "elsewhere"
    counts = rig.counts("debias_node", received=5)
    assert (counts["corrected"], counts["faded"], counts["outside"], counts["invalid"]) == (
        1,
        1,
        1,
        2,
    )


def test_it_says_what_is_wrong(node):
    def says(*sent):
        for p, frame in sent:
            message = odometry(p)
            message.header.frame_id = frame
            node._on_odometry(message)
        level, text, values = node._report()
        assert values["received"] == sum(
            values[name] for name in ("corrected", "faded", "outside", "refused", "invalid")
        )
        return level, text

    inside, outside = (PLACES[0], "map"), (PLACES[2], "map")
    for sent, level, text in (
        ([], DiagnosticStatus.WARN, "no odometry"),
        ([inside], DiagnosticStatus.OK, "debiasing"),
        ([inside, outside, outside], DiagnosticStatus.WARN, "outside of the map"),
        ([inside, inside, outside], DiagnosticStatus.OK, "debiasing"),
        ([inside, (PLACES[0], "odom")], DiagnosticStatus.ERROR, "not in the map's frame 'map'"),
        ([inside], DiagnosticStatus.OK, "debiasing"),
    ):
        found = says(*sent)
        assert found[0] == level and text in found[1]


def test_a_map_of_other_anchors_is_refused_and_of_these_is_used(node):
    def sent(anchors):
        if anchors is not None:
            node._on_anchors(anchors)
        message = odometry(PLACES[0])
        message.header.frame_id = "map"
        node._publisher.publish = lambda out: got.append(xyz(out))
        node._on_odometry(message)
        return node._report()[:2]

    got, node._map_fits_anchors = [], None
    level, text = sent(None)
    assert level == DiagnosticStatus.WARN and "no anchors" in text and "anchors_file" in text
    level, text = sent(ANCHORS.at(ANCHORS.positions + [0.5, 0.0, 0.0]))
    assert (
        level == DiagnosticStatus.ERROR
        and "made for other anchors" in text
        and "debias fit" in text
    )
    assert sent(ANCHORS)[0] == DiagnosticStatus.OK
    np.testing.assert_array_equal(got[:2], [PLACES[0]] * 2)
    np.testing.assert_allclose(got[2], np.array(PLACES[0]) - [-0.1, -0.2, 0.0], atol=1e-9)
