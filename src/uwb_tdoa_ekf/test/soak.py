"""Both nodes for as long as one likes, with an IMU of 1 kHz and 400 TDOAs a second in real time: their memory, and whether all that
was sent is accounted for. In a shell with the workspace sourced (./dev shell):

    python src/uwb_tdoa_ekf/test/soak.py --seconds 3600
"""

import argparse
import os
import sys
import threading
import time

from flights import Wave, corners
import numpy as np
import rclpy
from rig import Rig
from uwb_tdoa_bias.foundation.geometry import tdoa

IMU_RATE, TDOA_RATE = 1000, 400  # Hz
ANCHORS = corners()
WAVE = Wave(np.random.default_rng(1), ANCHORS.positions.mean(axis=0))
NODES = "bias_node", "ekf_node"
RECEIVED = {"imu/data": ("ekf_node", "IMU samples received"), "uwb/tdoa": ("bias_node", "received")}
PAGE = os.sysconf("SC_PAGE_SIZE") / 1e6  # MB
LARGEST_GROWTH = 5.0  # MB, from the first minute on


def messages(second):
    """[(stamp s, kind, values)] of one second of the flight, in the order of their stamps."""
    t = second + np.arange(IMU_RATE) / IMU_RATE
    _, _, _, accel, rates = WAVE.motion(t)
    rng = np.random.default_rng(second)
    samples = [(stamp, "imu", row) for stamp, *row in zip(t.tolist(), rates, accel + rng.normal(0.0, 0.1, accel.shape))]
    t = second + (np.arange(TDOA_RATE) + 0.5) / TDOA_RATE
    a = np.arange(TDOA_RATE) % len(ANCHORS)
    b = (a + 1) % len(ANCHORS)
    d = tdoa(WAVE.motion(t)[0], ANCHORS.positions[a], ANCHORS.positions[b]) + rng.normal(0.0, 0.1, TDOA_RATE)
    return sorted(samples + [(stamp, "tdoa", row) for stamp, *row in zip(t.tolist(), ANCHORS.ids[a], ANCHORS.ids[b], d)], key=lambda m: m[0])


def play(rig, seconds, every_second):
    """Send so many seconds of the flight in real time; returns messages sent by topic. every_second(second) is called meanwhile."""
    epoch, sent = int(time.time()), {"imu/data": 0, "uwb/tdoa": 0}
    for second in range(1, seconds + 1):
        for stamp, kind, row in messages(second):
            time.sleep(max(epoch + stamp - time.time(), 0.0))
            if kind == "imu":
                rig.send_imu(stamp, *row, epoch)
                sent["imu/data"] += 1
            else:
                rig.send_tdoa(stamp, *row, epoch)
                sent["uwb/tdoa"] += 1
        every_second(second)
    return sent


def memory(rig):
    """MB that each node has resident."""
    found = []
    for name in NODES:
        with open(f"/proc/{rig._processes[name].process.pid}/statm") as file:
            found.append(int(file.read().split()[1]) * PAGE)
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=3600)
    args = parser.parse_args()
    rclpy.init()
    rig, over, grown = Rig("soak", listen=(), reliable=False), threading.Event(), []

    def report(second):
        if second % 60 == 0 or second in (1, args.seconds):
            grown.append(memory(rig))
            print(f"{second:5d} s: bias_node {grown[-1][0]:.1f} MB, ekf_node {grown[-1][1]:.1f} MB", flush=True)

    def hear():
        while not over.is_set():
            rig._executor.spin_once(timeout_sec=0.1)

    try:
        rig.start(*NODES)
        rig.send_anchors(ANCHORS)
        hearing = threading.Thread(target=hear)
        hearing.start()
        sent = play(rig, args.seconds, report)
        over.set()
        hearing.join()
        right = True
        for topic, (node, key) in RECEIVED.items():
            values = {entry.key: entry.value for entry in rig.fresh_status(node).values}
            received, lost = int(values[key]), int(values[f"lost on {topic}"])
            right &= received + lost == sent[topic]
            print(f"{topic}: sent {sent[topic]}, received {received}, lost {lost}")
        growth = np.subtract(grown[-1], grown[min(1, len(grown) - 1)])
        print(f"grown by {growth[0]:+.1f} and {growth[1]:+.1f} MB since the first minute; rest of what ekf_node says: {values}")
        return 0 if right and growth.max() <= LARGEST_GROWTH else 1
    finally:
        over.set()
        rig.close()
        rclpy.shutdown()


if __name__ == "__main__":
    sys.exit(main())
