# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Live checks of topics that real processes publish."""

import json
import signal
import subprocess
import sys

import numpy as np
import pytest
from recordings import small_flight

from uwb_tdoa_tools.bags.bag import write_bag
from uwb_tdoa_tools.checking.recording import read_live, read_recording
from uwb_tdoa_tools.commands.check import main
from uwb_tdoa_tools.readers.inputs import Reading

FAULTY = """
import rclpy, tf2_msgs.msg, geometry_msgs.msg, sensor_msgs.msg, std_msgs.msg, uwb_tdoa_msgs.msg
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, DurabilityPolicy, ReliabilityPolicy
rclpy.init()
driver, logger = rclpy.create_node("driver", namespace="tag1"), rclpy.create_node("logger", namespace="tag1")
poor = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
imu = driver.create_publisher(sensor_msgs.msg.Imu, "imu/data", poor)
tdoa = driver.create_publisher(uwb_tdoa_msgs.msg.Tdoa, "ranging", 100)
anchors = driver.create_publisher(uwb_tdoa_msgs.msg.AnchorArray, "uwb/anchors", 1)
static = driver.create_publisher(tf2_msgs.msg.TFMessage, "/tf_static", QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL))
place = geometry_msgs.msg.TransformStamped(child_frame_id="imu_link")
place.header.frame_id, place.transform.rotation.x, place.transform.rotation.w = "base_link", 1.0, 0.0  # upside down
static.publish(tf2_msgs.msg.TFMessage(transforms=[place]))
logger.create_subscription(sensor_msgs.msg.Imu, "imu/data", print, 10)  # reliable
survey, rows = uwb_tdoa_msgs.msg.AnchorArray(), [(0.0, 0.0, 0.0), (5.0, 0.0, 3.0), (0.0, 5.0, 3.0), (5.0, 5.0, 0.0)]
for k, (x, y, z) in enumerate(rows):
    anchor = uwb_tdoa_msgs.msg.Anchor(id=k)
    anchor.pose.position.x, anchor.pose.position.y, anchor.pose.position.z = x, y, z
    survey.anchors.append(anchor)
step = 0
def tick():
    global step
    step += 1
    header = std_msgs.msg.Header(stamp=driver.get_clock().now().to_msg(), frame_id="imu_link")
    force = geometry_msgs.msg.Vector3(x=0.01 * (step % 3), z=-1.0 + 0.01 * (step % 2))
    imu.publish(sensor_msgs.msg.Imu(header=header, linear_acceleration=force))
    header.frame_id = "base_link"
    tdoa.publish(uwb_tdoa_msgs.msg.Tdoa(header=header, anchor_a=step % 4, anchor_b=(step + 1) % 4, distance_difference=0.001 * (step % 7)))
    if step % 20 == 0:
        anchors.publish(survey)
driver.create_timer(0.01, tick)
executor = SingleThreadedExecutor()
executor.add_node(driver), executor.add_node(logger)
executor.spin()
"""


@pytest.fixture
def process():
    """Return process(command), which starts a process. It is interrupted at the end of the test."""
    started = []

    def start(*command):
        started.append(
            subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        )
        return started[-1]

    yield start
    for each in started:
        each.send_signal(signal.SIGINT)
        each.communicate(timeout=120)


@pytest.mark.slow
def test_mistakes_of_a_live_driver_are_found(tmp_path, process, capsys, monkeypatch):
    pytest.importorskip("uwb_tdoa_msgs.msg")
    process(sys.executable, "-c", FAULTY)
    listen = pytest.importorskip("uwb_tdoa_tools.live.session")
    monkeypatch.setattr(listen, "FIRST_LIMIT", 180.0)
    out = tmp_path / "live.json"
    code = main(
        ["--live", "3", "--namespace", "tag1", "--topic", "uwb/tdoa=ranging", "--json", str(out)]
    )
    said = capsys.readouterr()
    assert code == 1, said
    (content,) = json.loads(out.read_text())["recordings"]
    found = {finding["rule"]: finding for finding in content["findings"]}
    assert {
        "imu_force_unit",
        "frame_turned",
        "qos_unmatched",
        "anchors_volatile",
    } <= found.keys(), said.out
    assert (
        "/tag1/logger hears nothing of what /tag1/driver publishes"
        in found["qos_unmatched"]["cause"]
    )
    assert not {"imu_turned", "stamps_apart", "other_clock", "frame_unknown"} & found.keys(), (
        said.out
    )
    assert "/tag1/imu/data from /tag1/driver: best effort, volatile" in said.out
    assert (
        1.0 < float(content["facts"]["duration"].split()[0]) < 9.0
    )  # 3 s of clock time; the driver may start late


@pytest.mark.slow
def test_live_streams_equal_the_recording(tmp_path, process, monkeypatch):
    """Live samples equal the recorded samples exactly, so the rules find the same.

    The recording is played on simulated time. The check receives the first part.
    """
    pytest.importorskip("uwb_tdoa_msgs.msg")
    listen = pytest.importorskip("uwb_tdoa_tools.live.session")
    monkeypatch.setattr(listen, "FIRST_LIMIT", 180.0)
    flight = small_flight(4.0)
    write_bag(flight, tmp_path / "flight.bag")
    topics = ("--wait-matched", "180", "--wait-topics", "uwb/tdoa", "imu/data", "uwb/anchors")
    replay = (
        "-m",
        "uwb_tdoa_tools.main",
        "replay",
        tmp_path / "flight.bag",
        "--rate",
        "0.1",
        "--clock",
        "100",
    )
    process(sys.executable, *replay, *topics)
    live, whole = read_live(Reading(), 1.5), read_recording(Reading(), tmp_path / "flight.bag")
    for stream, there in ((live.tdoa, whole.tdoa), (live.imu, whole.imu)):
        assert (
            10 < len(stream) < len(there) and stream.t[0] == there.t[0]
        )  # no sample is lost after the first one
        for name, column in vars(stream).items():
            np.testing.assert_array_equal(column, getattr(there, name)[: len(stream)])
    # stamps are in simulated time
    assert np.isnan(live.tdoa_arrival).all() and np.isnan(live.imu_arrival).all()
    assert (
        np.array_equal(live.anchors.positions, whole.anchors.positions)
        and live.frames.keys() == whole.frames.keys()
    )
    assert {end.topic for end in live.ends} >= {"/uwb/tdoa", "/imu/data", "/uwb/anchors"}


def test_topics_without_a_publisher_are_an_error(capsys, monkeypatch):
    listen = pytest.importorskip("uwb_tdoa_tools.live.session")
    monkeypatch.setattr(listen, "FIRST_LIMIT", 0.3)
    assert main(["--live", "3", "--namespace", "nowhere"]) == 2
    assert "no message on /nowhere/uwb/tdoa" in capsys.readouterr().err
