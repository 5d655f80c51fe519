# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A replay stays synchronous with the output of the nodes."""

import time

import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from documented import ROOT  # noqa: E402
from rclpy.serialization import serialize_message  # noqa: E402
from sensor_msgs.msg import Imu, TimeReference  # noqa: E402
from std_msgs.msg import Float64  # noqa: E402

from uwb_tdoa_bias.common.errors import InputError  # noqa: E402
from uwb_tdoa_ekf.ekf_parameters import PARAMETERS  # noqa: E402
from uwb_tdoa_ekf.reorder_buffer import OF_SENSORS, SILENT  # noqa: E402
from uwb_tdoa_msgs.msg import TdoaResidual  # noqa: E402
from uwb_tdoa_tools.commands.replay import DESCRIPTION  # noqa: E402
from uwb_tdoa_tools.live import replay as follow  # noqa: E402
from uwb_tdoa_tools.live.replay import LEAD, Follower, is_stamped, stamp_of  # noqa: E402

SECOND = 10**9


@pytest.fixture
def node():
    context = rclpy.Context()
    rclpy.init(context=context)
    yield rclpy.create_node(
        "player", context=context, enable_rosout=False, start_parameter_services=False
    )
    rclpy.shutdown(context=context)


class Speaker:
    """Publishes stamps on a topic. `matched` waits for a subscription."""

    def __init__(self, node, topic, kind=Imu):
        self._publisher, self._kind = node.create_publisher(kind, topic, 1000), kind

    def say(self, *seconds):
        for second in seconds:
            message = self._kind()
            message.header.stamp.sec, nanosec = divmod(round(second * SECOND), SECOND)
            message.header.stamp.nanosec = nanosec
            self._publisher.publish(message)

    def matched(self):
        until = time.monotonic() + 60.0
        while not self._publisher.get_subscription_count():
            assert time.monotonic() < until
            time.sleep(0.01)


@pytest.fixture
def speaker(node):
    return Speaker(node, "imu/late")


class FedNodes:
    """A stand-in for the nodes that a replay feeds.

    idle : whether they have nothing to do
    """

    lag, idle = follow.LAG, False

    def watch(self):
        pass

    def are_idle(self):
        return self.idle


@pytest.fixture
def nodes():
    return FedNodes()


@pytest.fixture
def follower(node, speaker, nodes):
    follower = Follower(node, "imu/late", nodes)
    speaker.matched()
    return follower


def waits(follower, stamp):
    """Return whether the replay waits before a message with this stamp, ns."""
    stop = Soon()
    follower.wait(stamp, stop)
    return stop.came


def test_the_replay_waits_for_a_topic_that_is_behind(follower, speaker):
    assert follower.wait(100 * SECOND, False) == 0.0
    assert not waits(follower, 100 * SECOND + LEAD)
    assert waits(follower, 101 * SECOND + LEAD)  # 100.0 was the start
    speaker.say(101)
    until = time.monotonic() + 60.0
    while waits(follower, 101 * SECOND + LEAD):
        assert time.monotonic() < until
    assert follower.wait(101 * SECOND + LEAD, False) == 0.0


def test_a_topic_that_has_gone_silent_is_not_waited_for(follower, speaker, nodes):
    nodes.idle = True
    follower.wait(0, False)
    assert follower.wait(5 * SECOND, False) > 0.0
    nodes.idle = False
    assert not waits(follower, 10 * SECOND)
    speaker.say(9)
    until = time.monotonic() + 60.0
    while not waits(follower, 12 * SECOND):  # it waits again after a new message
        assert time.monotonic() < until


def test_a_signal_ends_the_wait(follower):
    follower.wait(0, False)
    assert follower.wait(9 * SECOND, True) < 90.0


def test_topics_that_cannot_be_followed_are_named(node, nodes):
    with pytest.raises(InputError, match="nobody publishes /odometry"):
        Follower(node, "odometry", nodes)
    node.create_publisher(Float64, "number", 1)
    with pytest.raises(
        InputError, match="std_msgs/msg/Float64: not installed, or without a header"
    ):
        Follower(node, "/number", nodes)


def test_stamps_are_read_from_the_bytes():
    assert (
        is_stamped(Imu)
        and is_stamped(TimeReference)
        and not is_stamped(Float64)
        and not is_stamped(None)
    )
    message = Imu()
    message.header.stamp.sec, message.header.stamp.nanosec = -3, 999_999_999
    message.header.frame_id = "somewhere"
    assert stamp_of(serialize_message(message)) == -3 * SECOND + 999_999_999


@pytest.fixture
def starting(node, speaker, nodes):
    """Return (Follower that also follows TDOAs, Speaker of the output of the filter)."""
    residuals = Speaker(node, "uwb/residual", TdoaResidual)
    follower = Follower(node, "imu/late", nodes)
    speaker.matched()
    residuals.matched()
    return follower, residuals


@pytest.fixture
def filtered(starting, speaker, monkeypatch):
    """Return the same, with the first pose long ago."""
    monkeypatch.setattr(follow, "START", 0)
    speaker.say(10)
    until = time.monotonic() + 60.0
    while starting[0]._is_starting(10 * SECOND):
        assert time.monotonic() < until
        time.sleep(0.01)
    return starting


def play(follower, stamps):
    """Play TDOAs at stamps, s, until the follower has to wait. Return their number."""
    for number, stamp in enumerate(stamps):
        if waits(follower, round(stamp * SECOND)):
            return number
        follower.add_tdoa(round(stamp * SECOND))
    return len(stamps)


class Soon:
    """Becomes true after 0.2 s and more than 20 queries.

    On a loaded machine, 0.2 s may pass without any query.

    came : whether a query has returned true
    """

    def __init__(self):
        self.came, self._until, self._asked = False, time.monotonic() + 0.2, 0

    def __bool__(self):
        self._asked += 1
        self.came = self._asked > 20 and time.monotonic() > self._until
        return self.came


STAMPS = [10.0 + 0.01 * k for k in range(200)]


def test_the_replay_waits_for_tdoas_in_the_filter(filtered):
    follower, residuals = filtered
    assert play(follower, STAMPS) == 9  # the last stamp is a step newer than the first
    residuals.say(*STAMPS[:6])
    assert play(follower, STAMPS[9:]) == 6
    residuals.say(*STAMPS[6:100])
    assert play(follower, STAMPS[15:]) == 94


def test_steps_are_shorter_until_bias_node_has_poses(starting, speaker, nodes):
    follower, residuals = starting
    assert play(follower, STAMPS) == 5
    residuals.say(*STAMPS[:2])
    speaker.say(10.01)
    assert play(follower, STAMPS[5:]) == 2
    nodes.idle = True
    assert play(follower, STAMPS[7:18]) == 11  # the IMU of the recording is too far behind to wait


def test_tdoas_that_are_lost_are_not_waited_for(filtered):
    follower, residuals = filtered
    play(follower, STAMPS)
    residuals.say(*STAMPS[:3], *STAMPS[7:9])
    assert play(follower, STAMPS[9:]) == 9


def test_stamps_that_an_effect_shifts_are_followed(filtered):
    """bias_node corrects the stamps by tdoa_time_offset."""
    follower, residuals = filtered
    play(follower, STAMPS)
    residuals.say(*(stamp - 0.4 for stamp in STAMPS[:10]))
    assert play(follower, STAMPS[9:]) == 10


def test_a_recording_that_starts_again_is_followed_again(filtered):
    follower, residuals = filtered
    play(follower, STAMPS)
    residuals.say(*STAMPS)
    assert play(follower, STAMPS[9:]) == 191
    assert play(follower, [stamp - 5.0 for stamp in STAMPS]) == 5  # as at a start


def test_a_filter_that_has_gone_silent_is_not_waited_for(filtered, nodes):
    nodes.idle = True
    follower, residuals = filtered
    residuals.say(10.0)
    assert play(follower, STAMPS) == 200


class Reports:
    """A stand-in for the diagnostics of nodes.

    unchanged : {node: number of reports with unchanged counters}
    """

    def __init__(self):
        self.unchanged, self.counted = {}, {}

    def counts(self):
        return dict(self.counted)

    def forget(self):
        self.unchanged.clear()

    def poll(self):
        pass

    def repeated(self, name):
        return self.unchanged.get(name, 0)


def reporting(monkeypatch):
    """Return (Nodes with Reports, what they say, the names that are there); they watch."""
    monkeypatch.setattr(follow, "LOOK", 0.0)
    nodes, said, there = object.__new__(follow.Nodes), [], ["bias_node", "ekf_node"]
    nodes._names = {name: f"/{name}" for name in there}
    nodes._diagnostics, nodes._say, nodes._counts_before = Reports(), said.append, {}
    nodes._is_there = there.__contains__
    nodes.watch()
    return nodes, said, there


def test_a_node_that_never_reports_is_not_waited_for_without_end(monkeypatch):
    nodes, said, _ = reporting(monkeypatch)
    now = [follow.time.monotonic()]
    monkeypatch.setattr(follow.time, "monotonic", lambda: now[0])
    for count in range(3):  # slow, and not stuck: a counter changes
        now[0] += 0.9 * follow.STUCK
        nodes._diagnostics.counted = {"ekf_node": {"used": str(count)}}
        assert not nodes.are_idle()
    now[0] += 1.1 * follow.STUCK
    with pytest.raises(
        InputError, match=r"bias_node and ekf_node: no progress for 120 s.* too slow"
    ):
        nodes.are_idle()
    assert said == ["waiting for bias_node and ekf_node"] * 3


def test_a_node_that_does_not_report_is_waited_for_while_it_is_there(monkeypatch):
    nodes, said, there = reporting(monkeypatch)
    nodes._diagnostics.unchanged |= {"ekf_node": 9, "bias_node": 1}
    assert not nodes.are_idle() and said == ["waiting for bias_node"]
    nodes._diagnostics.unchanged["bias_node"] = 2
    assert nodes.are_idle()
    nodes.watch()
    assert not nodes.are_idle() and said[-1] == "waiting for bias_node and ekf_node"
    there.clear()
    assert nodes.are_idle()


def test_the_constants_are_those_of_the_filter():
    found = follow.SENSOR_SILENT, follow.SENSOR_SHARE, follow.LAG
    assert found == (SILENT * SECOND, OF_SENSORS, PARAMETERS["lag"].default)


def test_the_replay_does_not_wait_for_tdoas_that_wait_for_a_height(filtered):
    follower, residuals = filtered
    follower.add_sensor("/height", 10 * SECOND)
    assert play(follower, STAMPS) == 22  # it waits for half of its lag
    residuals.say(*STAMPS[:6])
    assert play(follower, STAMPS[22:]) == 5
    residuals.say(*STAMPS[6:95])
    assert play(follower, STAMPS[27:]) == 77  # without heights for a second, it no longer waits


def test_help_and_pages_give_the_age_until_which_tdoas_are_awaited():
    age = f"{follow.STEP / 1e9:g} s"
    assert f"older TDOAs ({age}) have left" in DESCRIPTION
    pages = {name: (ROOT / "docs" / name).read_text() for name in ("replay.md", "architecture.md")}
    for name, text in pages.items():
        assert f"TDOAs that are {age} older" in text, name
