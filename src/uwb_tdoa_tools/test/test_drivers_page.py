# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The publishers of docs/drivers.md.

The Python publisher runs as a process, over topics. The C++ publisher is compiled against the
messages.
"""

import os
from pathlib import Path
import shutil
import signal
import time

from documented import blocks, section
import numpy as np
from programs import run, start
import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy  # noqa: E402
from sensor_msgs.msg import Imu  # noqa: E402

from uwb_tdoa_bias.common.anchors import Anchors  # noqa: E402
from uwb_tdoa_msgs.msg import AnchorArray, Tdoa  # noqa: E402

pytestmark = pytest.mark.slow  # starts publishers

STAND_IN = """
#pragma once
#include <builtin_interfaces/msg/time.hpp>
#include <memory>
#include <string>
namespace rclcpp {
struct Time { operator builtin_interfaces::msg::Time() const { return {}; } };
struct QoS { QoS(size_t) {} QoS & transient_local() { return *this; } };
template<typename T> struct Publisher {
  using SharedPtr = std::shared_ptr<Publisher>;
  void publish(const T &) {}
};
struct Node {
  explicit Node(const std::string &) {}
  template<typename T> typename Publisher<T>::SharedPtr create_publisher(const std::string &, const QoS &) { return {}; }
};
}
"""


@pytest.fixture
def listener():
    rclpy.init()
    node = rclpy.create_node("listener")
    yield node
    node.destroy_node()
    rclpy.shutdown()


def test_the_publisher_in_python(tmp_path, listener):
    """Subscribe reliably, as most subscribers do, after the anchors were sent."""
    (tmp_path / "driver.py").write_text(*blocks(section("drivers.md", "In Python"), "python"))
    process = start(tmp_path / "driver.py")
    try:
        imu, tdoas, surveys = [], [], []
        once = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        reliable = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
        listener.create_subscription(Imu, "imu/data", imu.append, reliable)
        listener.create_subscription(Tdoa, "uwb/tdoa", tdoas.append, reliable)
        end = time.monotonic() + 180.0
        while not (len(imu) > 100 and len(tdoas) > 8 and surveys):
            if tdoas and not listener.get_subscriptions_info_by_topic("uwb/anchors"):
                listener.create_subscription(AnchorArray, "uwb/anchors", surveys.append, once)
            assert process.poll() is None and time.monotonic() < end, process.poll()
            rclpy.spin_once(listener, timeout_sec=0.1)
    finally:
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=120)
    anchors = Anchors.from_message(surveys[0])
    assert len(anchors) == 4 and anchors.frame == "map" and np.isnan(anchors.orientations).all()
    assert all(message.linear_acceleration.z == pytest.approx(9.81, abs=0.2) for message in imu)
    for message in tdoas:
        ends = [anchors.positions[anchors.row(k)] for k in (message.anchor_a, message.anchor_b)]
        to_a, to_b = np.linalg.norm([3.0, 4.0, 1.0] - np.array(ends), axis=1)
        assert message.distance_difference == pytest.approx(to_b - to_a, abs=0.4)


def test_the_recipe_for_stamps_follows_a_drifting_clock_by_the_smallest_delay():
    code, names = blocks(section("drivers.md", "Stamps"), "python"), {}
    exec(*code, names)
    clock, rng = names["DeviceClock"](), np.random.default_rng(1)
    true = np.arange(0.0, 300.0, 0.01)
    device = 123.0 + (1 + 20e-6) * true
    arrival = true + 0.002 + rng.exponential(0.01, len(true))
    late = np.array([clock.stamp(*one) for one in zip(device, arrival)]) - true
    assert 0.0015 < late[500:].min() and late[500:].max() < 0.003


@pytest.mark.skipif(shutil.which("g++") is None, reason="no g++")
def test_the_publisher_in_cpp(tmp_path):
    (code,) = blocks(section("drivers.md", "In C++"), "cpp")
    (tmp_path / "rclcpp").mkdir()
    (tmp_path / "rclcpp" / "rclcpp.hpp").write_text(STAND_IN)
    (tmp_path / "driver.cpp").write_text(code + "\nint main() { Driver driver; }\n")
    folders = {
        folder
        for prefix in os.environ["AMENT_PREFIX_PATH"].split(os.pathsep)
        for folder in Path(prefix, "include").glob("*/")
    }
    paths = [word for folder in sorted(folders) for word in ("-I", folder)]
    command = ["g++", "-std=c++17", "-fsyntax-only", "-Wall", "-I", tmp_path, *paths]
    done = run(*command, tmp_path / "driver.cpp")
    assert done.returncode == 0, done.stderr[:2000]
