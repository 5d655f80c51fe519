# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Play simulated flights with driver faults live to real nodes, in several lanes side by side."""

from contextlib import contextmanager
from dataclasses import dataclass, field
import threading
import time

from diagnostic_msgs.msg import DiagnosticArray
from faults import ACCEL, ARRIVAL, FLIGHT, GYRO, D, T, columns_of
from nav_msgs.msg import Odometry
from rig import STREAMS, Rig
from std_srvs.srv import Trigger

from uwb_tdoa_bias.ros.diagnostics import DIAGNOSTICS_QOS
from uwb_tdoa_bias.ros.topics import OUTPUT_QOS, STREAM_QOS

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
