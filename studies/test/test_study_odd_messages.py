# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Messages that no driver should send, over topics, to real nodes."""

import numpy as np
import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from geometry_msgs.msg import PoseWithCovarianceStamped  # noqa: E402

from studies import odd_messages  # noqa: E402
from uwb_tdoa_msgs.msg import AnchorArray, Tdoa  # noqa: E402

FEW = 100
GROWTH = 100e6  # bytes in the second half; an effect that is compiled takes 50 MB


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ekf_node", "bias_node", "debias_node", "autopilot_node"])
def test_no_message_ends_a_node_and_each_is_accounted_for(name, tmp_path):
    account = odd_messages.ordeal(name, FEW, tmp_path)
    assert not odd_messages.wrong(account)
    assert all(count > FEW // 4 for count in account.unreadable.values())  # they are odd enough
    assert all(count > FEW // 20 for count in account.received.values())
    assert account.memory[-1] < account.memory[len(account.memory) // 2] + GROWTH


@pytest.mark.slow
@pytest.mark.parametrize("name", odd_messages.SERVICES)
def test_no_request_ends_a_node_and_each_is_answered(name, tmp_path):
    answered, used = odd_messages.request_ordeal(name, FEW // 4, tmp_path)
    assert (
        len(answered) == 6 + len(odd_messages.SERVICES[name]) and min(answered.values()) >= FEW // 4
    )
    assert used[-1] < used[len(used) // 2] + GROWTH


@pytest.mark.slow
def test_no_time_ends_a_node(tmp_path):
    assert odd_messages.clock_ordeal(FEW, tmp_path)


@pytest.mark.parametrize("kind", [Tdoa, AnchorArray, PoseWithCovarianceStamped])
def test_whole_messages_are_readable_and_changed_ones_often_are_not(kind):
    rng = np.random.default_rng(2)
    assert odd_messages.is_readable(odd_messages.whole(kind, 7), kind)
    readable = [
        odd_messages.is_readable(odd_messages.changed(odd_messages.whole(kind, k), rng), kind)
        for k in range(200)
    ]
    assert 30 < sum(readable) < 170
