# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Stamps, quality of service, anchors, log and diagnostics on the ROS side."""

from dataclasses import replace
from fractions import Fraction
import time
from types import SimpleNamespace

import pytest

pytest.importorskip("uwb_tdoa_msgs.msg")


from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticStatus
from hypothesis import given, strategies as st
import numpy as np
from rcl_interfaces.srv import GetParameters
import rclpy
from rclpy.qos import QoSCompatibility, QoSPresetProfiles, QoSProfile, qos_check_compatible
from rclpy.task import Future
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import FluidPressure

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import LINE_LENGTH, InputError
from uwb_tdoa_bias.ros import node as served, topics
from uwb_tdoa_bias.ros.anchors import (
    ANCHORS_QOS,
    ANY_QOS,
    anchors_to_message,
    in_words,
    same_anchors,
)
from uwb_tdoa_bias.ros.cdr import CdrCodec
from uwb_tdoa_bias.ros.node import (
    BURST,
    MOST_ASKED,
    MOST_REQUESTS,
    PERIOD,
    REFILL,
    Elapsed,
    Log,
    LogFilter,
    SimulatedClock,
    Spinner,
    StreamNode,
    StreamPoller,
)
from uwb_tdoa_bias.ros.topics import OUTPUT_QOS, STREAM_QOS, Epoch, Streams

# --- stamps ---
NANOSECONDS = st.integers(0, 10**9 - 1)
MONTH = 30 * 86400


@given(
    st.integers(0, 2**31 - 1 - 2 * MONTH),
    st.lists(st.tuples(st.integers(-MONTH, MONTH), NANOSECONDS), min_size=1),
)
def test_stamps_survive_to_the_nanosecond(first, others):
    epoch = Epoch()
    epoch.seconds(Time(sec=first, nanosec=999_999_999))
    for second, nanosecond in others:
        if first + second >= 0:
            stamp = Time(sec=first + second, nanosec=nanosecond)
            assert epoch.stamp(epoch.seconds(stamp)) == stamp


@given(st.integers(0, 2**31 - 10), st.lists(st.tuples(st.integers(0, 9), NANOSECONDS), min_size=2))
def test_seconds_do_not_depend_on_the_epoch(first, stamps):
    now, long_ago = Epoch(), Epoch()
    a = [now.seconds(Time(sec=first + second, nanosec=nanosecond)) for second, nanosecond in stamps]
    b = [long_ago.seconds(Time(sec=second, nanosec=nanosecond)) for second, nanosecond in stamps]
    assert a == b


@given(st.integers(0, 2**31 - 1 - MONTH), st.integers(0, MONTH), NANOSECONDS)
def test_seconds_are_the_nearest_float(first, second, nanosecond):
    """Nodes and tools must read the same seconds. Otherwise, a period may end one sample apart."""
    epoch = Epoch()
    epoch.seconds(Time(sec=first))
    nearest = float(Fraction(second * 10**9 + nanosecond, 10**9))
    assert epoch.seconds(Time(sec=first + second, nanosec=nanosecond)) == nearest
    columns = np.array([first + second]), np.array([nanosecond])
    assert epoch.seconds_of(*columns).tolist() == [nearest]


# --- ros topics ---


@pytest.mark.parametrize(
    "usual",
    [
        QoSPresetProfiles.SENSOR_DATA.value,
        QoSPresetProfiles.SYSTEM_DEFAULT.value,
        QoSProfile(depth=10),
        STREAM_QOS,
    ],
)
def test_streams_match_every_usual_publisher_and_subscriber(usual):
    assert qos_check_compatible(usual, STREAM_QOS)[0] != QoSCompatibility.ERROR
    assert qos_check_compatible(OUTPUT_QOS, usual)[0] != QoSCompatibility.ERROR


# --- ros anchors ---


HALL = Anchors([7, 3], [[1, 2, 3], [4, 5, 6]], [[0, 0, 0.6, 0.8], [np.nan] * 4], frame="hall")


def test_anchors_survive_the_message():
    message = anchors_to_message(HALL)
    unknown = message.anchors[1].pose.orientation
    assert (unknown.x, unknown.y, unknown.z, unknown.w) == (0.0, 0.0, 0.0, 0.0)
    assert same_anchors(Anchors.from_message(message), HALL)
    message.header.frame_id = ""
    assert Anchors.from_message(message).frame == "map"


def test_what_has_changed_is_said_in_words():
    before = Anchors.from_positions(np.arange(12.0).reshape(4, 3), ids=[5, 6, 7, 8])
    after = Anchors.from_positions(
        np.vstack([before.positions[1:3], before.positions[3] + 1.0, [1.0, 1.0, 1.0]]),
        ids=[6, 7, 8, 9],
    )
    assert in_words(before, after) == "new: 9; gone: 5; elsewhere: 8; going on with the 2 that stay"
    assert (
        in_words(before, before.at(before.positions + 1.0))
        == "elsewhere: 5, 6, 7, 8; starting over"
    )
    assert (
        in_words(before, replace(after, frame="hall"))
        == "they are in frame 'hall', and were in 'map': starting over"
    )
    many = Anchors.from_positions(np.arange(60.0).reshape(20, 3), ids=np.arange(5, 25))
    assert (
        in_words(before, many)
        == "new: 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, ...; going on with the 4 that stay"
    )


def test_same_anchors_notices_every_difference_but_jitter():
    ids, positions, orientations = HALL.ids, HALL.positions, HALL.orientations
    for other in (
        Anchors([7, 4], positions, orientations, "hall"),
        Anchors(ids, positions + [[0, 0, 0], [0, 0, 0.02]], orientations, "hall"),
        Anchors(ids, positions, orientations[::-1], "hall"),
        Anchors(ids, positions, orientations, "map"),
        Anchors(ids[:1], positions[:1], orientations[:1], "hall"),
    ):
        assert not same_anchors(HALL, other)


def test_bad_anchors_are_refused():
    message = anchors_to_message(Anchors.from_positions(np.eye(3)))
    message.anchors[1].id = 0
    with pytest.raises(InputError, match="id 0 is given twice"):
        Anchors.from_message(message)
    message.anchors.clear()
    with pytest.raises(InputError, match="empty"):
        Anchors.from_message(message)


def test_anchors_need_a_publisher_that_keeps_them():
    assert qos_check_compatible(ANCHORS_QOS, ANCHORS_QOS)[0] != QoSCompatibility.ERROR
    assert qos_check_compatible(QoSProfile(depth=1), ANCHORS_QOS)[0] == QoSCompatibility.ERROR
    # They are compatible with repeated volatile anchors.
    assert qos_check_compatible(QoSProfile(depth=1), ANY_QOS)[0] != QoSCompatibility.ERROR


# --- ros log ---


class Written:
    """Stand in for a logger of rclpy."""

    def __init__(self):
        self.lines = []
        self.info = self.warning = self.error = self.lines.append


@pytest.fixture
def clock(monkeypatch):
    """Return the time that a Log reads, in s, as a list of one element."""
    now = [1000.0]
    monkeypatch.setattr(served.time, "monotonic", lambda: now[0])
    return now


def test_a_flood_hides_no_other_statement_and_is_counted(clock):
    written = Written()
    log = Log(written)
    for k in range(BURST + 11):
        if k == BURST + 10:
            log.error("another")
            clock[0] += 3.0 * REFILL
        log.info("flood")
    last = ["another", "flood (10 such lines were left out before)"]
    assert written.lines == ["flood"] * BURST + last


@pytest.mark.parametrize("severity", ["info", "warning", "error"])
def test_lines_are_printable_and_bounded(severity):
    written = Written()
    getattr(Log(written), severity)(
        "frame '\x1b]52;c;eA==\x07\n[ERROR] forged " + "x" * 100_000 + "'; correct it"
    )
    (line,) = written.lines
    assert line.isprintable() and len(line) < LINE_LENGTH + 20 and line.endswith("; correct it")


# --- ros diagnostics ---


def test_simulated_time_that_stands_still_or_is_missing_is_said():
    rclpy.init(args=["--ros-args", "-p", "use_sim_time:=true"])
    node, other = (
        rclpy.create_node("on_simulated_time"),
        rclpy.create_node("player", use_global_arguments=False),
    )
    try:
        wall = [0.0]
        clock, source = (
            SimulatedClock(node, lambda: wall[0]),
            other.create_publisher(Clock, "/clock", 10),
        )
        level, text = clock.status()
        assert level == DiagnosticStatus.WARN and "nobody publishes /clock" in text
        paused = DiagnosticStatus.OK, "paused: /clock stands still"
        for wall[0], second, expected in (
            (0.0, 5, None),
            (0.2, 6, None),
            (0.6, 6, None),
            (0.8, 6, paused),
            (9.0, 6, paused),
            (9.2, 7, None),
            (9.4, 7, None),
            # A clock with one step a second is running, too.
            (10.2, 8, None),
            (11.2, 9, None),
            (12.2, 9, None),
            (13.0, 9, None),
            (13.3, 9, paused),
        ):
            for _ in range(200):
                source.publish(Clock(clock=Time(sec=second)))
                rclpy.spin_once(node, timeout_sec=0.05)
                if node.get_clock().now().nanoseconds == second * 10**9:
                    break
            assert clock.status() == expected, wall
    finally:
        for each in (node, other):
            each.destroy_node()
        rclpy.shutdown()


def test_the_log_says_each_kind_of_thing_once_in_a_while():
    """A changing percentage once caused 38 warnings in 38 s."""
    log_filter = LogFilter()
    lines = [
        log_filter.should_log(
            f"{40 + second} % of the TDOAs of anchor 3 are late by {0.1 * second:.2f} s",
            1.0 * second,
        )
        for second in range(38)
    ]
    assert lines == [True] + 37 * [False]
    # A message about another anchor is new.
    assert log_filter.should_log("40 % of the TDOAs of anchor 4 are late by 0.10 s", 38.0)
    flips = [
        log_filter.should_log(
            ("running", "anchors 1 and 2 are exchanged")[second % 2], 40.0 + second
        )
        for second in range(20)
    ]
    assert flips == [True, True] + 18 * [False]
    assert log_filter.should_log("running", 75.0)  # a state that lasts is logged
    assert not log_filter.should_log("running", 200.0)


@pytest.mark.parametrize(
    "text",
    [
        "9" * 200_000,
        "9" * 200_000 + " m",
        "1.5 " * 50_000,
        "- " * 100_000,
        "9" + " " * 200_000,
        "9 " + "9" * 200_000 + "x",
    ],
)
@pytest.mark.usefixtures("must_end")
def test_the_time_for_a_long_number_does_not_grow_with_its_square(text):
    """A pattern that started again at each digit took 8 s for a text of a tenth of this length."""
    LogFilter().should_log(text, 0.0)


def test_ages_follow_simulated_time_at_any_speed():
    simulated = SimpleNamespace(nanoseconds=0)
    clock = SimpleNamespace(ros_time_is_active=True, now=lambda: simulated)
    elapsed = Elapsed(SimpleNamespace(get_clock=lambda: clock))
    assert elapsed() == 0.0
    for second, age in ((1000, 0.0), (1000.1, 0.1), (1000.1, 0.1), (900, 0.1), (900.5, 0.6)):
        simulated.nanoseconds = int(second * 1e9)
        assert elapsed() == pytest.approx(age, abs=1e-6)


# --- spinning ---

MANY = 300
DEEP = QoSProfile(depth=1000)


@pytest.fixture(params=["events", "single"])
def surroundings(request, monkeypatch):
    """Return (our node, another node), once with each of the executors."""
    if request.param == "single":
        monkeypatch.setattr(served, "EventsExecutor", None)
    elif served.EventsExecutor is None:
        pytest.skip("this rclpy has no EventsExecutor")
    rclpy.init()
    node, other = StreamNode("ours"), rclpy.create_node("other")
    yield node, other
    for each in (node, other):
        each.destroy_node()
    rclpy.shutdown()


def until(condition):
    """Wait for a condition without spinning a node."""
    end = time.monotonic() + 120.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def spin_until(spinner, condition):
    """Serve until condition() holds."""
    until(lambda: spinner._serve() or condition())


def test_nothing_waits_behind_what_comes_often(surroundings):
    node, other = surroundings
    flood, asked = [], []
    node.create_subscription(DiagnosticStatus, "flood", flood.append, DEEP)
    node.create_service(
        GetParameters, "ask", lambda request, response: asked.append(len(flood)) or response
    )
    publisher = other.create_publisher(DiagnosticStatus, "flood", DEEP)
    client = other.create_client(GetParameters, "ask")
    spinner = Spinner([node])
    until(lambda: publisher.get_subscription_count() and client.service_is_ready())
    spinner._serve()
    for _ in range(MANY):
        publisher.publish(DiagnosticStatus())
    assert publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=120.0))  # all of them wait
    client.call_async(GetParameters.Request())
    busy = []

    def answered():
        busy.append(len(flood) - sum(busy))
        return asked

    spin_until(spinner, answered)
    # Rounds that served something. With one callback in each round there are six times as many.
    assert sum(map(bool, busy)) < 50
    spin_until(spinner, lambda: len(flood) == MANY)
    spinner.close()


def test_what_waits_is_measured(surroundings):
    node, other = surroundings
    node.create_subscription(DiagnosticStatus, "slow", lambda _: time.sleep(0.3), DEEP)
    publisher, spinner = other.create_publisher(DiagnosticStatus, "slow", DEEP), Spinner([node])
    until(publisher.get_subscription_count)

    def nothing_waited():
        waited, spinner.longest_wait = spinner.longest_wait, 0.0
        return waited < 0.2

    # A loaded machine may have delayed this process in between.
    spin_until(spinner, nothing_waited)
    publisher.publish(DiagnosticStatus())
    spin_until(spinner, lambda: spinner.longest_wait > 0.25)
    spinner.close()


def pressures(node, take):
    """Return the Streams of a node with one stream."""
    streams = Streams(node, Epoch(), lambda: None)
    streams.add(CdrCodec(FluidPressure, "fluid_pressure"), "pressure", take)
    return streams


def test_streams_are_taken_together_and_the_newest_of_the_clock(surroundings):
    node, other = surroundings
    node.set_parameters([rclpy.Parameter("use_sim_time", value=True)])
    taken, stop = [], Future()

    def take(frame, t, rows, arrival):
        taken.append(len(t))
        if sum(taken) == MANY:
            stop.set_result(None)

    streams = pressures(node, take)
    publisher = other.create_publisher(FluidPressure, "pressure", DEEP)
    clock = other.create_publisher(Clock, "/clock", DEEP)
    until(lambda: publisher.get_subscription_count() and clock.get_subscription_count())
    assert not {Clock, FluidPressure} & {each.msg_type for each in node.subscriptions}
    spinner = Spinner([node], StreamPoller([streams.take]))
    spinner._serve()
    for second in range(1, MANY + 1):
        publisher.publish(FluidPressure())
        clock.publish(Clock(clock=Time(sec=second)))
    spinner.spin(stop)
    assert sum(taken) == MANY and len(taken) < MANY / 3

    def is_newest():
        node.take_clock()
        return node.get_clock().now().nanoseconds == MANY * 10**9

    until(is_newest)
    spinner.close()


def test_a_stream_that_begins_after_a_silence_is_taken(surroundings):
    node, other = surroundings
    stop, heard = Future(), []

    def take(frame, t, rows, arrival):
        heard.append(time.time() - arrival[0])
        stop.set_result(None)

    streams = pressures(node, take)
    publisher = other.create_publisher(FluidPressure, "pressure", DEEP)
    until(publisher.get_subscription_count)
    # The process sleeps in its executor until then.
    node.create_timer(0.1, lambda: publisher.publish(FluidPressure()))
    spinner = Spinner([node], StreamPoller([streams.take]))
    spinner.spin(stop)
    assert 0.0 <= heard[0] < 60.0
    spinner.close()


def test_messages_that_a_full_queue_drops_are_counted(surroundings, monkeypatch):
    node, other = surroundings
    monkeypatch.setattr(topics, "STREAM_QOS", QoSProfile(depth=5))
    taken = []
    streams = pressures(node, lambda frame, t, rows, arrival: taken.extend(t))
    first = other.create_publisher(FluidPressure, "pressure", DEEP)
    until(first.get_subscription_count)

    def publish(publisher, count):
        for _ in range(count):
            publisher.publish(FluidPressure())
        assert publisher.wait_for_all_acked(rclpy.duration.Duration(seconds=120.0))
        until(lambda: streams.take(True))

    publish(first, 1)
    publish(first, 50)
    end = streams.inputs["pressure"]
    until(lambda: streams.take(True) or end.lost + len(taken) == 51)
    assert end.lost == 45 and len(taken) == 6
    assert "45 of 51 messages on pressure were lost" in end.trouble(6)
    second = other.create_publisher(FluidPressure, "pressure", DEEP)
    until(lambda: end.get_publisher_count() == 2)
    for publisher in (second, first, second):  # their numbers have nothing to do with each other
        publish(publisher, 1)
    assert end.lost == 45 and "2 publish on pressure" in end.trouble(3)


def test_turns_rest_as_long_as_they_took_and_only_if_there_was_something():
    def rest(*streams):
        """Return the rest after a turn with streams (duration in s, whether anything arrived)."""
        takes = [lambda one=one: time.sleep(one[0]) or one[1] for one in streams]
        return StreamPoller(takes).take()

    assert rest((0.0, False)) is None
    assert PERIOD <= rest((0.0, True), (0.0, False)) <= 0.01  # upper limit for a busy computer
    assert 0.004 <= rest((0.005, True)) <= 0.01
    assert rest((0.05, True)) == 0.01


def test_a_flood_of_requests_does_not_keep_streams_waiting(surroundings, monkeypatch):
    node, other = surroundings
    spinner, asked, given = Spinner([node]), [], node.get_parameter
    monkeypatch.setattr(node, "get_parameter", lambda name: asked.append(name) or given(name))
    client = other.create_client(GetParameters, "/ours/get_parameters", qos_profile=DEEP)
    until(client.service_is_ready)
    for _ in range(500):
        client.call_async(GetParameters.Request(names=["use_sim_time"] * MOST_ASKED))
    client.call_async(GetParameters.Request(names=["use_sim_time"] * (MOST_ASKED + 1)))
    spin_until(spinner, lambda: asked)
    counts = [0, len(asked)]
    for _ in range(10):
        spinner._serve()
        counts.append(len(asked))
    steps = np.diff(counts)
    assert 0 < max(steps) <= MOST_REQUESTS * MOST_ASKED and not (steps % MOST_ASKED).any()
    spinner.close()
