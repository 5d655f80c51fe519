"""A real ekf_node that is given a wrong survey: it gives no odometry and says why, or answers and
stops as usual.
"""

import re

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from rig import make_rig, recording  # noqa: E402, F401

REFUSED = {
    "millimetres": (lambda p: 1000.0 * p, "the survey looks like millimetres"),
    "one in millimetres": (
        lambda p: np.where(np.arange(8)[:, None] == 7, 1000.0 * p + 1000.0, p),
        "looks like millimetres",
    ),
    "one place": (lambda p: 0.0 * p, "all anchors are at one place"),
    "same place": (lambda p: p[[0, 1, 2, 2, 4, 5, 6, 7]], r"anchors \d+ and \d+ are at one place"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_anchors_that_are_certainly_wrong_give_no_odometry(make_rig, name):  # noqa: F811
    change, words = REFUSED[name]
    rig, flight = make_rig(), recording(1.0)
    processes = rig.start("bias_node", "ekf_node")
    rig.send_anchors(flight.anchors.at(change(flight.anchors.positions)))
    rig.wait(
        lambda: re.search(words, rig.fresh_status("ekf_node").message), "the survey to be refused"
    )
    for k in range(200):
        rig.send("imu/data", rig.imu_message(), 0.005 * k)
        rig.send_tdoa(
            0.005 * k, flight.tdoa.a[k % 50], flight.tdoa.b[k % 50], flight.tdoa.d[k % 50]
        )
    rig.wait(
        lambda: (
            rig.fresh_status("ekf_node") and int(rig.values("ekf_node")["TDOAs received"]) > 100
        ),
        "TDOAs to arrive",
    )
    assert re.search(words, rig.fresh_status("ekf_node").message)
    assert not rig.odometry
    for process in processes:
        code, taken = process.stop()
        assert code == 0 and taken < 4.0  # as without a fault, see test_nodes.py


def test_a_survey_that_is_too_wide_does_not_keep_the_node_busy(make_rig):  # noqa: F811
    rig, flight = make_rig(), recording(3.0)
    processes = rig.start("bias_node", "ekf_node")
    rig.send_anchors(flight.anchors.at(40.0 * flight.anchors.positions))
    rig.play(flight)
    assert int(rig.fresh_status("ekf_node") and rig.values("ekf_node")["TDOAs received"]) > 0
    for process in processes[::-1]:
        code, taken = process.stop()
        assert code == 0 and taken < 4.0  # as without a fault, see test_nodes.py
