# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Parameters, initialpose and transforms of ekf_node."""

import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from dataclasses import fields  # noqa: E402
import json  # noqa: E402
import math  # noqa: E402
from pathlib import Path  # noqa: E402
import re  # noqa: E402
from types import SimpleNamespace  # noqa: E402

from builtin_interfaces.msg import Time  # noqa: E402
from geometry_msgs.msg import PoseWithCovarianceStamped  # noqa: E402
from node_parameters import written_and_declared  # noqa: E402
import numpy as np  # noqa: E402
from scipy.spatial.transform import Rotation  # noqa: E402

from uwb_tdoa_bias.common.errors import InputError  # noqa: E402
from uwb_tdoa_bias.ros.anchors import ANCHORS_QOS, CALIBRATION  # noqa: E402
from uwb_tdoa_bias.ros.topics import Epoch  # noqa: E402
from uwb_tdoa_ekf import outputs  # noqa: E402
from uwb_tdoa_ekf.core.config import FilterConfig  # noqa: E402
from uwb_tdoa_ekf.ekf_node import EkfNode  # noqa: E402
from uwb_tdoa_ekf.frames import pose_from_message  # noqa: E402
from uwb_tdoa_ekf.monitoring.finding import ERROR, Finding  # noqa: E402
from uwb_tdoa_ekf.monitoring.status import FAULT  # noqa: E402
from uwb_tdoa_ekf.results import Odometry  # noqa: E402
from uwb_tdoa_msgs.msg import Calibration  # noqa: E402

# --- ekf node ---
CONFIG = Path(__file__).resolve().parents[1] / "config" / "ekf_node.yaml"


@pytest.fixture
def node():
    rclpy.init()
    node = EkfNode()
    yield node
    node.destroy_node()
    rclpy.shutdown()


def test_every_parameter_is_in_the_parameter_file_with_its_default(node):
    parameters, declared = written_and_declared(node, CONFIG)
    missing = [
        f"    {name}: {json.dumps(declared[name])}  # {node.describe_parameter(name).description}"
        for name in declared
        if name not in parameters
    ]
    assert not missing, "\n".join(["add to ekf_node.yaml, in the order of the registry:", *missing])
    assert parameters == declared
    assert {field.name for field in fields(FilterConfig)} < declared.keys()
    assert FilterConfig.from_yaml(CONFIG) == FilterConfig()
    comments = dict(re.findall(r"^    (\w+): .*?  # (.*)$", CONFIG.read_text(), re.MULTILINE))
    assert comments == {name: node.describe_parameter(name).description for name in declared}


def test_the_end_of_a_fault_opens_the_filter(node):
    opened = []
    node._estimator = SimpleNamespace(
        running=True,
        lost=None,
        without_imu=None,
        yaw_doubts=0,
        unsure=None,
        distrust=lambda: opened.append(True),
    )
    node._health.last_odometry = node._health.now()
    node._attitude = np.array([[0.0, 0.0, 0.0, 1.0]]), 1e-4 * np.eye(9)[None]
    assert node._judge().yaw_known
    node._findings = [Finding("tdoa_sign", ERROR, "the sign is wrong", "", "", 1.0)]
    assert node._judge().status == FAULT and not opened
    node._findings = []
    assert not node._judge().yaw_known and opened == [True]
    node._judge()
    assert opened == [True]
    node._estimator = None


@pytest.mark.parametrize("frozen", [False, True])
def test_a_calibration_begins_the_search_for_changes_anew(frozen):
    rclpy.init(args=["--ros-args", "-p", f"frozen:={str(frozen).lower()}"])
    node, begun = EkfNode(), []
    try:
        node._estimator = SimpleNamespace(recalibrated=lambda: begun.append(True))
        publisher = node.create_publisher(Calibration, CALIBRATION, ANCHORS_QOS)
        topics = [each.topic_name for each in node.subscriptions]
        assert (CALIBRATION in topics) == (not frozen)
        publisher.publish(Calibration())
        while not begun and not frozen:
            rclpy.spin_once(node)
    finally:
        node._estimator = None
        node.destroy_node()
        rclpy.shutdown()


def test_a_velocity_is_turned_into_the_body_by_its_frame(node):
    taken, turn = [], Rotation.from_euler("z", 90.0, degrees=True)
    node._estimator = SimpleNamespace(add=lambda name, stream: taken.append(stream))
    node._frames.frames.set("base_link", "camera", turn.as_quat(), [0.0, 0.0, 0.0])
    rows = {
        "twist.twist.linear": np.array([[1.0, 0.0, 0.0]]),
        "twist.twist.angular": np.array([[0.0, 0.0, 0.5]]),
        "twist.covariance": np.diag([0.01, 0.04, 0.09, 1.0, 1.0, 1.0]).reshape(1, 36),
    }
    for frame, v, std in (
        ("camera", [0.0, 1.0, 0.0], [0.2, 0.1, 0.3]),
        ("base_link", [1.0, 0.0, 0.0], [0.1, 0.2, 0.3]),
        ("unknown", [1.0, 0.0, 0.0], [0.1, 0.2, 0.3]),
    ):
        node._take_sensor("velocity", frame, np.zeros(1), rows, np.zeros(1))
        np.testing.assert_allclose(taken[-1].v, [v], atol=1e-12)
        np.testing.assert_allclose(taken[-1].std, [std], atol=1e-12)
        assert taken[-1].yaw_rate == pytest.approx(0.5)
        assert ("is in frame 'unknown'" in str(node._unplaced)) == (frame == "unknown")


# --- pose message ---


def message(variances=(0.25, 0.25, 0.0, 0.0, 0.0, 0.07), frame="map", second=5):
    """Return a pose as RViz sends it: x, y and yaw, here 90 degrees to the left."""
    out = PoseWithCovarianceStamped()
    out.header.frame_id, out.header.stamp.sec = frame, second
    out.pose.pose.position.x, out.pose.pose.position.y, out.pose.pose.position.z = 1.0, 2.0, 0.0
    out.pose.pose.orientation.z = out.pose.pose.orientation.w = math.sqrt(0.5)
    out.pose.covariance = np.diag(variances).ravel()
    return out


def read(content, newest=3.0):
    epoch = Epoch()
    epoch.seconds(Time(sec=2))
    return pose_from_message(content, "map", epoch, newest)


def test_what_has_a_variance_is_told():
    t, p, covariance, yaw, std = read(message())
    assert (t, p[:2].tolist(), yaw, std) == (
        3.0,
        [1.0, 2.0],
        pytest.approx(math.pi / 2),
        pytest.approx(math.sqrt(0.07)),
    )
    assert math.isnan(p[2]) and covariance[0, 0] == 0.25
    _, p, _, yaw, std = read(message((0.25, 0.25, 0.1, 0.0, 0.0, 0.0)))
    assert p[2] == 0.0 and math.isnan(yaw) and math.isnan(std)


def test_without_a_stamp_it_is_of_the_newest_measurement():
    assert read(message(second=0), newest=7.5)[0] == 7.5
    with pytest.raises(InputError, match="no stamp"):
        read(message(second=0), newest=-math.inf)


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (message(frame="odom"), "'odom', and the filter's is 'map'"),
        (message((math.nan, 1.0, 1.0, 1.0, 1.0, 1.0)), "not finite"),
        (message((-1.0, 1.0, 1.0, 1.0, 1.0, 1.0)), "negative"),
    ],
)
def test_nonsense_is_refused(content, named):
    with pytest.raises(InputError, match=named):
        read(content)


# --- outputs ---


class Publisher:
    """Keep (translation, quaternion, stamp) of each published transform."""

    def __init__(self):
        self.sent = []

    def get_subscription_count(self):
        return 1

    def publish(self, message):
        (one,) = message.transforms
        v, q, stamp = one.transform.translation, one.transform.rotation, one.header.stamp
        self.sent.append(
            (
                np.array([v.x, v.y, v.z]),
                Rotation.from_quat([q.x, q.y, q.z, q.w]),
                stamp.sec + 1e-9 * stamp.nanosec,
            )
        )


class Stub:
    """A node with a frame odom. At time t, the body is at (t, 0, lift) in odom, tilted."""

    def __init__(self, lift=0.0, tilt=0.0):
        self.tf, self.lift, self.tilt = Publisher(), lift, tilt

    def create_publisher(self, *_):
        return self.tf

    def between(self, parent, child, t):
        return Rotation.from_euler("ZYX", [0.1, self.tilt, 0.0]), np.array([t, 0.0, self.lift])


class Silent:
    def __init__(self, *_):
        self.publisher = self

    def publish(self, *_):
        pass


def made(monkeypatch, node, planar):
    monkeypatch.setattr(outputs, "StreamOutput", Silent)
    epoch = Epoch()
    epoch.seconds_of(np.array([100]), np.array([0]))
    return outputs.Outputs(node, epoch, node, "base_link", "odom", "odom", planar)


def odometry(t, p, yaw, tilt=0.0):
    n, q = (
        len(t),
        Rotation.from_euler("ZYX", np.column_stack([yaw, np.full((len(t), 2), tilt)])).as_quat(),
    )
    zeros, covariance = np.zeros((n, 3)), np.tile(0.01 * np.eye(9), (n, 1, 1))
    return Odometry(t, p, zeros, q, zeros, zeros, covariance, np.zeros((n, 3, 3)))


def publish(out, estimates, held=False, turns=False):
    out.publish_odometry(estimates, np.full(len(estimates), turns), held)


def test_world_to_odom_stays_while_the_position_is_unsure(monkeypatch):
    node = Stub()
    out = made(monkeypatch, node, False)
    t = np.array([1.0, 1.1, 1.2])
    p = np.column_stack([t + 1.0, [2.0, 2.0, 5.0], np.zeros(3)])
    publish(out, odometry(t[:1], p[:1], np.array([0.5])))
    publish(out, odometry(t[1:], p[1:], np.array([0.5, 2.0])), held=True)
    (first, turn, _), *others = node.tf.sent
    assert len(others) == 2 and [stamp for *_, stamp in others] == pytest.approx(
        (t[1:] + 100.0).tolist()
    )
    for translation, rotation, _ in others:
        np.testing.assert_array_equal(translation, first)
        assert (rotation.inv() * turn).magnitude() == 0.0
    publish(out, odometry(t[2:], p[2:], np.array([2.0])))
    assert np.linalg.norm(node.tf.sent[-1][0] - first) > 1.0


def test_the_first_transform_is_not_held(monkeypatch):
    node = Stub()
    publish(
        made(monkeypatch, node, False),
        odometry(np.array([1.0]), np.ones((1, 3)), np.array([0.5])),
        held=True,
    )
    (_, turn, _) = node.tf.sent[0]
    assert turn.as_euler("ZYX")[0] == pytest.approx(0.4)


def test_no_transform_while_the_yaw_may_turn(monkeypatch):
    node = Stub()
    out = made(monkeypatch, node, False)
    t = np.array([1.0, 1.1])
    estimates = odometry(t, np.ones((2, 3)), np.zeros(2))
    publish(out, estimates, turns=True)
    assert not node.tf.sent and out.published == 2 and out.stamp.sec == 101
    publish(out, estimates)
    assert len(node.tf.sent) == 2


@pytest.mark.parametrize(("imu", "velocity"), [(0, 0), (3, 0), (0, 3)])
def test_without_imu_and_velocities_the_yaw_stays(imu, velocity):
    estimator = SimpleNamespace(counts={"imu_used": imu, "velocity_used": velocity})
    estimates = odometry(np.array([1.0, 1.1]), np.ones((2, 3)), np.zeros(2))
    estimates.covariance[0, 8, 8] = 4.0  # rad^2
    turns = EkfNode._yaw_may_turn(SimpleNamespace(_estimator=estimator), estimates)
    assert turns.tolist() == [imu + velocity > 0, False]


@pytest.mark.parametrize("planar", [False, True])
def test_world_to_odom_of_a_planar_vehicle_turns_about_the_vertical_alone(monkeypatch, planar):
    """The transform odom -> base_link of a three-dimensional odometry is tilted."""
    node = Stub(lift=0.05, tilt=0.03)
    publish(
        made(monkeypatch, node, planar),
        odometry(np.array([1.0]), np.array([[1.0, 2.0, 0.0]]), np.array([0.5])),
    )
    (translation, turn, _) = node.tf.sent[0]
    yaw, pitch, roll = turn.as_euler("ZYX")
    assert yaw == pytest.approx(0.4, abs=0.01) and (np.hypot(pitch, roll) < 1e-9) == planar
    assert np.linalg.norm(turn.apply([1.0, 0.0, 0.05]) + translation - [1.0, 2.0, 0.0]) < 1e-9
