"""`status`, and frames that alternate, of a real ekf_node."""

import itertools
import re
import time

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from geometry_msgs.msg import TransformStamped  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from rig import make_rig, recording  # noqa: E402, F401
from tf2_msgs.msg import TFMessage  # noqa: E402

from uwb_tdoa_bias.foundation.ros_diagnostics import AGAIN  # noqa: E402
from uwb_tdoa_bias.foundation.ros_frames import TF_STATIC_QOS  # noqa: E402
from uwb_tdoa_msgs.msg import EstimatorStatus  # noqa: E402

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def test_status_says_what_may_be_flown_by_and_why_not(make_rig):  # noqa: F811
    rig, heard = make_rig(), []
    rig.start("bias_node", "ekf_node")
    rig.node.create_subscription(EstimatorStatus, "status", heard.append, LATCHED)
    rig.wait(lambda: heard, "the latched status, or the next")
    assert (
        heard[-1].status == EstimatorStatus.STATUS_WAITING
        and "no anchors yet" in heard[-1].why
        and not heard[-1].yaw_known
    )
    flight = recording(2.0)
    rig.send_anchors(flight.anchors)
    rig.play(flight)
    rig.wait(
        lambda: any(each.status == EstimatorStatus.STATUS_RUNNING for each in heard), "it to run"
    )
    running = [each for each in heard if each.status == EstimatorStatus.STATUS_RUNNING]
    assert not any(each.yaw_known or each.lost for each in running)  # it has not moved enough
    assert all(each.yaw_std > 0.4 and each.header.frame_id == "map" for each in running)
    rig.wait(
        lambda: "no odometry" in heard[-1].why and heard[-1].tdoa_age > 1.0,
        "the silence to be said",
    )
    assert heard[-1].status == EstimatorStatus.STATUS_WAITING
    assert re.match(r"not known yet: \+-\d+ degrees", rig.values("ekf_node")["yaw"])


def test_frames_that_alternate_are_warned_of_once(make_rig):  # noqa: F811
    rig = make_rig(listen=["odometry", "uwb/residual"])
    (_, ekf) = rig.start("bias_node", "ekf_node")
    rig.send_anchors(recording(1.0).anchors)
    for k in range(400):
        rig.send("imu/data", rig.imu_message(), 0.005 * k, frame=("left", "right")[k % 2])
    assert rig.counts("ekf_node", IMU_samples_received=400)["unreadable on imu/data"] == 0
    numbers, began = itertools.count(400), time.monotonic()

    def both_are_said():
        k = next(numbers)
        rig.send("imu/data", rig.imu_message(), 0.005 * k, frame=("left", "right")[k % 2])
        return rig.values("ekf_node")["frames of imu/data"] in ("left, right", "right, left")

    rig.wait(both_are_said, "two frames to be said")

    def warned(frame):
        return [
            line
            for line in ekf.lines
            if f"frame '{frame}', which /tf_static does not connect" in line
        ]

    rig.wait(lambda: warned("left") and warned("right"), "both frames to be warned of")
    again = 1 + int(
        (time.monotonic() - began) / AGAIN
    )  # how often the log says what it has said before
    assert (
        max(len(warned("left")), len(warned("right"))) <= 1 + 2 * again
    )  # once, and with /diagnostics when its text is of another kind


def test_a_transform_that_is_none_ends_nothing(make_rig):  # noqa: F811
    rig = make_rig(listen=["odometry", "uwb/residual"])
    (_, ekf) = rig.start("bias_node", "ekf_node")
    publisher = rig.node.create_publisher(TFMessage, "/tf_static", TF_STATIC_QOS)
    bad = TransformStamped(child_frame_id="imu")
    bad.header.frame_id, bad.transform.rotation.w = "base_link", 0.0
    odd = TransformStamped(child_frame_id="other")
    odd.header.frame_id, odd.transform.translation.x = "base_link", float("nan")
    publisher.publish(TFMessage(transforms=[bad, odd]))
    rig.wait(lambda: "is no rotation" in "".join(ekf.lines), "the node to refuse it")
    for k in range(20):
        rig.send("imu/data", rig.imu_message(), 0.005 * k, frame="imu")
    rig.counts("ekf_node", IMU_samples_received=20)
