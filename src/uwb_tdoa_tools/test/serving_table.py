"""What it costs to be given messages, in ways that rclpy has: python
src/uwb_tdoa_tools/test/serving_table.py [SECONDS]

Two streams, 1 kHz and 400 Hz, are only counted, beside another topic at 1 kHz for the rest of the
graph. CPU is that of the process that receives; a message is late from its publication until it is
in the hands of whoever computes with it.

  single     SingleThreadedExecutor, a callback with the bytes of each message
  events     EventsExecutor, the same
  kept       callbacks that keep the bytes, and the EventsExecutor up to a mark, each millisecond
  beside     the streams taken in turns of a millisecond, and one callback of the EventsExecutor every 20 ms
  spinner    ros_spinning.Spinner: the streams the same way, and the EventsExecutor up to a mark every 5 ms
"""

import multiprocessing
import os
import signal
import struct
import sys
import time

import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.serialization import serialize_message
from rclpy.task import Future
from sensor_msgs.msg import FluidPressure, Imu, Range

from uwb_tdoa_bias.foundation.ros_node import StreamNode
from uwb_tdoa_bias.foundation.ros_spinning import Spinner
from uwb_tdoa_bias.foundation.ros_topics import OUTPUT_QOS, STREAM_QOS, unserved, waiting
from uwb_tdoa_tools.live.processes import own_domain

STREAMS = {Imu: "imu", Range: "tdoa"}
WAYS = "single", "events", "kept", "beside", "spinner"
STAMP = struct.Struct("<iI")
SETTLE = 2.0  # s


def main():
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 10.0
    print(
        "| way | messages/s | CPU, % of a core | us per message | p50, ms | p99, ms | the "
        "rest, callbacks/s |"
    )
    print("|---|---:|---:|---:|---:|---:|---:|")
    spawn = multiprocessing.get_context("spawn")
    with own_domain():
        for way in WAYS:
            stop, queue = spawn.Event(), spawn.Queue()
            processes = [
                spawn.Process(target=publish, args=(stop,)),
                spawn.Process(target=receive, args=(way, seconds, queue)),
            ]
            for process in processes:
                process.start()
            print(f"| {way} | {queue.get(timeout=120.0)} |", flush=True)
            stop.set()
            for process in processes:
                process.join()


def publish(stop):
    """1 kHz, 400 Hz and 1 kHz, until told to stop."""
    rclpy.init()
    node = rclpy.create_node("source")
    publishers = [node.create_publisher(kind, topic, OUTPUT_QOS) for kind, topic in STREAMS.items()]
    rest = node.create_publisher(FluidPressure, "rest", 10)
    imu, tdoa, pressure = (
        bytearray(serialize_message(kind())) for kind in (Imu, Range, FluidPressure)
    )
    due, k = time.monotonic(), 0
    while not stop.is_set():
        for publisher, data, is_due in zip(publishers, (imu, tdoa), (True, k % 5 in (0, 2))):
            if is_due:
                STAMP.pack_into(data, 4, *divmod(time.time_ns(), 10**9))
                publisher.publish(bytes(data))
        rest.publish(bytes(pressure))
        due, k = max(due + 0.001, time.monotonic() - 0.05), k + 1
        time.sleep(max(0.0, due - time.monotonic()))
    os._exit(0)


class Counted:
    """RoundRobin that only look at what take(), a list of bytes, gives."""

    PERIOD = 0.001

    def __init__(self, take, handle):
        self._take, self._handle = take, handle

    def take(self):
        """One turn."""
        some = self._take()
        for data in some:
            self._handle(data)
        return self.PERIOD if some else None


def receive(way, seconds, queue):
    """Receive in one way, and put a line of the table into the queue."""
    rclpy.init()
    node, late, rest = StreamNode("receiver"), [], [0]

    def handle(data):
        second, nanosecond = STAMP.unpack_from(data, 4)
        late.append(time.time_ns() - second * 10**9 - nanosecond)

    def count(_):
        rest[0] += 1

    def arrived():
        return [data for each in streams for data, _ in waiting(each)]

    def fetch():
        some, kept[:] = kept[:], []
        return some

    kept = []
    callback = {"kept": kept.append, "beside": unserved, "spinner": unserved}.get(way, handle)
    streams = [
        node.create_subscription(kind, topic, callback, STREAM_QOS, raw=True)
        for kind, topic in STREAMS.items()
    ]
    node.create_subscription(FluidPressure, "rest", count, 10, raw=True)
    stop = Future()
    signal.signal(signal.SIGALRM, lambda *_: stop.set_result(None))
    while node.count_publishers("imu") == 0:
        time.sleep(0.05)
    time.sleep(SETTLE)
    arrived()
    cpu, began = time.process_time(), time.monotonic()
    signal.setitimer(signal.ITIMER_REAL, seconds)
    if way == "spinner":
        Spinner([node], Counted(arrived, handle)).spin(stop)
    else:
        executor = SingleThreadedExecutor() if way == "single" else EventsExecutor()
        executor.add_node(node)
        served, turns = 0.0, Counted(arrived if way == "beside" else fetch, handle)
        while not stop.done():
            if way in ("single", "events"):
                executor.spin_until_future_complete(stop, timeout_sec=0.2)
                continue
            if way == "kept":
                mark = executor.create_task(int)
                while not mark.done():
                    executor.spin_once(timeout_sec=0.0)
            elif time.monotonic() > served + 0.02:
                executor.spin_once(timeout_sec=0.0)
                served = time.monotonic()
            turns.take()
            time.sleep(turns.PERIOD)
    cpu, took = time.process_time() - cpu, time.monotonic() - began
    p50, p99 = np.percentile(1e-6 * np.array(late), [50, 99])
    line = (
        f"{len(late) / took:.0f} | {100 * cpu / took:.1f} | {1e6 * cpu / len(late):.0f} | "
        f"{p50:.2f} | {p99:.1f} | {rest[0] / took:.0f}"
    )
    queue.put(line)
    queue.close()
    queue.join_thread()
    os._exit(0)


if __name__ == "__main__":
    main()
