"""Faults of drivers, live, through a real ekf_node: named within seconds, and nothing is said of a
healthy flight. (All of them, without nodes: test_stream_watch.py.)
"""

import os
import re
import signal
import time

import pytest

pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg")

from diagnostic_msgs.msg import DiagnosticStatus  # noqa: E402
from faults import FAULTS  # noqa: E402
from rig import make_rig  # noqa: E402, F401
from stream_faults import PUBLISHERS, lanes_of, play, process_of, publish_twice  # noqa: E402

SECONDS = 6.0  # s of each fault, and within which it is named (how soon: stream_faults.py)
FLOWN = 5  # times at most: what a loaded machine hands over late or loses tells less
FLIGHTS = [
    (),
    ("IMU in g", "TDOAs stamped 0"),
]  # in lanes side by side; faults that do not hide each other


def values_of(status):
    return {entry.key: entry.value for entry in status.values}


def said_by(lane):
    """What the node of a Lane has said while flights were played: statuses of each flight."""
    return [
        [status for at, status in lane.heard if low < at < high]
        for _, ((low, high, _),) in lane.plan
    ]


def is_named(lane, name):
    """Whether the node of a Lane has named a fault."""
    return any(
        re.search(FAULTS[name][1], text(status))
        for statuses in said_by(lane)
        for status in statuses
    )


def text(status):
    return f"{status.message}; {values_of(status)['wrong with the streams']}"


def test_faults_are_named_and_a_healthy_flight_runs(make_rig):
    lanes = healthy, faulty = lanes_of(make_rig, len(FLIGHTS))
    for _ in range(FLOWN):
        play(lanes, [[[(0.0, SECONDS, names)]] for names in FLIGHTS])
        if all(is_named(faulty, name) for name in FLIGHTS[1]):
            break  # within the first flight, but on a loaded machine
    said = [text(status) for lane in lanes for statuses in said_by(lane) for status in statuses]
    for statuses in said_by(healthy):
        assert statuses[-1].message == "running" and statuses[-1].level == DiagnosticStatus.OK, said
        assert {values_of(status)["wrong with the streams"] for status in statuses} == {
            "nothing"
        }, said
    for name in FLIGHTS[1]:
        assert is_named(faulty, name), (name, said)
    last = said_by(faulty)[-1][-1]
    assert last.level != DiagnosticStatus.OK and last.message != "running", said

    lane = lanes[0]
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
