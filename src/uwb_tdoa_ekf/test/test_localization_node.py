"""Both nodes of several tags in one process."""

import re
import subprocess
import sys

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from nav_msgs.msg import Odometry  # noqa: E402
from rig import make_rig, recording  # noqa: E402, F401
from uwb_tdoa_ekf.localization_node import _for_all  # noqa: E402


def test_what_is_for_all_nodes_of_the_process():
    arguments = ["x", "--ros-args", "-r", "__ns:=/a", "-p", "lag:=0.2", "--remap", "__node:=y", "-r", "imu/data:=/imu"]
    assert _for_all(arguments) == ["x", "--ros-args", "-p", "lag:=0.2", "-r", "imu/data:=/imu"]


@pytest.mark.parametrize(
    ("parameter", "named"),
    [("tags:=[a, a]", "tags: .* different"), ("lagg:=0.2", "lagg: .* has no such parameter; write lag"), ("lag:=-1.0", "lag: ")],
)
def test_bad_parameters(parameter, named):
    command = [sys.executable, "-m", "uwb_tdoa_ekf.localization_node", "--ros-args", "-p", parameter]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=120.0)
    assert ended.returncode == 2
    *_, last = ended.stderr.splitlines()  # the first of its nodes may have said that it is ready
    assert last.startswith("localization_node: error: ") and re.search(named, last)


@pytest.mark.slow
def test_tags_that_hear_the_same_say_the_same_each_in_its_namespace(make_rig):
    flight, rig, heard = recording(seconds=3.0), make_rig(), []
    shared = [part for topic in ("imu/data", "uwb/tdoa", "uwb/anchors") for part in ("-r", f"{topic}:=/{rig.namespace}/{topic}")]
    rig.node.create_subscription(Odometry, "other/odometry", heard.append, 1000)
    rig.start("localization_node", localization_node=["-p", 'tags:=["", "other"]', *shared])
    rig.wait(lambda: rig.node.count_publishers(f"/{rig.namespace}/other/odometry"), "the other tag")
    rig.send_anchors(flight.anchors)
    rig.play(flight)
    rig.counts("ekf_node", TDOAs_received=len(flight.tdoa))
    rig.wait(lambda: len(heard) == len(rig.odometry), "the odometry of the other tag")
    assert [m.pose for m in heard] == [m.pose for m in rig.odometry] and len(heard) > 300
    assert {m.child_frame_id for m in heard} == {"other/base_link"}
