"""Faults of drivers put into simulated flights that are played live, in lanes side by side, and
what ekf_node says of them.

As a program it prints the table of docs/reliability.md, in five minutes:  python src/uwb_tdoa_ekf/test/stream_faults.py
Or some of its rows:  python src/uwb_tdoa_ekf/test/stream_faults.py "IMU in g" none
"""

from contextlib import contextmanager
from dataclasses import dataclass, field
import os
import re
import signal
import sys
import threading
import time

from diagnostic_msgs.msg import DiagnosticArray
from faults import ACCEL, ARRIVAL, FAULTS, FLIGHT, GYRO, D, T, columns_of
from flights import position_at
from nav_msgs.msg import Odometry
import numpy as np
import rclpy
from rig import STREAMS, Rig
from std_srvs.srv import Trigger

from uwb_tdoa_bias.foundation.ros_diagnostics import DIAGNOSTICS_QOS
from uwb_tdoa_bias.foundation.ros_topics import OUTPUT_QOS, STREAM_QOS

PAUSE = 0.3  # s between two flights
NODES = {  # faults that are not of a stream, and what is said
    "ekf_node stopped for 3 s": "messages on .* were lost",
    "two bias_nodes": "2 publish on uwb/tdoa_corrected",
    "two ekf_nodes": "2 publish on odometry",
}
STOPPED = 3.0  # s
LEFT_OUT = (
    "IMU in g",
    "gyroscope in degrees/s",
    "IMU upside down",
)  # named as well by what cannot be right
PUBLISHERS = {
    "two bias_nodes": "uwb/tdoa_corrected",
    "two ekf_nodes": "odometry",
    "two IMU drivers": "imu/data",
}


@dataclass
class Lane:
    """A Rig with an ekf_node, and what was played to it: [(begin, [(from, to, names of faults)])],
    s of the clock.
    """

    rig: Rig
    plan: list = field(default_factory=list)
    heard: list = field(default_factory=list)  # (s of the clock, status)
    poses: list = field(default_factory=list)  # (s of the clock, Odometry)
    late: list = field(default_factory=list)  # (s of the clock, s by which the player was late)


def lanes_of(make_rig, count):
    """`count` Lanes whose nodes are ready; their poses are only kept if there is one."""
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
        if count == 1:
            rig.node.create_subscription(
                Odometry, "odometry", lambda m: lane.poses.append((time.time(), m)), STREAM_QOS
            )
        rig.send_anchors(FLIGHT.anchors)
        lanes.append(lane)
    return lanes


def play(lanes, plans):
    """Play to each lane its plan, a list of flights, each [(from s, to s, names of faults)];
    returns when it is over.

    Before each flight the filter is reset. Fills in heard, poses and plan of the lanes.
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
            events += [
                event
                for low, high, names in lane.plan[-1][1]
                for event in _of_nodes(lane, low, high, names)
            ]
            begin += parts[-1][1] + PAUSE
    events.sort(key=lambda event: event[0])
    clients = {id(lane): lane.rig.node.create_client(Trigger, "ekf_node/reset") for lane in lanes}
    with listening(lanes):
        _send(events, clients, epoch)
        time.sleep(PAUSE)


def _of_nodes(lane, low, high, names):
    """Events for the faults that are not of a stream, from low to high, s of the clock."""
    events = []
    if "ekf_node stopped for 3 s" in names:
        group = process_of(lane).pid
        events += [
            (low, lane, os.killpg, (group, signal.SIGSTOP)),
            (low + STOPPED, lane, os.killpg, (group, signal.SIGCONT)),
        ]
    for name in PUBLISHERS.keys() & set(names):
        made = []
        events.append((low, lane, lambda name: made.append(publish_twice(lane, name)), (name,)))
        events.append((high, lane, lambda: lane.rig.node.destroy_publisher(made.pop()), ()))
    return events


def process_of(lane):
    """The Popen of the node of a Lane."""
    (node,) = lane.rig._processes.values()
    return node.process


def _send(events, clients, epoch):
    for arrival, lane, kind, row in events:
        time.sleep(max(arrival - time.time(), 0.0))
        lane.late.append((time.time(), time.time() - arrival))
        if kind == "reset":
            clients[id(lane)].call_async(Trigger.Request())
        elif callable(kind):
            kind(*row)
        elif kind == "imu":
            lane.rig.send_imu(_relative(row[T], epoch), row[GYRO], row[ACCEL], epoch)
        else:
            lane.rig.send_corrected(
                _relative(row[T], epoch), int(row[2]), int(row[3]), row[D], epoch
            )


@contextmanager
def listening(lanes):
    """Hear at once what the nodes say while the block lasts."""
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
    """s after the epoch; a stamp of 0 stays one."""
    return t - epoch if t else -float(epoch)


def publish_twice(lane, name):
    """Another publisher on a topic; returns it."""
    topic = PUBLISHERS[name]
    return lane.rig.node.create_publisher(STREAMS[topic], topic, OUTPUT_QOS)


def errors_of(lane, begin, low, high):
    """Largest error and RMSE, m, mean stated standard deviation, m, and mean NEES of the odometry
    received between two times.
    """
    rows = [(at, m) for at, m in lane.poses if low <= at < high]
    if not rows:
        return None
    p = np.array(
        [(m.pose.pose.position.x, m.pose.pose.position.y, m.pose.pose.position.z) for _, m in rows]
    )
    at = np.array([at for at, _ in rows])
    when, late = np.array(lane.late).T
    apart = p - position_at(
        FLIGHT, at - np.interp(at, when, late) - begin
    )  # where it is when it is told
    covariance = np.array([m.pose.covariance for _, m in rows]).reshape(-1, 6, 6)[:, :3, :3]
    nees = np.einsum("ni,ni->n", apart, np.linalg.solve(covariance, apart[..., None])[..., 0])
    error, std = np.linalg.norm(apart, axis=1), np.sqrt(np.trace(covariance, axis1=1, axis2=2))
    return error.max(), float(np.sqrt(np.mean(error**2))), float(np.mean(std)), float(np.mean(nees))


BEFORE, DURING, AFTER = (
    4.0,
    6.0,
    6.0,
)  # s of the table: without the fault, with it, and without it again
COUNTERS = (
    "late",
    "rejected",
    "invalid",
    "repeated",
    "imu_late",
    "imu_invalid",
    "recoveries",
    "lost on imu/data",
)


def table(lane):
    """Rows of text, one for each fault that was played to the lane."""
    for begin, ((_, _, _), (low, high, names), (_, end, _)) in lane.plan:
        name = names[-1] if names else "none"
        pattern = "(?!)" if not names else NODES[name] if name in NODES else FAULTS[name][1]
        pattern += "|goes without the IMU" if name in LEFT_OUT else ""
        during = [(at, status) for at, status in lane.heard if low < at < high]
        named = next(
            (at - low for at, status in during if re.search(pattern, _values(status)[WRONG])), None
        )
        if named is None:
            named = next(
                (at - low for at, status in during if re.search(pattern, status.message)), None
            )
        quiet = next(
            (
                at - high
                for at, status in lane.heard
                if high < at < end and status.message == "running"
            ),
            None,
        )
        counts = [_values(status) for _, status in during]
        counted = (
            {key: int(counts[-1][key]) - int(counts[0][key]) for key in COUNTERS} if counts else {}
        )
        errors = [errors_of(lane, begin, *span) for span in ((low, high), (high + 3.0, end))]
        cells = [name, _number(named), *(_numbers(each) for each in errors), _number(quiet)]
        yield " | ".join(
            [
                "",
                *cells,
                ", ".join(f"{n} {key}" for key, n in counted.items() if n) or "nothing",
                "",
            ]
        ).strip()


WRONG = "wrong with the streams"


def _values(status):
    return {entry.key: entry.value for entry in status.values}


def _number(value):
    return "no" if value is None else f"{value:.1f}"


def _numbers(values):
    return "no odometry" if values is None else "{:.2f}, {:.2f}, {:.2f}, {:.1f}".format(*values)


def main():
    rclpy.init()
    rigs = []

    def make_rig(**options):
        rigs.append(Rig("tag0", **options))
        return rigs[-1]

    try:
        (lane,) = lanes_of(make_rig, 1)
        edges = (0.0, BEFORE, BEFORE + DURING, BEFORE + DURING + AFTER)
        faults = [
            (),
            *((name,) for name in FAULTS),
            *((name,) for name in NODES if name != "two bias_nodes"),
        ]
        faults.append(("every TDOA twice", "two bias_nodes"))
        chosen = [
            names for names in faults if not sys.argv[1:] or (names or ["none"])[-1] in sys.argv[1:]
        ]
        play([lane], [[[*zip(edges, edges[1:], ((), names, ()))] for names in chosen]])
        print(
            "| fault | named after, s | largest error, RMSE, stated, m, NEES | the same 3 - 6 "
            "s later | running again, s | counted |"
        )
        print("|---|---|---|---|---|---|")
        for row in table(lane):
            print(row)
    finally:
        for rig in rigs:
            rig.close()
        rclpy.shutdown()


if __name__ == "__main__":
    main()
