# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Reconstruct streams from the sampled and late messages of a Crazyflie's radio.

The example node runs on the same messages.
"""

from dataclasses import replace
import json
import signal
import subprocess
import sys

from documented import ROOT
import numpy as np
from programs import python
import pytest

from studies.crazyflie import BLOCKS, Link, judge, messages, streamed
from uwb_tdoa_tools.crazyflie import PERIOD, LogBlock
from uwb_tdoa_tools.simulation import SimulationConfig, simulate


@pytest.fixture(scope="module")
def flight():
    rates = dict(duration=12.0, imu_rate=500.0, truth_rate=50.0)
    return simulate(SimulationConfig(seed=1, outlier_probability=0.0, start_in_air=True, **rates))


def test_what_comes_out_was_measured_and_in_time(flight):
    made, late = streamed(flight, Link()), []
    for t, a, b, d in zip(made.tdoa.t, made.tdoa.a, made.tdoa.b, made.tdoa.d):
        rows = np.flatnonzero((flight.tdoa.a == a) & (flight.tdoa.b == b))
        row = rows[np.argmin(np.abs(flight.tdoa.d[rows] - d))]
        assert abs(flight.tdoa.d[row] - d) < 1e-6
        late.append(t - flight.tdoa.t[row])
    assert np.median(late) == pytest.approx(Link().latency, abs=0.003)
    assert np.ptp(late) < 2.0 * PERIOD and 0.7 < len(made.tdoa) / len(flight.tdoa) <= 1.0
    assert 1.0 / np.median(np.diff(made.imu.t)) == pytest.approx(1.0 / PERIOD, rel=0.1)


def test_the_estimate_loses_little(flight):
    found = {way: error for way, (*_, error) in judge(flight).items()}
    direct = found["log as it is, 1 kHz IMU"]
    assert max(found["link, half floats"], found["link, 5 % lost"]) < direct + 0.03


PLAYER = """
import json, sys, time, rclpy
from crazyflie_interfaces.msg import LogDataGeneric
from rclpy.qos import QoSProfile
from sensor_msgs.msg import Imu
from uwb_tdoa_msgs.msg import Tdoa

rclpy.init()
node = rclpy.create_node("player")
tdoas, samples, hellos, deep = [], [], [], QoSProfile(depth=20000)
seconds = lambda m: m.header.stamp.sec + 1e-9 * m.header.stamp.nanosec
sent = json.load(open(sys.argv[1]))
late = sent[-1][0] + 10.0  # when a message arrives that tells whether the node knows us; of its delay no clock learns anything
node.create_subscription(Tdoa, "uwb/tdoa", tdoas.append, deep)
node.create_subscription(Imu, "imu/data", lambda m: (samples if seconds(m) < late - 5.0 else hellos).append(m), deep)
topics = [node.create_publisher(LogDataGeneric, name, deep) for name in ("tdoa_a", "tdoa_b", "imu")]

def publish(arrival, block, timestamp, values):
    message = LogDataGeneric(timestamp=timestamp, values=values)
    message.header.stamp.sec, message.header.stamp.nanosec = int(arrival), int(1e9 * (arrival % 1.0))
    topics[block].publish(message)

def wait(condition, seconds=180.0):
    until = time.monotonic() + seconds
    while not condition() and time.monotonic() < until:
        rclpy.spin_once(node, timeout_sec=0.1)
    return condition()

wait(lambda: all(topic.get_subscription_count() for topic in topics))
hello = next(message for message in sent if message[1] == 2)
while not wait(lambda: hellos, 1.0):
    publish(late, *hello[1:4])
for *message, answers in sent:  # in order over all topics: the next goes when all answers have come
    publish(*message)
    assert wait(lambda: len(tdoas) + len(samples) >= answers), (len(tdoas), len(samples), answers)
rows = [(seconds(m), m.anchor_a, m.anchor_b, m.distance_difference) for m in tdoas]
print(json.dumps({"tdoas": rows, "samples": [(seconds(m), m.linear_acceleration.z) for m in samples]}))
"""
CMAKE = """
cmake_minimum_required(VERSION 3.8)
project(crazyflie_interfaces)
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
find_package(std_msgs REQUIRED)
rosidl_generate_interfaces(${PROJECT_NAME} msg/LogDataGeneric.msg DEPENDENCIES std_msgs)
ament_package()
"""


@pytest.mark.slow
def test_the_example_over_topics_gives_what_the_converter_gives(flight, tmp_path):
    """With a LogDataGeneric as crazyswarm2 defines it, built for the test."""
    pytest.importorskip("rclpy")
    pytest.importorskip("colcon_core")
    package = tmp_path / "src" / "crazyflie_interfaces"
    (package / "msg").mkdir(parents=True)
    (package / "msg" / "LogDataGeneric.msg").write_text(
        "std_msgs/Header header\nuint32 timestamp\nfloat32[] values\n"
    )
    (package / "CMakeLists.txt").write_text(CMAKE)
    ours = (ROOT / "src" / "uwb_tdoa_msgs" / "package.xml").read_text()
    without = "".join(line for line in ours.splitlines(True) if "geometry_msgs" not in line)
    (package / "package.xml").write_text(without.replace("uwb_tdoa_msgs", "crazyflie_interfaces"))
    build = ["-m", "colcon", "--log-base", "log", "build", "--merge-install", "--cmake-args"]
    python(*build, f"-DPython3_EXECUTABLE={sys.executable}", cwd=tmp_path, check=True)
    short, link = (
        replace(flight, tdoa=_until(flight.tdoa, 4.0), imu=_until(flight.imu, 4.0)),
        Link(),
    )
    blocks, sent, answers = [LogBlock(variables) for variables in BLOCKS], [], 0
    for arrival, number, timestamp, values in messages(short, link, np.random.default_rng(0)):
        pairs, sample = blocks[number].take(timestamp, values)
        answers += len(pairs) + (sample is not None)
        sent.append((arrival, number, int(timestamp), values.tolist(), answers))
    (tmp_path / "sent.json").write_text(json.dumps(sent))
    (tmp_path / "player.py").write_text(PLAYER)
    # Not by `node & kill -INT $!` of a shell, which has SIGINT ignored in the background: rclpy
    # then wakes the node before it ends its context. A node that waits again in between waits
    # forever.
    with (
        _python(tmp_path, ROOT / "docs/connect/crazyflie_node.py") as node,
        _python(tmp_path, "player.py", "sent.json") as player,
    ):
        try:
            out, error = player.communicate(timeout=600)
            node.send_signal(signal.SIGINT)
            assert (error, *node.communicate(timeout=60), node.returncode) == ("", "", "", 0)
        finally:
            node.kill()
            player.kill()
    got, expected = json.loads(out), streamed(short, link)
    t, a, b, d = (np.array(column) for column in zip(*sorted(got["tdoas"])))
    assert len(t) == len(expected.tdoa) and len(got["samples"]) == len(expected.imu)
    np.testing.assert_allclose(np.sort(t), np.sort(expected.tdoa.t), atol=1e-6)
    np.testing.assert_allclose(np.sort(d), np.sort(expected.tdoa.d), atol=1e-9)
    assert np.mean([z for _, z in got["samples"]]) == pytest.approx(
        expected.imu.accel[:, 2].mean(), abs=1e-6
    )


def _python(folder, *words):
    """A running Python that knows the messages built in a folder."""
    command = [
        "bash",
        "-c",
        'source install/local_setup.bash; exec "$@"',
        "bash",
        sys.executable,
        *map(str, words),
    ]
    return subprocess.Popen(
        command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def _until(stream, length):
    rows = stream.t < stream.t[0] + length
    return type(stream)(*(column[rows] for column in vars(stream).values()))
