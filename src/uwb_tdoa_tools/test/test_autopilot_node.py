# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""autopilot_node as a process: the messages to PX4 over loopback, parsed by pymavlink."""

import pathlib
import re
import sys
import time

import numpy as np
import pytest
import yaml

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg", reason="needs the built workspace: ./dev build")

from autopilots import (  # noqa: E402
    Path,
    Px4,
    at_rest,
    bench,
    numbers,
    numbers_of_mavlink,
    usec,
)
from nav_msgs.msg import Odometry  # noqa: E402

from uwb_tdoa_bias.common.errors import InputError  # noqa: E402
from uwb_tdoa_bias.ros.topics import OUTPUT_QOS  # noqa: E402
from uwb_tdoa_msgs.msg import EstimatorStatus  # noqa: E402
from uwb_tdoa_tools.autopilot.estimate import CROWD  # noqa: E402
from uwb_tdoa_tools.autopilot_node import PARAMETERS, AutopilotNode  # noqa: E402

CONFIG = pathlib.Path(__file__).resolve().parents[1] / "config" / "autopilot_node.yaml"
BODY_FRD, LOCAL_FRD, VIO, STANDBY = 12, 20, 3, 3
RUNNING, LOST = EstimatorStatus.STATUS_RUNNING, EstimatorStatus.STATUS_LOST
FLIP = np.diag([1.0, -1.0, -1.0])  # forward, left, up to forward, right, down
RATE = 50.0


def test_every_parameter_is_in_the_parameter_file_with_its_default():
    (written,) = (entry["ros__parameters"] for entry in yaml.safe_load(CONFIG.read_text()).values())
    assert written == {name: parameter.default for name, parameter in PARAMETERS.items()}


@pytest.mark.parametrize(
    "given, why",
    [
        (["log:=[imu]"], "log: only a Crazyflie has log blocks; set protocol to crazyflie."),
        (["log:=[sonar]"], "log: 'sonar' is not one of tdoa, imu, height, pressure."),
        (["protocol:=mavlink"], "connection: '' is none of udpout:HOST:PORT"),
        (
            ["protocol:=mavlink", "connection:=udpin:127.0.0.1:1", "origin:=[95.0, 8.0, 400.0]"],
            "origin: [95.0, 8.0, 400.0] is no latitude, longitude (deg) and altitude (m).",
        ),
        # pymavlink would run this program, or read this file
        (["protocol:=mavlink", "connection:=/home/me/a.elf"], "'/home/me/a.elf' is none of"),
        (["protocol:=mavlink", "connection:=flight.log"], "'flight.log' is none of"),
        (["protocol:=crazyflie", "connection:=cf1"], "'cf1' is no address of a Crazyflie"),
    ],
)
def test_what_cannot_be_meant_is_refused(given, why):
    words = [word for value in given for word in ("-p", value)]
    rclpy.init(args=["--ros-args", *words])
    try:
        with pytest.raises(InputError, match=re.escape(why)):
            AutopilotNode()
    finally:
        rclpy.shutdown()


def test_a_port_that_is_not_there_is_named():
    pytest.importorskip("pymavlink")
    connection = "connection:=/dev/autopilot_that_is_not_there"
    rclpy.init(args=["--ros-args", "-p", "protocol:=mavlink", "-p", connection])
    try:
        with pytest.raises(InputError, match="cannot be opened|pip install pymavlink pyserial"):
            AutopilotNode()
    finally:
        rclpy.shutdown()


@pytest.mark.parametrize(
    "protocol, connection, package",
    [
        ("mavlink", "udpout:127.0.0.1:14540", "pymavlink"),
        ("crazyflie", "radio://0/80/2M/E7E7E7E7E7", "cflib"),
    ],
)
def test_a_package_that_is_missing_is_named_with_the_remedy(
    monkeypatch, protocol, connection, package
):
    for name in [package, *sys.modules]:
        if name.partition(".")[0] == package:
            monkeypatch.setitem(sys.modules, name, None)
    words = ["-p", f"protocol:={protocol}", "-p", f"connection:={connection}"]
    rclpy.init(args=["--ros-args", *words])
    try:
        with pytest.raises(InputError, match=f"needs the Python package {package}.*pip install"):
            AutopilotNode()
    finally:
        rclpy.shutdown()


def nees(error, covariance):
    return error @ np.linalg.solve(covariance, error)


@pytest.mark.slow
def test_px4_gets_a_flight_and_silence_when_it_is_lost():
    pytest.importorskip("pymavlink")
    px4, path = Px4(), Path(6.0)
    try:
        with bench(px4.receive) as rig:
            rig.start("protocol:=mavlink", f"connection:=udpout:{px4.address}", f"rate:={RATE}")
            rig.wait(lambda: px4.beats, "heartbeat of the node")
            assert (px4.beats[0].get_srcSystem(), px4.beats[0].get_srcComponent()) == (1, 197)
            rig.wait(lambda: "no heartbeat comes" in rig.text, "complaint")
            _open(rig, px4)
            _check_stream(px4, path, _play(rig, px4, path))
            _check_time(rig, px4)
            _check_jump(rig, px4)
            _check_silence(rig, px4)
            _check_second_publisher(rig, px4)
            rig.wait(lambda: len(rig.gated) == len(px4.odometry), "odometry/gated")
            assert [usec(message) for message in rig.gated] == [m.time_usec for m in px4.odometry]
            assert rig.end() == 0
        assert not [line for line in rig.lines if "Traceback" in line]
    finally:
        px4.close()


def _open(rig, px4):
    """Check that messages start only after a status."""
    rig.publish(at_rest(20))
    rig.settle()
    assert px4.odometry == [] and rig.values["passed"] == "0"
    rig.tell(RUNNING)

    def came():
        rig.publish(at_rest(1))
        px4.beat()
        return px4.odometry

    rig.wait(came, "ODOMETRY")
    rig.wait(lambda: px4.beat() or rig.values.get("autopilot") == "PX4", "autopilot")

    def is_good():
        rig.publish(at_rest(1))
        px4.beat()
        return rig.text == "the autopilot gets odometry"

    rig.wait(is_good, "good report")
    rig.settle()


def _play(rig, px4, path):
    """Publish a Path in real time as a new stream, and return its messages."""
    px4.receive()
    px4.odometry.clear()
    rig.gated.clear()
    played = path.messages(time.time() + 0.5)
    waiting = list(played)

    def is_over():
        now = 1e6 * time.time()
        while waiting and usec(waiting[0]) <= now:
            rig.publish([waiting.pop(0)])
        return not waiting

    rig.wait(is_over, "the end of the flight")
    rig.settle()
    rig.wait(lambda: len(px4.odometry) == len(rig.gated), "all ODOMETRY")
    return played


def _check_stream(px4, path, played):
    seconds = 1e-6 * (px4.odometry[-1].time_usec - px4.odometry[0].time_usec)
    assert (len(px4.odometry) - 1) / seconds == pytest.approx(RATE, rel=0.02)
    assert seconds == pytest.approx(np.ptp(path.t), abs=0.05)
    assert len({message.reset_counter for message in px4.odometry}) == 1
    places = {usec(message): k for k, message in enumerate(played)}
    yaws = []
    for message in px4.odometry:
        assert (message.frame_id, message.child_frame_id) == (LOCAL_FRD, BODY_FRD)
        assert message.estimator_type == VIO
        k = places[message.time_usec]
        p, turn, v, w, pose, twist = numbers(played[k])
        q, other, u, rates, pose_of_it, twist_of_it = numbers_of_mavlink(message)
        tolerance = dict(rtol=2e-5, atol=2e-6)  # of floats
        np.testing.assert_allclose(q, FLIP @ p, **tolerance)
        np.testing.assert_allclose(other.as_matrix(), FLIP @ turn.as_matrix() @ FLIP, atol=1e-6)
        np.testing.assert_allclose(u, FLIP @ v, **tolerance)
        np.testing.assert_allclose(rates, FLIP @ w, **tolerance)
        error = p - path.truth[k]
        theirs = q - FLIP @ path.truth[k]
        expected = nees(error, pose[:3, :3])
        assert nees(theirs, pose_of_it[:3, :3]) == pytest.approx(expected, rel=1e-3)
        whole = nees(np.r_[FLIP @ v, FLIP @ w], twist_of_it)
        assert whole == pytest.approx(nees(np.r_[v, w], twist), rel=1e-3)
        deviation = 100.0 * np.sqrt(pose.diagonal()[:3].max())
        assert message.quality == 100 - round(deviation)
        # as PX4 sees it: it climbs, nose up, and flies in the direction of its nose
        assert message.vz < 0.0 < other.as_euler("ZYX")[1] and message.vx > 0.7
        yaws.append(other.as_euler("ZYX")[0])
    assert np.ptp(np.unwrap(yaws)) == pytest.approx(0.8 * seconds, rel=0.01)
    assert yaws[1] < yaws[0]  # a left turn, negative in the frame of PX4
    assert px4.odometry[-1].z == pytest.approx(px4.odometry[0].z - 0.2 * seconds, rel=1e-4)


def _check_time(rig, px4):
    before = time.time_ns()
    px4.port.mav.timesync_send(0, 12345)
    rig.wait(lambda: px4.answers, "an answer to TIMESYNC")
    (answer,) = px4.answers
    assert answer.ts1 == 12345 and before < answer.tc1 < time.time_ns()
    px4.port.mav.timesync_send(answer.tc1, answer.ts1)  # an answer gets no answer
    rig.wait(lambda: rig.values.get("TIMESYNC answered") == "1", "the count")


def _check_jump(rig, px4):
    """Check a jump by 2 m between two messages, as from a recovery or reset of the filter."""
    count = len(px4.odometry)
    rig.publish(at_rest(20, jump=2.0))
    rig.settle()
    px4.receive()
    new = px4.odometry[count:]
    assert len(new) in (5, 6)  # 0.1 s; plus one because a jump is sent at once
    for message in new:
        after = message.x > new[0].x + 1.0
        assert message.reset_counter == (new[0].reset_counter + after) % 256
    assert new[-1].x - new[0].x == pytest.approx(2.0, abs=1e-5)


def _check_second_publisher(rig, px4):
    """Check that nothing is sent while two nodes publish odometry, and that it goes on with one."""
    second = rig.node.create_publisher(Odometry, "odometry", OUTPUT_QOS)

    def is_silent():
        rig.publish(at_rest(1))
        px4.beat()
        return CROWD in rig.text

    rig.wait(is_silent, "silence")
    rig.settle()
    px4.receive()
    count, before = len(px4.odometry), px4.odometry[-1].reset_counter
    second.publish(at_rest(1)[0])
    rig.sent += 1
    rig.publish(at_rest(60))
    rig.settle()
    px4.receive()
    assert len(px4.odometry) == count and rig.values["publishers of odometry"] == "2"
    rig.node.destroy_publisher(second)
    _wait_for_more(rig, px4)
    assert {message.reset_counter for message in px4.odometry[count:]} == {(before + 1) % 256}


def _wait_for_more(rig, px4):
    """Publish odometry until the autopilot gets some of it."""
    count = len(px4.odometry)

    def came():
        rig.publish(at_rest(1))
        return len(px4.odometry) > count

    rig.wait(came, "ODOMETRY")
    rig.settle()
    px4.receive()


def _check_silence(rig, px4):
    """Check that nothing is sent to the autopilot while odometry continues but the tag is lost."""
    rig.tell(LOST, why="the tag is lost")

    def is_silent():
        rig.publish(at_rest(1))
        px4.beat()
        return rig.text == "nothing is sent to the autopilot: the tag is lost"

    rig.wait(is_silent, "silence")
    words = "nothing is sent to the autopilot: the tag is lost"
    rig.wait(lambda: "".join(one.text for one in px4.texts).endswith(words), "STATUSTEXT")
    rig.wait(lambda: px4.beats[-1].system_status == STANDBY, "heartbeat of a silent node")
    rig.settle()
    px4.receive()
    count, before = len(px4.odometry), px4.odometry[-1].reset_counter
    rig.publish(at_rest(60))
    rig.settle()
    px4.receive()
    assert len(px4.odometry) == count
    rig.tell(RUNNING)
    _wait_for_more(rig, px4)
    assert px4.odometry[count].reset_counter == (before + 1) % 256
