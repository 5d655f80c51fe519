# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Flights over topics: messages with any content, and the time of each turn."""

from types import SimpleNamespace

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg", reason="needs the built workspace: ./dev build")
from nav_msgs.msg import Odometry  # noqa: E402
from rclpy.serialization import serialize_message  # noqa: E402

from uwb_tdoa_bias.common.flight import Imu, Tdoas  # noqa: E402
from uwb_tdoa_bias.ros.node import StreamNode  # noqa: E402
from uwb_tdoa_msgs.msg import EstimatorStatus  # noqa: E402
from uwb_tdoa_tools.flying.over_topics import (  # noqa: E402
    IMPATIENCE,
    LARGEST_CATCH_UP,
    PATIENCE,
    Lockstep,
    OverTopics,
    RealTime,
)
from uwb_tdoa_tools.flying.vehicle import (
    HALL,
    STATE,  # noqa: E402
)


class Pace:
    """Records the stamps of the received odometry."""

    def __init__(self):
        self.stamps = []

    def heard(self, t):
        self.stamps.append(t)

    def sent(self, now, measured):
        pass


@pytest.fixture
def topics():
    """Return OverTopics at 5 s of simulated time, with its pace. The filter is running."""
    rclpy.init()
    node, pace = StreamNode("vehicle"), Pace()
    made = OverTopics(node, HALL, pace, clock=True)
    none = np.empty(0)
    imu = Imu(none, np.empty((0, 3)), np.empty((0, 3)))
    made.take({"imu": imu, "tdoa": Tdoas(none, none, none, none, none)})
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
    """Pass serialized messages to the subscription of odometry."""

    def fetch(codec):
        return [
            (frame, rows, None) for frame, rows, _ in codec.read(list(messages), lambda _: None)
        ]

    topics._odometry = SimpleNamespace(fetch=fetch)
    topics.receive()


def test_it_is_where_the_odometry_says_with_its_velocity_in_the_world(topics):
    hear(topics, odometry(4.9), odometry(4.905, p=(1.1, 2.0, 0.5)))
    t, p, v, q = topics.pose
    assert t == pytest.approx(4.905) and topics.deviation == pytest.approx(0.2)
    np.testing.assert_allclose(p, [1.1, 2.0, 0.5])
    np.testing.assert_allclose(v, [0.0, 1.0, 0.0], atol=1e-12)  # the body x axis points along y
    np.testing.assert_allclose(topics.odometry.t, [4.9, 4.905])


def test_odometry_of_the_present_is_used(topics):
    """The stamps form a grid. 1e-9 times nanoseconds rounds differently at some steps."""
    steps = [number / 200.0 for number in range(1001, 1201)]
    for now in steps:
        topics.publish_truth(now, np.zeros(STATE))
        hear(topics, odometry(now))
    assert topics._pace.stamps == steps


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
    [
        EstimatorStatus.STATUS_WAITING,
        EstimatorStatus.STATUS_STARTING,
        EstimatorStatus.STATUS_LOST,
        EstimatorStatus.STATUS_FAULT,
        None,
    ],
)
def test_by_a_status_that_is_not_running_it_neither_starts_nor_goes_on(topics, status):
    hear(topics, odometry(5.0))
    assert topics.deviation == pytest.approx(0.2)
    expected = "nothing came on status: start ekf_node"
    topics.status = None
    if status is not None:
        expected = "the sign of all TDOAs is wrong"
        topics.status = EstimatorStatus(status=status, yaw_known=True, why=expected)
    assert topics.deviation == np.inf and topics.why == expected


def test_odometry_from_before_anything_was_measured_is_not_taken(topics):
    """In real time, stamps count from the start.

    Odometry before the start would have ended the node.
    """
    topics._begin = None
    hear(topics, odometry(4.9))
    assert topics.pose is None


def test_a_flood_of_odometry_does_not_fill_it(topics):
    hear(topics, *(odometry(4.0 + 1e-6 * k) for k in range(2000)))
    assert len(topics.odometry.t) <= 5


TURN = 0.01


@pytest.fixture
def clock():
    made = SimpleNamespace(t=100.0)
    made.now = lambda: made.t
    return made


def stream(*t):
    return SimpleNamespace(t=np.array(t), __len__=None)


def measured(now, tdoa=True):
    heard = [now - 0.004, now - 0.001] if tdoa else []
    return {"imu": stream(now - 0.005, now), "tdoa": stream(*heard)}


@pytest.fixture
def running(clock):
    """Return a Lockstep at 5 s, synchronous with a filter of 200 Hz."""
    made = Lockstep(clock.now)
    for k in range(1, 501):
        made.sent(TURN * k, measured(TURN * k))
        for stamp in (TURN * k - 0.01, TURN * k - 0.005):
            made.heard(stamp)
        assert made.may_go_on()
    return made


def test_it_waits_for_the_odometry_that_is_due(running, clock):
    running.sent(5.01, measured(5.01))
    assert not running.may_go_on()
    running.heard(5.0)
    assert not running.may_go_on()  # 5.005 is before the newest TDOA, 5.009
    clock.t += 0.9 * PATIENCE
    assert not running.may_go_on()
    running.heard(5.005)
    assert running.may_go_on()


def test_one_that_does_not_come_is_not_waited_for_any_longer(running, clock):
    running.sent(5.01, measured(5.01))
    clock.t += PATIENCE
    assert running.may_go_on()
    running.sent(5.02, measured(5.02))
    assert not running.may_go_on()
    clock.t += IMPATIENCE
    assert running.may_go_on()
    running.sent(5.03, measured(5.03))
    running.heard(5.025)
    assert running.may_go_on()
    running.sent(5.04, measured(5.04))
    clock.t += 2.0 * IMPATIENCE
    assert not running.may_go_on()  # it waits again


def test_in_a_silence_nothing_is_due_until_the_filter_goes_on_without(running):
    for k in range(501, 530):
        running.sent(TURN * k, measured(TURN * k, tdoa=False))
        assert running.may_go_on()
    running.sent(5.4, measured(5.4, tdoa=False))
    assert not running.may_go_on()
    running.heard(5.1)
    assert running.may_go_on()


def test_before_the_filter_starts_turns_are_slow(clock):
    pace = Lockstep(clock.now)
    assert pace.may_go_on()
    pace.sent(TURN, measured(TURN))
    assert not pace.may_go_on()
    clock.t += IMPATIENCE
    assert pace.may_go_on()


def test_in_real_time_each_turn_has_its_time_and_a_delay_shifts_the_others(clock):
    pace = RealTime(clock.now)
    assert pace.may_go_on()
    pace.sent(TURN, measured(TURN))
    assert not pace.may_go_on()
    clock.t += 1.01 * TURN
    assert pace.may_go_on()
    clock.t += 10.0
    turns = 0
    while pace.may_go_on():
        turns += 1
        pace.sent(TURN * (turns + 1), measured(TURN))
    assert turns == pytest.approx(LARGEST_CATCH_UP / TURN, abs=1.5)
