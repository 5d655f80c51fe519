# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Both nodes in one run, from the wait for anchors to the end: messages and robustness."""

import itertools
import re
import signal
import time

import numpy as np
import pytest

pytest.importorskip("uwb_tdoa_msgs.msg")

from flights import position_at  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from rig import EPOCH, make_shared_rig, recording, seconds_of, stamp  # noqa: E402, F401
from test_anchor_table import BOX, CHANGE, after, cut, flight_through  # noqa: E402

from uwb_tdoa_bias.ros.node import AGAIN
from uwb_tdoa_msgs.msg import EstimatorStatus, TdoaCorrected  # noqa: E402

pytestmark = pytest.mark.slow  # starts nodes

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture(scope="module")
def rig(make_shared_rig):  # noqa: F811
    """Return a Rig with both nodes: rig.processes, and their published rig.statuses."""
    rig = make_shared_rig()
    rig.processes, rig.statuses = rig.start("bias_node", "ekf_node"), []
    rig.epochs = itertools.count(EPOCH - 100, 10)  # of recordings before the one at EPOCH
    rig.node.create_subscription(EstimatorStatus, "status", rig.statuses.append, LATCHED)
    return rig


def test_without_anchors_tdoas_pass_and_the_status_says_what_is_missing(rig):
    sent = [(0.123456789, 10, 14, 1.5), (0.2, 99, 99, float("inf")), (0.1, 14, 10, -0.25)]
    for row in sent:
        rig.send_tdoa(*row)
    rig.wait(lambda: len(rig.corrected) == 3, "three measurements, without anchors or odometry")
    for (t, a, b, d), message in zip(sent, rig.corrected):
        assert message.header.stamp == stamp(t) and message.header.frame_id == "base_link"
        assert (message.anchor_a, message.anchor_b, message.raw, message.corrected) == (a, b, d, d)
        assert (message.bias, message.bias_std, message.model) == (0.0, 0.0, "none")
        assert message.status == TdoaCorrected.STATUS_PASSED
    counts = rig.counts("bias_node", received=3)
    assert counts["published"] == counts["passed"] == 3
    assert counts["waiting"] == counts["dropped"] == 0
    rig.wait(lambda: rig.statuses, "the latched status, or the next")
    status = rig.statuses[-1]
    assert status.status == EstimatorStatus.STATUS_WAITING
    assert "no anchors yet" in status.why and not status.yaw_known


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda p: 1000.0 * p, "the survey looks like millimetres"),
        (
            lambda p: np.where(np.arange(8)[:, None] == 7, 1000.0 * p + 1000.0, p),
            "looks like millimetres",
        ),
        (lambda p: 0.0 * p, "all anchors are at one place"),
        (lambda p: p[[0, 1, 2, 2, 4, 5, 6, 7]], r"anchors \d+ and \d+ are at one place"),
    ],
)
def test_anchors_that_are_certainly_wrong_give_no_odometry(rig, change, words):
    flight, odometry, epoch = recording(1.0), len(rig.odometry), next(rig.epochs)
    rig.send_anchors(flight.anchors.at(change(flight.anchors.positions)))
    rig.wait(lambda: re.search(words, rig.fresh_status("ekf_node").message), "a refusal")
    before = int(rig.values("ekf_node")["TDOAs received"])
    for imu in zip(flight.imu.t, flight.imu.gyro, flight.imu.accel):
        rig.send_imu(*imu, epoch=epoch)
    for tdoa in zip(*(getattr(flight.tdoa, name) for name in "tabd")):
        rig.send_tdoa(*tdoa, epoch=epoch)

    def arrived():
        rig.fresh_status("ekf_node")
        return int(rig.values("ekf_node")["TDOAs received"]) >= before + len(flight.tdoa)

    rig.wait(arrived, "TDOAs to arrive")
    assert re.search(words, rig.fresh_status("ekf_node").message)
    rig.wait(lambda: re.search(words, rig.statuses[-1].why), "the refusal on status")
    assert rig.statuses[-1].status == EstimatorStatus.STATUS_WAITING
    assert len(rig.odometry) == odometry


@pytest.mark.quick
def test_status_says_what_may_be_flown_by_and_why_not(rig):
    flight = recording(2.0)
    rig.send_anchors(flight.anchors)
    rig.play(flight)

    def running():
        wanted = EstimatorStatus.STATUS_RUNNING
        return [each for each in rig.statuses if each.status == wanted]

    rig.wait(running, "it to run")
    # It has not moved enough.
    assert not any(each.yaw_known or each.lost for each in running())
    assert all(each.yaw_std > 0.4 and each.header.frame_id == "map" for each in running())

    def silent():
        return "no odometry" in rig.statuses[-1].why and rig.statuses[-1].tdoa_age > 1.0

    rig.wait(silent, "the silence to be said")
    assert rig.statuses[-1].status == EstimatorStatus.STATUS_WAITING
    assert re.match(r"not known yet: \+-\d+ degrees", rig.values("ekf_node")["yaw"])


def test_an_anchor_that_goes_one_that_moves_and_one_that_comes_do_not_stop_the_nodes(rig):
    flight, said = flight_through(), [len(process.lines) for process in rig.processes]
    early = cut(flight, -np.inf, CHANGE)
    received = rig.counts("ekf_node")["TDOAs received"] + len(early.tdoa)
    rig.send_anchors(BOX)
    rig.play(early)
    before = rig.counts("ekf_node", state="running", TDOAs_received=received)
    rig.send_anchors(after())

    def told():
        return all(
            any("the anchors have changed" in line for line in process.lines[since:])
            for process, since in zip(rig.processes, said)
        )

    rig.wait(told, "the change to arrive")
    first = len(rig.odometry)
    rig.play(cut(flight, CHANGE, np.inf))
    late = np.sum(flight.tdoa.t >= CHANGE)
    counts = rig.counts("ekf_node", TDOAs_received=before["TDOAs received"] + late)
    assert all(counts[name] == before[name] for name in ("restarts", "recoveries"))
    assert counts["used"] > before["used"] + 500
    messages = rig.odometry[first - 1 :]
    t = np.array([seconds_of(m.header.stamp) for m in messages])
    p = np.array([[getattr(m.pose.pose.position, k) for k in "xyz"] for m in messages])
    assert np.diff(t).max() < 0.1  # it never stopped
    assert np.linalg.norm(p - position_at(flight, t), axis=1)[t > CHANGE].max() < 0.3


def test_frames_that_alternate_are_warned_of_once(rig):
    rig.send_anchors(BOX)
    numbers, ekf, began = itertools.count(), rig.processes[1], time.monotonic()

    def send():
        k = next(numbers)
        rig.send("imu/data", rig.imu_message(), 20.0 + 0.005 * k, frame=("left", "right")[k % 2])

    def both_are_said():
        send()
        return rig.values("ekf_node")["frames of imu/data"] in ("left, right", "right, left")

    def warned(frame):
        words = f"frame '{frame}', which /tf_static does not connect"
        return [line for line in ekf.lines if words in line]

    for _ in range(400):
        send()
    rig.wait(both_are_said, "two frames to be said")
    rig.wait(lambda: warned("left") and warned("right"), "both frames to be warned of")
    assert rig.counts("ekf_node")["unreadable on imu/data"] == 0
    # Number of times that the log repeats a warning. /diagnostics adds one when its text changes.
    again = 1 + int((time.monotonic() - began) / AGAIN)
    assert max(len(warned("left")), len(warned("right"))) <= 1 + 2 * again


def test_a_survey_that_is_too_wide_keeps_no_node_busy_and_a_signal_ends_both(rig):
    flight = recording(3.0)
    rig.send_anchors(flight.anchors.at(40.0 * flight.anchors.positions))
    rig.play(flight)
    for process, number in zip(rig.processes[::-1], (signal.SIGINT, signal.SIGTERM)):
        code, slept = process.stop(number)
        assert code == 0 and slept < 4.0, "".join(process.lines)  # ros2 launch waits for 5 s
        assert not any("Traceback" in line or "FATAL" in line for line in process.lines)
