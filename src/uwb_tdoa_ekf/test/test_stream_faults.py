"""Faults of drivers, live, through a real ekf_node: each is named within seconds, and nothing is said of a healthy flight."""

import os
import re
import signal
import time

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from rig import make_rig  # noqa: E402, F401
from stream_faults import FAULTS, PUBLISHERS, lanes_of, play, publish_twice  # noqa: E402

SECONDS = 6.0  # s of each fault, and within which it is named
LANES = 3  # more of them make this player late on two cores that do other things too: blocks then count as its own
FLIGHTS = [  # faults that do not hide each other come together
    (), ("IMU in g", "every TDOA twice"), ("gyroscope in degrees/s", "TDOAs shuffled by 50 ms"),
    ("IMU upside down", "a second tag"), ("IMU 0.5 s ahead",), ("IMU 0.5 s behind",), ("TDOAs stamped 0",),
    ("TDOAs in blocks of 1 s",), ("TDOAs 10 s ahead",), ("all 10 s ahead",),
]  # fmt: skip


def values_of(status):
    return {entry.key: entry.value for entry in status.values}


def test_every_fault_is_named_and_a_healthy_flight_runs(make_rig):
    assert {name for names in FLIGHTS for name in names} == FAULTS.keys()
    lanes = lanes_of(make_rig, LANES)
    play(lanes, [[[(0.0, SECONDS, names)] for names in FLIGHTS[k::LANES]] for k in range(LANES)])
    for lane in lanes:
        for _, ((low, high, names),) in lane.plan:
            statuses = [status for at, status in lane.heard if low < at < high]
            said = [f"{status.message}; {values_of(status)['wrong with the streams']}" for status in statuses]
            if not names:
                assert statuses[-1].message == "running" and statuses[-1].level == DiagnosticStatus.OK, said
                assert {values_of(status)["wrong with the streams"] for status in statuses} == {"nothing"}
            for name in names:
                assert any(re.search(FAULTS[name][1], text) for text in said), (name, said, [values_of(each) for each in statuses])
                assert statuses[-1].level != DiagnosticStatus.OK and statuses[-1].message != "running", (name, said)

    lane = lanes[0]
    for name, topic in PUBLISHERS.items():
        publisher = publish_twice(lane, name)
        both = f"2 publish on {topic} \\(.*rig"
        lane.rig.wait(lambda: re.search(both, values_of(lane.rig.fresh_status("ekf_node"))["wrong with the streams"]), name)  # noqa: B023
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
    lane.rig.wait(counted, "every sample to be received or counted as lost", 30.0)
    assert more("lost on imu/data") > 0


def process_of(lane):
    (node,) = lane.rig._processes.values()
    return node.process
