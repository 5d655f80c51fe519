# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0

import time
from unittest.mock import Mock

import pytest

rclpy = pytest.importorskip("rclpy")

from builtin_interfaces.msg import Time  # noqa: E402
from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
import numpy as np  # noqa: E402
from rcl_interfaces.srv import GetParameters  # noqa: E402
from rclpy.qos import QoSProfile  # noqa: E402
from rclpy.task import Future  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import FluidPressure  # noqa: E402

from uwb_tdoa_bias.ros import node as served  # noqa: E402
from uwb_tdoa_bias.ros.cdr import CdrCodec  # noqa: E402
from uwb_tdoa_bias.ros.node import (  # noqa: E402
    PERIOD,
    Spinner,
    StreamNode,  # noqa: E402
    StreamPoller,
)
from uwb_tdoa_bias.ros.parameters import MOST_ASKED, MOST_REQUESTS  # noqa: E402
from uwb_tdoa_bias.ros.topics import Epoch, Streams  # noqa: E402

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
    spinner = Spinner([node], StreamPoller([streams]))
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
    spinner = Spinner([node], StreamPoller([streams]))
    spinner.spin(stop)
    assert 0.0 <= heard[0] < 60.0
    spinner.close()


def test_turns_rest_as_long_as_they_took_and_only_if_there_was_something():
    def rest(*streams):
        """Return the rest after a turn with streams (duration in s, whether anything arrived)."""
        taking = [Mock(take=lambda one=one: time.sleep(one[0]) or one[1]) for one in streams]
        return StreamPoller(taking).take()

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
