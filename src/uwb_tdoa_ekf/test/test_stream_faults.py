"""Several publishers on a topic, and messages that are lost, live, through a real ekf_node."""

import os
import re
import signal
import time

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from rig import make_rig  # noqa: E402, F401
from stream_faults import PUBLISHERS, lanes_of, play, process_of, publish_twice  # noqa: E402


def values_of(status):
    return {entry.key: entry.value for entry in status.values}


def test_publishers_and_lost_messages_are_named(make_rig):
    (lane,) = lanes_of(make_rig, 1)
    play([lane], [[[(0.0, 2.0, ())]]])  # a loss shows between messages that arrive
    for name, topic in PUBLISHERS.items():
        publisher = publish_twice(lane, name)
        both = f"2 publish on {topic} \\(.*rig"
        lane.rig.wait(
            lambda: re.search(
                both, values_of(lane.rig.fresh_status("ekf_node"))["wrong with the streams"]
            ),
            name,
        )  # noqa: B023
        lane.rig.node.destroy_publisher(publisher)

    # what is sent while a node is stopped is lost, and counted to the last message
    before, sent, epoch = values_of(lane.rig.fresh_status("ekf_node")), 5000, int(time.time())
    os.killpg(process_of(lane).pid, signal.SIGSTOP)
    for k in range(sent):
        if k == sent - 10:
            os.killpg(process_of(lane).pid, signal.SIGCONT)
        if k >= sent - 10:  # that some are missing shows when others follow
            time.sleep(0.05)
        lane.rig.send_imu(time.time() - epoch, (0.0, 0.0, 1e-4 * k), epoch=epoch)

    def more(key):
        return int(values_of(lane.rig.fresh_status("ekf_node"))[key]) - int(before[key])

    counted = lambda: more("IMU samples received") + more("lost on imu/data") == sent  # noqa: E731
    lane.rig.wait(counted, "every sample to be received or counted as lost")
    assert more("lost on imu/data") > 0
