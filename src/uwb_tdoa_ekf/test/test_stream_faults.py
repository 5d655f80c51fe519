# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Stream faults, live, with a real ekf_node."""

from contextlib import contextmanager
from dataclasses import dataclass, field
import os
import re
import signal
import threading
import time

import pytest

pytest.importorskip("uwb_tdoa_msgs.msg")

from diagnostic_msgs.msg import DiagnosticArray
from faults import ACCEL, ARRIVAL, FAULTS, FLIGHT, GYRO, D, T, columns_of, of_imu, of_tdoa, put
from flights import position_at
from nav_msgs.msg import Odometry
import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile
from rig import STREAMS, Rig, make_rig, seconds_of  # noqa: F401
from std_srvs.srv import Trigger

from uwb_tdoa_bias.ros.node import DIAGNOSTICS_QOS
from uwb_tdoa_bias.ros.topics import OUTPUT_QOS, STREAM_QOS
from uwb_tdoa_msgs.msg import EstimatorStatus

# --- flights with faults, and lanes of nodes ---

PAUSE = 0.3  # s between two flights
PUBLISHERS = {
    "two bias_nodes": "uwb/tdoa_corrected",
    "two ekf_nodes": "odometry",
    "two IMU drivers": "imu/data",
}


@dataclass
class Lane:
    """A Rig with an ekf_node, and the flights that were played to it.

    plan : [(begin, [(from, to, names of faults)])], in s of the clock.
    """

    rig: Rig
    plan: list = field(default_factory=list)
    heard: list = field(default_factory=list)  # (s of the clock, status)
    poses: list = field(default_factory=list)  # (s of the clock, Odometry)


def lanes_of(make_rig, count):
    """Return `count` Lanes with nodes that are ready."""
    lanes = []
    for _ in range(count):
        rig = make_rig(listen=(), reliable=False)
        lane = Lane(rig)
        rig.start("ekf_node", ekf_node=["-p", "odometry_rate:=20.0"])
        name = f"/{rig.namespace}/ekf_node"

        def hear(message, lane=lane, name=name):
            lane.heard += [
                (time.time(), status) for status in message.status if status.name == name
            ]

        rig.node.create_subscription(DiagnosticArray, "/diagnostics", hear, DIAGNOSTICS_QOS)
        keep = lambda m, poses=lane.poses: poses.append((time.time(), m))  # noqa: E731
        rig.node.create_subscription(Odometry, "odometry", keep, STREAM_QOS)
        rig.send_anchors(FLIGHT.anchors)
        lanes.append(lane)
    return lanes


def play(lanes, plans):
    """Play its plan to each lane; return when all flights are over.

    A plan is a list of flights: [(from s, to s, names of faults)]. The filter is reset before each
    flight. Fills in heard, poses and plan of the lanes.
    """
    epoch, events = int(time.time()), []
    start = time.time() + 1.0
    for lane, flights in zip(lanes, plans):
        begin = start
        for parts in flights:
            lane.plan.append(
                (begin, [(begin + low, begin + high, name) for low, high, name in parts])
            )
            imu, tdoa = columns_of(begin, parts)
            events += [(row[ARRIVAL], lane, "imu", row) for row in zip(*imu)]
            events += [(row[ARRIVAL], lane, "tdoa", row) for row in zip(*tdoa)]
            events += [(begin - 0.5 * PAUSE, lane, "reset", None)]
            begin += parts[-1][1] + PAUSE
    events.sort(key=lambda event: event[0])
    clients = {id(lane): lane.rig.node.create_client(Trigger, "ekf_node/reset") for lane in lanes}
    with listening(lanes):
        _send(events, clients, epoch)
        time.sleep(PAUSE)


def process_of(lane):
    """Return the Popen of the node of a Lane."""
    (node,) = lane.rig._processes.values()
    return node.process


def _send(events, clients, epoch):
    for arrival, lane, kind, row in events:
        time.sleep(max(arrival - time.time(), 0.0))
        if kind == "reset":
            clients[id(lane)].call_async(Trigger.Request())
        elif kind == "imu":
            lane.rig.send_imu(_relative(row[T], epoch), row[GYRO], row[ACCEL], epoch)
        else:
            lane.rig.send_corrected(
                _relative(row[T], epoch), int(row[2]), int(row[3]), row[D], epoch
            )


@contextmanager
def listening(lanes):
    """Receive messages of the nodes immediately while the block lasts."""
    over = threading.Event()

    def listen(executor):
        while not over.is_set():
            executor.spin_once(timeout_sec=0.1)

    threads = [threading.Thread(target=listen, args=(lane.rig._executor,)) for lane in lanes]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        over.set()
        for thread in threads:
            thread.join()


def _relative(t, epoch):
    """Return t relative to the epoch, in s; a stamp of 0 stays 0."""
    return t - epoch if t else -float(epoch)


def publish_twice(lane, name):
    """Create and return another publisher on a topic."""
    topic = PUBLISHERS[name]
    return lane.rig.node.create_publisher(STREAMS[topic], topic, OUTPUT_QOS)


# --- stream faults ---


pytestmark = pytest.mark.slow  # starts nodes


def values_of(status):
    return {entry.key: entry.value for entry in status.values}


def test_publishers_and_lost_messages_are_named(make_rig):  # noqa: F811
    (lane,) = lanes_of(make_rig, 1)
    # A loss shows only between messages that arrive.
    play([lane], [[[(0.0, 2.0, ())]]])
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

    # A stopped node loses messages. It then counts every lost one.
    before, sent, epoch = values_of(lane.rig.fresh_status("ekf_node")), 5000, int(time.time())
    os.killpg(process_of(lane).pid, signal.SIGSTOP)
    for k in range(sent):
        if k == sent - 10:
            os.killpg(process_of(lane).pid, signal.SIGCONT)
        # A gap shows when other messages follow.
        if k >= sent - 10:
            time.sleep(0.05)
        lane.rig.send_imu(time.time() - epoch, (0.0, 0.0, 1e-4 * k), epoch=epoch)

    def more(key):
        return int(values_of(lane.rig.fresh_status("ekf_node"))[key]) - int(before[key])

    counted = lambda: more("IMU samples received") + more("lost on imu/data") == sent  # noqa: E731
    lane.rig.wait(counted, "every sample to be received or counted as lost")
    assert more("lost on imu/data") > 0


# --- honest status ---
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
RUNNING, FAULT, WAITING = (
    EstimatorStatus.STATUS_RUNNING,
    EstimatorStatus.STATUS_FAULT,
    EstimatorStatus.STATUS_WAITING,
)
BEFORE, LONG, AFTER = 8.0, 5.0, 8.0  # s of flight before, during and after a fault
SOON = 4.5  # s within which the fault must be reported


def unknown(columns, rng):
    """Change the ids of TDOAs so that the survey does not have them."""
    t, arrival, a, b, d = columns
    return t, arrival, a + 500, b + 500, d


def silent(imu, tdoa, rng):
    """Remove both streams."""
    return tuple(c[:0] for c in imu), tuple(c[:0] for c in tdoa)


SIGNS = "all signs change"  # the end of this fault takes a comparison of 12 s
# name: (function of the columns of a flight, status, pattern of `why`)
CASES = {
    SIGNS: (of_tdoa(lambda c, rng: put(c, D, -c[D])), FAULT, "the sign of all TDOAs has changed"),
    "ids are not in the survey": (of_tdoa(unknown), FAULT, "anchors that the survey does not have"),
    "TDOAs come 0.6 s late": (
        of_tdoa(lambda c, rng: put(c, ARRIVAL, c[ARRIVAL] + 0.6)),
        None,
        "-p lag",
    ),
    "no TDOA comes": (
        of_tdoa(lambda c, rng: tuple(column[:0] for column in c)),
        RUNNING,
        "no TDOA was used.*by the IMU alone",
    ),
    "neither TDOAs nor IMU come": (silent, WAITING, "there is no odometry"),
    "the IMU is in g": (
        of_imu(lambda c, rng: put(c, 3, c[3] / 9.81)),
        RUNNING,
        "goes without the IMU",
    ),
}


class Heard:
    """Received EstimatorStatus messages, with the time in s of the clock."""

    def __init__(self, rig):
        self.statuses, self.rig = [], rig
        rig.node.create_subscription(
            EstimatorStatus, "status", lambda m: self.statuses.append((time.time(), m)), LATCHED
        )

    def at(self, when):
        """Return the last EstimatorStatus up to a time, in s of the clock."""
        return [status for at, status in self.statuses if at <= when][-1]


def tried(lanes, heards, names):
    """Fly with one fault in each lane and return a list with one tuple per lane.

    Returns
    -------
    name : str
        Name of the fault.
    first : float
        Time until the fault is reported, in s, or nan.
    wrong : (float, float)
        Largest error since then and its deviation, in m.
    during : list of int
        Status values since then, until the end of the fault.
    well : float
        Time after the end of the fault until the status is RUNNING again, in s, or nan.
    """
    out, ends = [], np.cumsum([BEFORE, LONG, AFTER])
    for lane in lanes:
        lane.poses.clear()
    parts = [list(zip([0.0, *ends], ends, ((), (name,), ()))) for name in names]
    play(lanes, [[part] for part in parts])
    for lane, heard, name in zip(lanes, heards, names):
        begin = lane.plan[-1][0]
        low, high, end = begin + BEFORE, begin + BEFORE + LONG, begin + BEFORE + LONG + AFTER
        words = CASES[name][2]
        said = [
            at for at, status in heard.statuses if low < at < end and re.search(words, status.why)
        ]
        first = said[0] - low if said else np.nan
        during = [status for at, status in heard.statuses if low + first <= at < high]
        wrong = []
        for at, pose in lane.poses:
            if low + first + 0.4 < at < high:
                stamp = seconds_of(pose.header.stamp, 0) - begin
                p = pose.pose.pose.position
                error = np.linalg.norm([p.x, p.y, p.z] - position_at(FLIGHT, np.array([stamp]))[0])
                wrong.append(
                    (
                        error,
                        np.sqrt(
                            max(
                                pose.pose.covariance[0],
                                pose.pose.covariance[7],
                                pose.pose.covariance[14],
                            )
                        ),
                    )
                )
        well = [
            at
            for at, status in heard.statuses
            if at > high and status.status == RUNNING and not re.search(words, status.why)
        ]
        out.append(
            (
                name,
                first,
                max(wrong, default=(0.0, 0.0)),
                [s.status for s in during],
                well[0] - high if well else np.nan,
            )
        )
    return out


def test_status_odometry_and_diagnostics_agree_while_what_is_measured_is_wrong(
    make_rig,  # noqa: F811
    monkeypatch,
):  # noqa: F811
    for name, (change, _, words) in CASES.items():
        monkeypatch.setitem(FAULTS, name, (change, words))
    lanes = lanes_of(make_rig, 2)
    heards, names = [Heard(lane.rig) for lane in lanes], list(CASES)
    found = [
        each for k in range(0, len(names), 2) for each in tried(lanes, heards, names[k : k + 2])
    ]
    for name, first, (error, deviation), statuses, well in found:
        _, status, words = CASES[name]
        assert first < SOON, (name, first)
        assert status is None or set(statuses) <= {status}, (name, statuses)
        assert error < max(1.0, 3.0 * deviation), (name, error, deviation)
        assert well < AFTER or name == SIGNS, name
    agree = [
        (status, s)
        for lane, heard in zip(lanes, heards)
        for at, status in lane.heard
        for t, s in heard.statuses
        if abs(t - at) < 0.02
    ]
    for diagnostics, status in agree:
        values = {entry.key: entry.value for entry in diagnostics.values}
        if status.status == FAULT:
            assert (
                status.why in values["wrong with the streams"]
                or status.why == values["not to be flown by"]
            )
