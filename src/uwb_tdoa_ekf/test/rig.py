# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""The real nodes as separate processes, and a test node that publishes and receives."""

from copy import copy
from dataclasses import dataclass, replace
import os
from pathlib import Path
import signal
import subprocess
import sys
import threading
import time

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from flights import fly
from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
import numpy as np
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import ReliabilityPolicy
from sensor_msgs.msg import FluidPressure, Imu, Range
from tf2_msgs.msg import TFMessage

from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_bias.ros.anchors import ANCHORS_QOS, anchors_to_message
from uwb_tdoa_bias.ros.node import DIAGNOSTICS_QOS
from uwb_tdoa_bias.ros.topics import STREAM_QOS
from uwb_tdoa_ekf.results import VERDICTS, rows_of
from uwb_tdoa_msgs.msg import AnchorArray, Tdoa, TdoaCorrected, TdoaResidual

EPOCH = 1_700_000_000  # s, so that stamps have a current date
# s, limit for every wait. The very first start of ekf_node compiles the filter.
PATIENCE = 180.0
AGAIN = 10.0  # s without an answer before a request is repeated
MODULES = {
    "bias_node": "uwb_tdoa_bias.bias_node",
    "ekf_node": "uwb_tdoa_ekf.ekf_node",
    "debias_node": "uwb_tdoa_ekf.debias_node",
    "localization_node": "uwb_tdoa_ekf.localization_node",
}
# nodes of one process that exchange messages directly
MEMBERS = {"localization_node": ("bias_node", "ekf_node")}
OUTPUTS = {
    "bias_node": ("uwb/tdoa_corrected",),
    "ekf_node": ("odometry", "uwb/residual"),
    "debias_node": ("odometry/debiased",),
    "localization_node": ("uwb/tdoa_corrected", "odometry", "uwb/residual"),
}
INPUTS = {
    "bias_node": ("uwb/tdoa", "odometry"),
    "ekf_node": ("imu/data", "uwb/tdoa_corrected"),
    "debias_node": ("odometry",),
    "localization_node": ("imu/data", "uwb/tdoa"),
}
STREAMS = {
    "imu/data": Imu,
    "uwb/tdoa": Tdoa,
    "uwb/tdoa_corrected": TdoaCorrected,
    "odometry": Odometry,
    "odometry/debiased": Odometry,
    "uwb/residual": TdoaResidual,
    "height": Range,
    "pressure": FluidPressure,
    "velocity": TwistWithCovarianceStamped,
    "velocity/odometry": Odometry,
}


def _rigs():
    """Give make_rig(), which returns a Rig in its own namespace.

    The processes of the Rig end with the test.
    """
    rclpy.init()
    rigs, domain = [], os.environ.get("ROS_DOMAIN_ID", "0")

    def make(**options):
        rigs.append(Rig(f"tag{len(rigs)}", **options))
        rigs[-1].domain = domain
        return rigs[-1]

    yield make
    for rig in rigs:
        rig.close()
    rclpy.shutdown()


make_rig = pytest.fixture(_rigs)
make_shared_rig = pytest.fixture(scope="module", name="make_shared_rig")(_rigs)


def recording(seconds=4.0, imu_rate=200.0, tdoa_rate=100.0):
    """Return a Flight with the stamps that a node reads from its messages."""
    flight = fly(
        seed=5,
        duration=seconds,
        imu_rate=imu_rate,
        tdoa_rate=tdoa_rate,
        accel_noise=0.01,
        gyro_noise=0.001,
    )
    streams = (flight.imu, flight.tdoa)
    imu, tdoa = (
        replace(stream, t=np.array([seconds_of(stamp(t)) for t in stream.t])) for stream in streams
    )
    return replace(flight, imu=imu, tdoa=tdoa)


def vector(v):
    """Return the coordinates of a vector message."""
    return v.x, v.y, v.z


def positions(messages):
    """Return the positions (n, 3), in m, of odometry messages."""
    return np.array([vector(message.pose.pose.position) for message in messages])


def stamp(t, epoch=EPOCH):
    """Return the stamp t s after the epoch."""
    second, nanosecond = divmod(round(t * 1e9), 10**9)
    return Time(sec=epoch + second, nanosec=nanosecond)


def seconds_of(stamp, epoch=EPOCH):
    """Return the seconds after the epoch.

    A node reads the same if its first stamp is in the first second of the epoch.
    """
    return ((stamp.sec - epoch) * 10**9 + stamp.nanosec) / 1e9


@dataclass
class Process:
    """A node in its own process group. `lines` holds its output."""

    process: subprocess.Popen
    lines: list
    reader: threading.Thread

    def stop(self, number=signal.SIGINT):
        """Send a signal to the process group and wait for its end.

        Returns the exit code, and the time in s that the process neither ran nor waited for a core.
        """
        threads = {}
        started, before, slept = time.monotonic(), worked(self.process.pid, threads), 0.0
        os.killpg(self.process.pid, number)
        while self.process.poll() is None:
            slept = time.monotonic() - started - (worked(self.process.pid, threads) - before)
            assert time.monotonic() < started + PATIENCE, f"it does not end: {''.join(self.lines)}"
            time.sleep(0.02)
        self.reader.join(timeout=PATIENCE)
        return self.process.returncode, slept

    def abort(self):
        """End the process. Its faulthandler prints what each thread does, which explains a hang."""
        self.process.send_signal(signal.SIGABRT)
        self.reader.join(timeout=10.0)


class Rig:
    """Start nodes in `namespace`, publish their inputs, and keep their outputs.

    received : {topic: messages in order of arrival}, for the streams and "/tf".
    """

    def __init__(self, namespace, listen=(*STREAMS, "/tf"), reliable=True, latched=True):
        """Create the test node.

        Parameters
        ----------
        listen : sequence of str
            Topics to keep.
        reliable : bool
            Use reliable streams, for tests in which no message may be lost.
        latched : bool
            Create a latched publisher of anchors.
        """
        self.namespace, self.domain = namespace, os.environ.get("ROS_DOMAIN_ID", "0")
        self.node = rclpy.create_node("rig", namespace=namespace)
        self._reliable, self._qos = reliable, copy(STREAM_QOS)
        if reliable:
            self._qos.reliability = ReliabilityPolicy.RELIABLE
        self.received = {topic: [] for topic in listen}
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._processes, self._publishers, self._status, self._since = {}, {}, {}, 0.0
        self._anchors = (
            self.node.create_publisher(AnchorArray, "uwb/anchors", ANCHORS_QOS) if latched else None
        )
        self._subscriptions = {
            topic: self.node.create_subscription(
                STREAMS.get(topic, TFMessage), topic, store.append, self._qos
            )
            for topic, store in self.received.items()
        }
        self.node.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, DIAGNOSTICS_QOS
        )

    @property
    def odometry(self):
        return self.received["odometry"]

    @property
    def debiased(self):
        return self.received["odometry/debiased"]

    @property
    def corrected(self):
        return self.received["uwb/tdoa_corrected"]

    @property
    def residuals(self):
        return self.received["uwb/residual"]

    def _on_diagnostics(self, message):
        if seconds_of(message.header.stamp, 0) > self._since:
            self._status.update((status.name, status) for status in message.status)

    def start(self, *names, **arguments):
        """Start nodes, with arguments by name of the node. Return when all endpoints are connected.

        The rig publishes the topics that no started node publishes. After the return, no message is
        lost.
        """
        for name in names:
            command = [
                sys.executable,
                "-u",
                "-X",
                "faulthandler",
                "-m",
                MODULES[name],
                "--ros-args",
                "-r",
                f"__ns:=/{self.namespace}",
            ]
            if self._reliable:
                for end in (
                    *(f"{i}.subscription" for i in INPUTS[name]),
                    *(f"{o}.publisher" for o in OUTPUTS[name]),
                ):
                    command += [
                        "-p",
                        f"qos_overrides./{self.namespace}/{end}.reliability:=reliable",
                    ]
            process = subprocess.Popen(
                [*command, *arguments.get(name, ())],
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                start_new_session=True,
                env={**os.environ, "ROS_DOMAIN_ID": self.domain},
            )
            lines = []
            reader = threading.Thread(target=_collect, args=(process.stdout, lines), daemon=True)
            reader.start()
            self._processes[name] = Process(process, lines, reader)
        self.meet(*names)
        return [self._processes[name] for name in names]

    def meet(self, *names):
        """Wait until the given nodes and the rig receive each other.

        Any process may have started the nodes.
        """
        made = {topic for name in names for topic in OUTPUTS[name]}
        taken = {topic for name in names for topic in INPUTS[name]}
        for topic in taken - made:
            self._publishers[topic] = self.node.create_publisher(STREAMS[topic], topic, self._qos)

        def all_matched():
            nodes = [node for name in names for node in MEMBERS.get(name, [name])]
            heard = [
                self.values(node).get(f"publishers of {topic}")
                for node in nodes
                for topic in INPUTS[node]
            ]
            hearing = [
                self.values(node).get(f"subscribers of {topic}")
                == str((topic in taken) + (topic in self.received))
                for node in nodes
                for topic in OUTPUTS[node]
            ]
            return (
                all(count == "1" for count in heard)
                and all(hearing)
                and all(
                    publisher.get_subscription_count() for publisher in self._publishers.values()
                )
                and all(
                    self._subscriptions[topic].get_publisher_count()
                    for topic in made & self._subscriptions.keys()
                )
            )

        self.wait(all_matched, "all to have found each other")

    def add_publisher(self, topic):
        """Publish an optional input of a node."""
        publisher = self._publishers[topic] = self.node.create_publisher(
            STREAMS[topic], topic, self._qos
        )
        self.wait(publisher.get_subscription_count, f"{topic} to be heard")

    def pose_publisher(self, process):
        """Return a publisher of initialpose from which the node of `process` receives.

        The node has been started and has anchors.

        A node may receive from a publisher later than the publisher sees it. Therefore, poses in
        unknown frames are published until the node has refused the last. None is under way on
        return.
        """
        publisher, sent = (
            self.node.create_publisher(PoseWithCovarianceStamped, "initialpose", 100),
            [],
        )
        self.wait(publisher.get_subscription_count, "initialpose to be heard")

        def refused():
            message = PoseWithCovarianceStamped()
            message.header.frame_id = f"nowhere{len(sent)}"
            sent.append(f"initialpose: not taken: its frame is '{message.header.frame_id}'")
            publisher.publish(message)
            pause = time.monotonic() + 0.5
            while time.monotonic() < pause and not said():
                self._executor.spin_once(timeout_sec=0.05)
            return said()

        def said():
            return any(sent[-1] in line for line in process.lines)

        self.wait(refused, "a pose of no frame to be refused")
        return publisher

    def watch(self, process):
        """Stop every wait if this Process ends. It starts nodes itself."""
        self._processes["launch"] = process

    def close(self):
        """End all processes and the test node."""
        for process in self._processes.values():
            if process.process.poll() is None:
                os.killpg(process.process.pid, signal.SIGKILL)
            process.process.wait()
            process.reader.join()
            process.process.stdout.close()
        self._executor.shutdown()
        self.node.destroy_node()

    def wait(self, condition, what):
        """Receive messages until condition() holds."""
        deadline = time.monotonic() + PATIENCE
        while not condition():
            self._executor.spin_once(timeout_sec=0.1)
            for name, process in self._processes.items():
                assert process.process.poll() is None, f"{name} has ended: {''.join(process.lines)}"
            if time.monotonic() > deadline:
                for process in self._processes.values():
                    if isinstance(process, Process):
                        process.abort()
                said = "".join(
                    line for process in self._processes.values() for line in process.lines
                )
                accounts = {name: self.values(name) for name in self._processes}
                raise AssertionError(f"waited {PATIENCE} s for {what}; {accounts}; {said}")

    def answer(self, ask, what):
        """Return the result of the Future of ask().

        It asks again after AGAIN seconds. The middleware drops an answer to a client that it has
        not discovered yet. A killed node also seems to exist for some time.
        """
        asked = []

        def answered():
            if not asked or time.monotonic() > asked[-1][0] + AGAIN:
                asked.append((time.monotonic(), ask()))
            return any(future.done() for _, future in asked)

        self.wait(answered, f"an answer of {what}")
        return next(future.result() for _, future in asked if future.done())

    def values(self, name):
        """Return {key: text} of the last diagnostics of a node, empty before the first."""
        status = self._status.get(f"/{self.namespace}/{name}")
        return {entry.key: entry.value for entry in status.values} if status else {}

    def fresh_status(self, name):
        """Wait for diagnostics of a node that are newer than this call."""
        self._since = time.time()
        self._status.clear()
        self.wait(lambda: self.values(name), f"diagnostics of {name}")
        return self._status[f"/{self.namespace}/{name}"]

    def counts(self, name, **expected):
        """Return {key: int} of all counts of a node.

        Wait until the named counts have the expected values and all sent messages have arrived.
        """
        own = {
            "bias_node": {"uwb/tdoa_corrected": ["published"]},
            "ekf_node": {"odometry": ["odometry published"], "uwb/residual": VERDICTS.values()},
            "debias_node": {"odometry/debiased": ["received"]},
        }[name]

        def arrived():
            values = self.values(name)
            return (
                values
                and all(
                    values[key.replace("_", " ")] == str(value) for key, value in expected.items()
                )
                and all(
                    sum(int(values[key]) for key in keys) == len(self.received[topic])
                    for topic, keys in own.items()
                    if topic in self.received
                )
            )

        self.fresh_status(name)
        self.wait(arrived, f"{name} to count {expected}")
        return {key: int(value) for key, value in self.values(name).items() if value.isdigit()}

    def send_anchors(self, anchors, publisher=None):
        """Publish anchors.

        Parameters
        ----------
        anchors : Anchors or AnchorArray
            An AnchorArray is sent unchanged.
        publisher : Publisher, optional
            Default: the latched one.
        """
        publisher = publisher or self._anchors
        publisher.publish(
            anchors if isinstance(anchors, AnchorArray) else anchors_to_message(anchors)
        )

    def send(self, topic, message, t, frame="base_link", epoch=EPOCH):
        """Publish a message with the stamp of t s after the epoch."""
        message.header.stamp, message.header.frame_id = stamp(t, epoch), frame
        self._publishers[topic].publish(message)

    @staticmethod
    def imu_message(gyro=(0.0, 0.0, 0.0), accel=(0.0, 0.0, 9.81)):
        message = Imu()
        rate, acceleration = message.angular_velocity, message.linear_acceleration
        rate.x, rate.y, rate.z = map(float, gyro)
        acceleration.x, acceleration.y, acceleration.z = map(float, accel)
        return message

    def send_imu(self, t, gyro=(0.0, 0.0, 0.0), accel=(0.0, 0.0, 9.81), epoch=EPOCH):
        self.send("imu/data", self.imu_message(gyro, accel), t, epoch=epoch)

    @staticmethod
    def tdoa_message(a, b, d, variance=0.0):
        return Tdoa(
            anchor_a=int(a), anchor_b=int(b), distance_difference=float(d), variance=float(variance)
        )

    def send_tdoa(self, t, a, b, d, epoch=EPOCH, variance=0.0):
        self.send("uwb/tdoa", self.tdoa_message(a, b, d, variance), t, epoch=epoch)

    def send_corrected(self, t, a, b, d, epoch=EPOCH, variance=0.0):
        message = TdoaCorrected(
            anchor_a=int(a), anchor_b=int(b), raw=float(d), corrected=float(d), model="none"
        )
        message.variance = float(variance)
        self.send("uwb/tdoa_corrected", message, t, epoch=epoch)

    def send_pose(self, t, p=(0.0, 0.0, 0.0), epoch=EPOCH):
        message = Odometry(child_frame_id="base_link")
        message.pose.pose.position.x, message.pose.pose.position.y, message.pose.pose.position.z = (
            map(float, p)
        )
        self.send("odometry", message, t, "map", epoch)

    def send_sensor(self, topic, flight, i, epoch=EPOCH):
        """Publish measurement i of a Flight's height, pressure or velocity on the given topic."""
        part = getattr(flight, topic.partition("/")[0])
        message = STREAMS[topic]()
        if topic == "height":
            message.range, message.max_range = float(part.range[i]), 10.0
        elif topic == "pressure":
            message.fluid_pressure = float(part.pressure[i])
        else:
            linear = message.twist.twist.linear
            linear.x, linear.y, linear.z = part.v[i].tolist()
            content = SENSORS["velocity"].content(rows_of(part, slice(i, i + 1)))
            message.twist.twist.angular.z = float(content["twist.twist.angular"][0, 2])
            message.twist.covariance = content["twist.covariance"][0]
        self.send(topic, message, part.t[i], epoch=epoch)

    def play(self, flight, epoch=EPOCH, ahead=0.025, send_tdoa=None, sensors=()):
        """Send a Flight in stamp order.

        Return when all TDOAs before the last `ahead` s have residuals. The stamps are never more
        than `ahead` s ahead of the nodes. Further ahead, the result would depend on timing during
        the start of the filter: bias_node cannot know yet that poses will come.

        sensors : topics of height, pressure or velocity to send, too.
        """
        imu, tdoa = flight.imu, flight.tdoa
        of_sensors = sorted(
            (t, topic, i)
            for topic in sensors
            for i, t in enumerate(getattr(flight, topic.partition("/")[0]).t)
        )
        before, i = len(self.residuals), 0
        for k, t in enumerate(tdoa.t):
            while i < len(imu) and imu.t[i] <= t:
                self.send_imu(imu.t[i], imu.gyro[i], imu.accel[i], epoch)
                i += 1
            while of_sensors and of_sensors[0][0] <= t:
                self.send_sensor(*of_sensors[0][1:2], flight, of_sensors.pop(0)[2], epoch)
            (send_tdoa or self.send_tdoa)(
                t, tdoa.a[k], tdoa.b[k], tdoa.d[k], epoch, tdoa.variance[k]
            )
            due = before + np.searchsorted(tdoa.t, t - ahead)
            self.wait(lambda due=due: len(self.residuals) >= due, f"{due} residuals")
        for t, gyro, accel in zip(imu.t[i:], imu.gyro[i:], imu.accel[i:]):
            self.send_imu(t, gyro, accel, epoch)


def _collect(stream, lines):
    for line in stream:
        lines.append(line)


def worked(pid, threads=None):
    """Return the time in s that the threads of a process ran or waited for a core.

    threads : {path: nanoseconds}, updated by each call. It keeps the times of ended threads.
    """
    threads = {} if threads is None else threads
    for file in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        try:
            threads[file] = sum(map(int, file.read_text().split()[:2]))
        except (OSError, ValueError):  # the thread has ended
            continue
    return 1e-9 * sum(threads.values())
