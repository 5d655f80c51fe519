# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Start of the nodes for a live run. test_demo.py runs the real nodes."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy")
from uwb_tdoa_ekf.results import VERDICTS  # noqa: E402
from uwb_tdoa_tools.flying.demo import LivePass  # noqa: E402
from uwb_tdoa_tools.live import session as live


def test_the_nodes_wait_for_a_slow_replay():
    arguments = live._parameters("bias_node", None)
    assert "hold:=9.975" in arguments
    assert 'qos_overrides./uwb/tdoa.subscription.reliability:="reliable"' in arguments


def test_tdoas_that_wait_in_a_node_are_not_lost():
    ekf = {
        **dict.fromkeys((*VERDICTS.values(), "imu_late", "waiting"), "1"),
        "IMU samples received": "4",
        "odometry published": "9",
        "height_late": "2",
    }
    flight = SimpleNamespace(tdoa=np.empty(len(VERDICTS) + 5), imu=np.empty(4))
    bias = {"waiting": "3", "released before their pose": "6"}
    counts = live.accounts(bias, ekf, flight, recorded=8)
    assert (counts["waiting"], counts["lost"], counts["imu_lost"]) == (4, 1, 0)
    assert (counts["early"], counts["sensors_late"], counts["odometry_lost"]) == (6, 2, 1)
    quiet = dict.fromkeys(counts, 0)
    assert not LivePass(quiet, None).missing
    for name in ("early", "sensors_late", "odometry_lost", "lost", "late", "imu_late", "imu_lost"):
        assert LivePass(quiet | {name: 1}, None).missing == 1
