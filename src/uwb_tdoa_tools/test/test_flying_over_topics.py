"""What comes over the topics that a vehicle flies by may be anything."""

from types import SimpleNamespace

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg", reason="needs the built workspace: ./dev build")

from nav_msgs.msg import Odometry  # noqa: E402
from rclpy.serialization import serialize_message  # noqa: E402

from uwb_tdoa_bias.foundation.flight import Imu, Tdoas  # noqa: E402
from uwb_tdoa_bias.foundation.ros_node import StreamNode  # noqa: E402
from uwb_tdoa_msgs.msg import EstimatorStatus  # noqa: E402
from uwb_tdoa_tools.flying.over_topics import OverTopics  # noqa: E402
from uwb_tdoa_tools.flying.simulator import SensorReadings  # noqa: E402
from uwb_tdoa_tools.flying.vehicle import STATE  # noqa: E402
from uwb_tdoa_tools.flying.world import HALL  # noqa: E402


class Pace:
    """Takes notes."""

    def __init__(self):
        self.stamps = []

    def heard(self, t):
        self.stamps.append(t)

    def sent(self, now, measured):
        pass


@pytest.fixture
def topics():
    """OverTopics at 5 s of simulated time, which knows of a filter that runs, with its pace."""
    rclpy.init()
    node, pace = StreamNode("vehicle"), Pace()
    made = OverTopics(node, HALL, pace, clock=True)
    none = np.empty(0)
    made.take(
        SensorReadings(
            Imu(none, np.empty((0, 3)), np.empty((0, 3))), Tdoas(none, none, none, none, none), {}
        )
    )
    made.publish_truth(5.0, np.zeros(STATE))
    made.status = EstimatorStatus(status=EstimatorStatus.STATUS_RUNNING)
    yield made
    node.destroy_node()
    rclpy.shutdown()


def odometry(
    t,
    frame="map",
    p=(1.0, 2.0, 0.5),
    q=(0.0, 0.0, 2.0**-0.5, 2.0**-0.5),
    v=(1.0, 0.0, 0.0),
    variance=0.04,
):
    message = Odometry(child_frame_id="base_link")
    message.header.frame_id = frame
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(round(t * 1e9), 10**9)
    pose, speed = message.pose.pose, message.twist.twist.linear
    pose.position.x, pose.position.y, pose.position.z = p
    pose.orientation.x, pose.orientation.y, pose.orientation.z, pose.orientation.w = q
    speed.x, speed.y, speed.z = v
    message.pose.covariance = np.diag([variance, variance, 0.5 * variance, 0.0, 0.0, 0.0]).ravel()
    return serialize_message(message)


def hear(topics, *messages):
    """Have serialized messages come on odometry."""

    def fetch(wire):
        return [(frame, rows, None) for frame, rows, _ in wire.read(list(messages), lambda _: None)]

    topics._odometry = SimpleNamespace(fetch=fetch)
    topics.receive()


def test_it_is_where_the_odometry_says_with_its_velocity_in_the_world(topics):
    hear(topics, odometry(4.9), odometry(4.905, p=(1.1, 2.0, 0.5)))
    t, p, v, q = topics.pose
    assert t == pytest.approx(4.905) and topics.deviation == pytest.approx(0.2)
    np.testing.assert_allclose(p, [1.1, 2.0, 0.5])
    np.testing.assert_allclose(v, [0.0, 1.0, 0.0], atol=1e-12)  # the body points along y
    np.testing.assert_allclose(topics.odometry.t, [4.9, 4.905])


@pytest.mark.parametrize(
    "bad",
    [
        odometry(4.95, p=(np.nan, 0.0, 0.0)),
        odometry(4.95, p=(1e9, 0.0, 0.0)),
        odometry(4.95, v=(1e3, 0.0, 0.0)),
        odometry(4.95, q=(0.0, 0.0, 0.0, 0.0)),
        odometry(4.95, variance=-1.0),
        odometry(4.95, frame="odom"),
        odometry(4.8),
        odometry(1000.0),
        b"\x00\x01\x00\x00 no odometry",
    ],
)
def test_what_is_none_is_passed_over(topics, bad):
    hear(topics, odometry(4.9))
    before = topics.pose
    hear(topics, bad)
    assert topics.pose is before or topics.pose[0] == before[0]
    assert topics._pace.stamps == [pytest.approx(4.9)]
    hear(topics, odometry(4.96))
    assert topics.pose[0] == pytest.approx(4.96)


@pytest.mark.parametrize(
    "status",
    [EstimatorStatus.STATUS_WAITING, EstimatorStatus.STATUS_STARTING, EstimatorStatus.STATUS_FAULT],
)
def test_by_a_status_that_is_not_running_it_neither_starts_nor_goes_on(topics, status):
    hear(topics, odometry(5.0))
    assert topics.deviation == pytest.approx(0.2)
    topics.status = EstimatorStatus(
        status=status, yaw_known=True, why="the sign of all TDOAs is wrong"
    )
    assert topics.deviation == np.inf and topics.why == "the sign of all TDOAs is wrong"


def test_where_the_filter_does_not_run_it_knows_nothing_and_says_why(topics):
    hear(topics, odometry(4.9))
    topics.status = EstimatorStatus(
        status=EstimatorStatus.STATUS_LOST, lost=True, why="the tag is lost"
    )
    assert topics.deviation == np.inf and topics.why == "the tag is lost"
    topics.status = None
    assert topics.deviation == np.inf and "nothing came on status" in topics.why


def test_odometry_from_before_anything_was_measured_is_not_taken(topics):
    """Whoever publishes it would have ended the node: in real time stamps count from the start, and
    there was none.
    """
    topics._begin = None
    hear(topics, odometry(4.9))
    assert topics.pose is None


def test_a_flood_of_odometry_does_not_fill_it(topics):
    hear(topics, *(odometry(4.0 + 1e-6 * k) for k in range(2000)))
    assert len(topics.odometry.t) <= 5
