# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Test whether ekf_node reports in flight the mistakes that `check` finds in recordings.

A part of a flight, with each mistake, is played to both nodes as it would have arrived.
"""

from collections import Counter
from dataclasses import replace
import json
from pathlib import Path
import tempfile
import time

from mistakes import MISTAKES, arriving
import numpy as np

from uwb_tdoa_bias.common.files import write_text
from uwb_tdoa_tools import choices
from uwb_tdoa_tools.checking.recording import of_flight
from uwb_tdoa_tools.checking.tdoa_rules import largest_displacement
from uwb_tdoa_tools.outputs import OutputFile
from uwb_tdoa_tools.readers import inputs, read_survey

from .figures import ANOTHER, possible

# s on the clock of the robot at which a part begins: no mistake makes a stamp negative
BOOT = 100.0
EVERY = 4  # play each fourth inertial sample: a busy computer must not look like a mistake
SETTLED = 3.0  # s of flight before reports count
NOT_PLAYED = {"turned_frame"}  # speaks of /tf_static
READY, PAUSE = 180.0, 1.5  # s: the very first start compiles the filter; between two mistakes


def add_options(add):
    """add : add_argument of a parser."""
    add("flight", metavar="FLIGHT", help=choices.RECORDINGS)
    add("--survey", required=True, metavar="DIR", help="folder of all surveys")
    add(
        "--seconds",
        type=float,
        default=12.0,
        metavar="S",
        help="of the middle of the flight (default %(default)s)",
    )
    add(
        "--only",
        nargs="+",
        metavar="MISTAKE",
        choices=[*MISTAKES, "nothing"],
        help="of those of the study checking",
    )
    add("--json", metavar="FILE", type=OutputFile, help="write what was said of each")


def run(args):
    """Print the table."""
    reading = inputs.Reading(args.survey)
    flight = of_flight(reading.one(args.flight))
    surveys = [read_survey(path) for path in sorted(Path(args.survey).glob("anchor_?*"))]
    rooms = [
        anchors for anchors in surveys if largest_displacement(anchors, flight.anchors) > ANOTHER
    ]
    part = middle(flight, args.seconds)
    rows = []
    print("| mistake | `check` | `ekf_node` |\n| --- | --- | --- |")
    with _Nodes() as nodes:
        for name in ["nothing", *MISTAKES] if args.only is None else args.only:
            mistake = MISTAKES.get(name)
            if name in NOT_PLAYED or (mistake and not possible(mistake, part, None, rooms)):
                continue
            rng = np.random.default_rng([0, *name.encode()])
            other = (
                rooms[int(rng.integers(len(rooms)))]
                if mistake and mistake.needs == "rooms"
                else None
            )
            made = mistake.make(arriving(part, 0), rng, other) if mistake else arriving(part, 0)
            rows.append({"mistake": name, **nodes.said(made)})
            print(line(rows[-1]), flush=True)
            if args.json:
                write_text(args.json, json.dumps(rows, indent=1))


def line(row):
    """A row of the table: the mistake, its rule in `check`, and the rules that the node reported.

    If it reported none, its most frequent message.
    """
    mistake = MISTAKES.get(row["mistake"])
    text = max(row["texts"], key=row["texts"].get) if row["texts"] else "nothing at all"
    said = (
        ", ".join(f"`{rule}`" for rule in sorted(row["rules"]))
        or text.partition(":")[0].partition(" (")[0]
    )
    named = " or ".join(f"`{rule}`" for rule in mistake.named) if mistake else ""
    return f"| {mistake.text if mistake else 'nothing'} | {named} | {said} |"


def middle(recording, seconds):
    """The Recording of so many seconds in the middle, on a clock that begins with them."""
    tdoa, imu = recording.tdoa, recording.imu
    begin = 0.5 * (tdoa.t[0] + tdoa.t[-1] - seconds)

    def cut(stream, every=1):
        rows = np.flatnonzero((stream.t >= begin) & (stream.t < begin + seconds))[::every]
        columns = {name: column[rows] for name, column in vars(stream).items()}
        return replace(stream, **columns | {"t": columns["t"] - begin + BOOT})

    return replace(recording, tdoa=cut(tdoa), imu=None if imu is None else cut(imu, EVERY))


class _Nodes:
    """bias_node and ekf_node as processes in a separate domain, with publishers of their input."""

    def __enter__(self):
        from contextlib import ExitStack

        from rclpy.qos import QoSProfile
        from sensor_msgs.msg import Imu
        from std_srvs.srv import Trigger

        from uwb_tdoa_bias.ros.anchors import ANCHORS_QOS
        from uwb_tdoa_msgs.msg import AnchorArray, Tdoa
        from uwb_tdoa_tools.live.processes import DiagnosticsListener, Processes, own_domain, wait
        from uwb_tdoa_tools.live.session import session

        self._stack = ExitStack()
        enter = self._stack.enter_context
        enter(own_domain())
        self._node, stop = enter(session("study", []))
        self._processes = processes = enter(Processes(enter(tempfile.TemporaryDirectory()), stop))
        self._reset = self._node.create_client(Trigger, "ekf_node/reset")
        self._anchors = self._node.create_publisher(AnchorArray, "uwb/anchors", ANCHORS_QOS)
        self._imu = self._node.create_publisher(Imu, "imu/data", QoSProfile(depth=1000))
        self._tdoa = self._node.create_publisher(Tdoa, "uwb/tdoa", QoSProfile(depth=1000))
        diagnostics = DiagnosticsListener(self._node)
        processes.start("uwb_tdoa_bias", "bias_node")
        processes.start("uwb_tdoa_ekf", "ekf_node")
        ends = (self._anchors, self._imu, self._tdoa)
        wait(
            READY,
            "the nodes",
            processes,
            self._node,
            lambda: (
                diagnostics.newest("ekf_node").get("publishers of uwb/tdoa_corrected") == "1"
                and diagnostics.newest("bias_node").get("publishers of uwb/tdoa") == "1"
                and all(end.get_subscription_count() for end in ends)
                and self._reset.service_is_ready()
            ),
        )
        self._statuses = []
        self._listen()
        return self

    def __exit__(self, *_):
        self._stack.close()

    def _listen(self):
        from diagnostic_msgs.msg import DiagnosticArray

        def take(message):
            self._statuses.extend(status for status in message.status if status.name == "/ekf_node")

        self._node.create_subscription(DiagnosticArray, "/diagnostics", take, 10)

    def said(self, recording):
        """{"texts": {what was said: seconds}, "rules": {what was found: seconds}} of a Recording
        with arrivals.
        """
        from std_srvs.srv import Trigger

        from uwb_tdoa_bias.ros.anchors import anchors_to_message

        self._anchors.publish(anchors_to_message(recording.anchors))
        self._reset.call_async(Trigger.Request())
        self._spin_until(time.monotonic() + PAUSE)
        messages = sorted(self._messages(recording), key=lambda message: message[0])
        first, begin = messages[0][0], time.monotonic()
        self._statuses.clear()
        counting = False
        for arrival, publisher, message in messages:
            due = begin + arrival - first
            if due > time.monotonic():
                self._spin_until(due)
            if not counting and due > begin + SETTLED:
                counting = True
                self._statuses.clear()
            publisher.publish(message)
        texts = Counter(status.message for status in self._statuses)
        rules = Counter(
            pair.key.removeprefix("found ")
            for status in self._statuses
            for pair in status.values
            if pair.key.startswith("found ")
        )
        return {"texts": dict(texts), "rules": dict(rules)}

    def _spin_until(self, due):
        import rclpy

        while (left := due - time.monotonic()) > 0.0:
            self._processes.check()  # also whether we are asked to end
            rclpy.spin_once(self._node, timeout_sec=left)

    def _messages(self, recording):
        """Yield (arrival s, publisher, message)."""
        from builtin_interfaces.msg import Time
        from geometry_msgs.msg import Vector3
        from sensor_msgs.msg import Imu
        from std_msgs.msg import Header

        from uwb_tdoa_msgs.msg import Tdoa

        def header(topic, t):
            frames = recording.frames.get(topic, {"base_link": 1})
            return Header(
                stamp=Time(sec=int(t // 1.0), nanosec=int(t % 1.0 * 1e9)),
                frame_id=next(iter(frames)),
            )

        imu, tdoa = recording.imu, recording.tdoa
        if imu is not None:
            for arrival, t, gyro, accel in zip(
                recording.imu_arrival, *(c.tolist() for c in (imu.t, imu.gyro, imu.accel))
            ):
                vectors = (Vector3(x=v[0], y=v[1], z=v[2]) for v in (gyro, accel))
                rate, force = vectors
                yield (
                    arrival,
                    self._imu,
                    Imu(
                        header=header("imu/data", t),
                        angular_velocity=rate,
                        linear_acceleration=force,
                    ),
                )
        for arrival, t, a, b, d in zip(
            recording.tdoa_arrival, *(c.tolist() for c in (tdoa.t, tdoa.a, tdoa.b, tdoa.d))
        ):
            yield (
                arrival,
                self._tdoa,
                Tdoa(header=header("uwb/tdoa", t), anchor_a=a, anchor_b=b, distance_difference=d),
            )
