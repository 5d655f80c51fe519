# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Replays as real processes that communicate over DDS, and recorded topics.

Each step waits for an event, never for a fixed time.
"""

from contextlib import contextmanager
import queue
import re
import signal
import threading
import time

import numpy as np
import programs
import pytest
from recordings import small_flight

from uwb_tdoa_tools.bags.bag import read_odometry, write_bag

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg", reason="uwb_tdoa_msgs is not built and sourced")

from geometry_msgs.msg import PoseStamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rclpy.executors import SingleThreadedExecutor  # noqa: E402
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import Imu  # noqa: E402
from tf2_msgs.msg import TFMessage  # noqa: E402

from uwb_tdoa_msgs.msg import AnchorArray, Tdoa  # noqa: E402
from uwb_tdoa_tools.commands import replay  # noqa: E402
from uwb_tdoa_tools.live.session import recorded_odometry

pytestmark = pytest.mark.slow  # starts players and subscriptions

LIMIT = 180.0  # s, limit of each step
STREAMS = ["imu/data", "uwb/tdoa", "ground_truth/pose"]
DEEP = QoSProfile(depth=100_000, reliability=ReliabilityPolicy.RELIABLE)
LATCHED = QoSProfile(
    depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL, reliability=ReliabilityPolicy.RELIABLE
)


class Process:
    """A running tool of ours, with its lines on stderr."""

    def __init__(self, name, *arguments):
        self.process = programs.start("-m", "uwb_tdoa_tools.main", name, *arguments)
        self.said = []
        self._lines = queue.Queue()
        threading.Thread(target=self._listen, daemon=True).start()

    def _listen(self):
        for line in self.process.stderr:
            self._lines.put(line)
        self._lines.put(None)

    def until(self, text):
        """Wait for a line on stderr that contains the text."""
        deadline = time.monotonic() + LIMIT
        while True:
            line = self._lines.get(timeout=max(deadline - time.monotonic(), 0.01))
            assert line is not None, f"ended without saying {text!r}: {self.said}"
            self.said.append(line)
            if text in line:
                return

    def end(self, number=None):
        """Send a signal, if given, and return exit code and stdout."""
        if number is not None:
            self.process.send_signal(number)
        code = self.process.wait(timeout=2.0 * LIMIT)
        while (line := self._lines.get(timeout=LIMIT)) is not None:
            self.said.append(line)
        return code, self.process.stdout.read()


@contextmanager
def processes():
    """Give a function that starts processes. All processes end with the block."""
    started = []

    def start(*arguments):
        started.append(Process(*arguments))
        return started[-1]

    try:
        yield start
    finally:
        for process in started:
            process.process.kill()
            process.process.wait()
            process.process.stdout.close()


@pytest.fixture
def start():
    with processes() as make:
        yield make


@pytest.fixture
def node():
    context = rclpy.Context()
    rclpy.init(context=context)
    yield rclpy.create_node(
        "listener", context=context, enable_rosout=False, start_parameter_services=False
    )
    rclpy.shutdown(context=context)


def take(subscription, enough):
    """Return messages of a subscription as soon as enough(messages) is true."""
    messages = []
    deadline = time.monotonic() + LIMIT
    while not enough(messages):
        assert time.monotonic() < deadline, f"only {len(messages)} messages came"
        with subscription.handle:
            message = subscription.handle.take_message(subscription.msg_type, False)
        if message is None:
            time.sleep(0.001)
        else:
            messages.append(message[0])
    return messages


def subscribe(node, message_type, topic, qos=DEEP):
    return node.create_subscription(message_type, topic, lambda _: None, qos)


@pytest.fixture
def play(tmp_path, capsys):
    """Return a function that replays a bag in this process: (exit code, stdout, stderr)."""

    def play(*options):
        code = replay.main([str(tmp_path / "flight.bag"), *map(str, options)])
        return (code, *capsys.readouterr())

    return play


def test_subscriptions_receive_the_bag(tmp_path, play, node):
    flight = small_flight(seconds=4.0)
    write_bag(flight, tmp_path / "flight.bag")
    imu, tdoa = subscribe(node, Imu, "imu/data"), subscribe(node, Tdoa, "uwb/tdoa")
    poses, clock = (
        subscribe(node, PoseStamped, "ground_truth/pose"),
        subscribe(node, Clock, "/clock"),
    )
    options = ["--rate", 4, "--clock", 100, "--wait-matched", LIMIT, "--wait-topics", *STREAMS]
    code, out, _ = play(*options)
    assert code == 0 and "/imu/data: 4000 messages" in out and "/uwb/tdoa: 2000 messages" in out
    took = float(re.search(r"messages in ([0-9.]+) s", out)[1])
    assert took > 0.99 * flight.imu.t[-1] / 4 - 10.0 / 4
    samples = take(imu, lambda messages: len(messages) == 4000)
    ranges = take(tdoa, lambda messages: len(messages) == 2000)
    take(poses, lambda messages: len(messages) == len(flight.truth))
    np.testing.assert_allclose(seconds_of(samples), flight.imu.t, atol=1e-9)
    np.testing.assert_array_equal([m.angular_velocity.z for m in samples], flight.imu.gyro[:, 2])
    np.testing.assert_allclose(seconds_of(ranges), flight.tdoa.t, atol=1e-9)
    np.testing.assert_array_equal([m.distance_difference for m in ranges], flight.tdoa.d)
    ticks = np.array([seconds(m.clock) for m in take(clock, lambda messages: len(messages) > 20)])
    assert (np.diff(ticks) >= 0).all()
    assert flight.imu.t[0] <= ticks[0] and ticks[-1] <= flight.imu.t[-1] + 0.001


def seconds(stamp):
    return stamp.sec + 1e-9 * stamp.nanosec


def seconds_of(messages):
    return [seconds(message.header.stamp) for message in messages]


def test_late_subscriptions_receive_the_anchors(tmp_path, start, node):
    write_bag(small_flight(seconds=30.0, rate=100), tmp_path / "flight.bag")
    imu = subscribe(node, Imu, "imu/data")
    replaying = start(
        "replay",
        tmp_path / "flight.bag",
        "--rate",
        0.1,
        "--wait-matched",
        LIMIT,
        "--wait-topics",
        "imu/data",
    )
    take(imu, lambda messages: len(messages) > 10)  # the anchors were published long before
    (array,) = take(subscribe(node, AnchorArray, "uwb/anchors", LATCHED), lambda messages: messages)
    assert [anchor.id for anchor in array.anchors] == [0, 1, 5]
    code, out = replaying.end(signal.SIGINT)
    assert code == 128 + signal.SIGINT
    assert "replay: stopped\n" in replaying.said and "/uwb/anchors: 1 messages" in out


def test_slow_reliable_subscription_loses_nothing(tmp_path, start, node):
    """The subscription sleeps for 1 s.

    The replay could publish all messages ten times in this time.
    """
    count = 12_000  # more than DDS stores for a writer
    write_bag(small_flight(seconds=count / 1000), tmp_path / "flight.bag")
    keep_all = QoSProfile(history=HistoryPolicy.KEEP_ALL, reliability=ReliabilityPolicy.RELIABLE)
    imu = subscribe(node, Imu, "imu/data", keep_all)
    replaying = start(
        "replay",
        tmp_path / "flight.bag",
        "--rate",
        100,
        "--wait-matched",
        LIMIT,
        "--wait-topics",
        "imu/data",
    )
    replaying.until("playing")
    time.sleep(1.0)
    messages = take(imu, lambda messages: len(messages) == count)
    stamps = [
        message.header.stamp.sec * 1000 + message.header.stamp.nanosec // 10**6
        for message in messages
    ]
    assert stamps == list(range(10_000, 10_000 + count))


def test_loop_starts_again_until_stopped(tmp_path, start, node):
    write_bag(small_flight(seconds=0.2), tmp_path / "flight.bag")
    imu = subscribe(node, Imu, "imu/data")
    replaying = start(
        "replay",
        tmp_path / "flight.bag",
        "--loop",
        "--wait-matched",
        LIMIT,
        "--wait-topics",
        "imu/data",
    )
    messages = take(imu, lambda messages: len(messages) == 500)
    stamps = np.array([message.header.stamp.nanosec for message in messages])
    np.testing.assert_array_equal(stamps, np.tile(np.arange(200), 3)[:500] * 1_000_000)
    assert replaying.end(signal.SIGTERM)[0] == 0


@pytest.mark.quick
def test_all_topics_of_a_tag_move_to_a_namespace(tmp_path, play, node):
    """The command is the example in --help.

    All topics of the tag get the namespace, also the anchors. The frames do not change.
    """
    write_bag(small_flight(seconds=0.2), tmp_path / "flight.bag")
    kinds = {"uwb/tdoa": Tdoa, "imu/data": Imu, "ground_truth/pose": PoseStamped}
    streams = {topic: subscribe(node, kind, f"/tag1/{topic}") for topic, kind in kinds.items()}
    anchors = subscribe(node, AnchorArray, "/tag1/uwb/anchors", LATCHED)
    frames = subscribe(node, TFMessage, "/tf_static", LATCHED)
    command = [
        line.split() for line in replay.parser().epilog.splitlines() if "__ns:=/tag1" in line
    ][0]
    options = ["--wait-matched", LIMIT, "--wait-topics", *kinds]
    assert play(*options, *command[command.index("flight_bag") + 1 :])[0] == 0
    for topic, count in (("uwb/tdoa", 100), ("imu/data", 200), ("ground_truth/pose", 50)):
        take(streams[topic], lambda messages, count=count: len(messages) == count)
    take(anchors, lambda messages: messages)
    take(frames, lambda messages: messages)


def test_without_subscriptions_it_ends_with_an_error(tmp_path, play):
    write_bag(small_flight(seconds=0.1), tmp_path / "flight.bag")
    code, _, said = play("--wait-matched", 0.1, "--wait-topics", "imu/data")
    assert code == 2 and said.splitlines()[-1].startswith(
        "replay: error: nobody subscribes to /imu/data within 0.1 s; start the nodes first"
    )
    code, out, said = play("--wait-matched", 0.1)
    assert code == 2 and "nobody subscribes to any topic of the bag within 0.1 s" in said
    assert out == ""


def test_a_topic_without_a_publisher_cannot_be_followed(tmp_path, play, node):
    """There are subscriptions, but none to the TDOAs; or the followed topic has no publisher."""
    write_bag(small_flight(seconds=0.1), tmp_path / "flight.bag")
    subscribe(node, Imu, "imu/data")
    code, _, said = play("--wait-matched", 1, "--follow", "odometry")
    assert code == 2 and "nobody subscribes to /uwb/tdoa within 1 s" in said
    subscribe(node, Tdoa, "uwb/tdoa")
    for wait in (2, 20, LIMIT):  # time to discover the publisher; a loaded machine needs more
        code, _, said = play("--wait-matched", wait, "--follow", "odometry")
        if "nobody subscribes" not in said.splitlines()[-1]:
            break
    assert code == 2
    assert "--follow: nobody publishes /odometry; start the node that does" in said


def test_no_message_is_lost_for_want_of_discovery(tmp_path, play, node):
    """The replay is best effort and names no topics to wait for.

    Not one message may be lost before discovery.
    """
    write_bag(small_flight(seconds=0.3), tmp_path / "flight.bag")
    subscribe(node, AnchorArray, "uwb/anchors", LATCHED)
    imu = subscribe(
        node, Imu, "imu/data", QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
    )
    assert play("--wait-matched", LIMIT)[0] == 0
    messages = take(
        imu, lambda messages: messages and messages[-1].header.stamp.nanosec == 299_000_000
    )
    assert len(messages) == 300 and messages[0].header.frame_id == "base_link"


def test_odometry_is_recorded_as_it_was_sent(tmp_path, node):
    publisher = node.create_publisher(Odometry, "odometry", DEEP)
    deadline, count = time.monotonic() + LIMIT, 200
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    with recorded_odometry(node, tmp_path / "odometry.bag"):
        while not publisher.get_subscription_count():
            assert time.monotonic() < deadline
            executor.spin_once(timeout_sec=0.01)
        for k in range(count):
            message = Odometry()
            message.header.stamp.sec, message.pose.pose.position.x = k, 0.5 * k
            message.pose.pose.orientation.w = 1.0
            publisher.publish(message)
            if k < count // 2:
                executor.spin_once(timeout_sec=0.0)
        assert publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=LIMIT))
    back = read_odometry(tmp_path / "odometry.bag")
    np.testing.assert_array_equal(back.t, np.arange(count))
    np.testing.assert_array_equal(back.p[:, 0], 0.5 * np.arange(count))


@pytest.mark.parametrize(
    "arguments, sentence",
    [
        (["nothing.bag"], "replay: error: nothing.bag: is not a bag"),
        (
            ["nothing.bag", "--rate", "0"],
            "argument -r/--rate: '0' is not a number above 0",
        ),
        (
            ["flight.bag", "--wait-topics", "uwb/nothing"],
            "/uwb/nothing is not in the bag",
        ),
        (["flight.bag", "--ros-args", "--nonsense"], "replay: error: --ros-args: "),
    ],
)
def test_bad_usage_is_one_sentence_and_code_two(tmp_path, monkeypatch, capsys, arguments, sentence):
    monkeypatch.chdir(tmp_path)
    write_bag(small_flight(seconds=0.01), "flight.bag")
    assert replay.main(arguments) == 2
    assert sentence in capsys.readouterr().err.splitlines()[-1]
    assert [path.name for path in tmp_path.iterdir()] == ["flight.bag"]
