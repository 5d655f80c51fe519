# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""An autopilot_node as a process, with an autopilot on loopback.

A node of the test publishes odometry.
"""

from contextlib import contextmanager
import os
import signal
import subprocess
import threading
import time

from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
import numpy as np
from programs import start
import rclpy
from rclpy.executors import SingleThreadedExecutor
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.ros.anchors import ANCHORS_QOS as STATUS_QOS
from uwb_tdoa_bias.ros.topics import OUTPUT_QOS
from uwb_tdoa_msgs.msg import EstimatorStatus

PATIENCE = 120.0  # s, limit of each wait
PERIOD = 0.005  # s, period of odometry


class Px4:
    """A receiver of MAVLink.

    odometry : received ODOMETRY messages
    beats : HEARTBEAT messages of the node
    """

    def __init__(self):
        os.environ["MAVLINK20"] = "1"
        from pymavlink import mavutil

        self.port = mavutil.mavlink_connection(
            "udpin:127.0.0.1:0", source_system=1, source_component=1, dialect="common"
        )
        self.dialect = mavutil.mavlink
        self.address = f"127.0.0.1:{self.port.port.getsockname()[1]}"
        self.odometry, self.beats, self.answers, self.texts = [], [], [], []

    def receive(self):
        while (message := self.port.recv_msg()) is not None:
            kind = message.get_type()
            {
                "ODOMETRY": self.odometry,
                "HEARTBEAT": self.beats,
                "TIMESYNC": self.answers,
                "STATUSTEXT": self.texts,
            }[kind].append(message)

    def beat(self):
        self.port.mav.heartbeat_send(self.dialect.MAV_TYPE_QUADROTOR, 12, 0, 0, 4)

    def close(self):
        self.port.close()


class Bench:
    """The node under test, and everything that the test sends and receives.

    lines : output of the node
    values : values of its /diagnostics
    """

    def __init__(self, turn):
        self.node, self.values, self.text, self.gated = rclpy.create_node("bench"), {}, "", []
        self._turn, self._executor = turn, SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._odometry = self.node.create_publisher(Odometry, "odometry", OUTPUT_QOS)
        self._status = self.node.create_publisher(EstimatorStatus, "status", STATUS_QOS)
        self.node.create_subscription(Odometry, "odometry/gated", self.gated.append, OUTPUT_QOS)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self.lines, self.process, self.sent = [], None, 0

    def _on_diagnostics(self, message):
        for status in message.status:
            if status.name == "/autopilot_node":
                self.values = {pair.key: pair.value for pair in status.values}
                self.text = status.message

    def start(self, *parameters):
        """Start the node. Wait until both sides have discovered each other."""
        words = ["--ros-args", *(word for value in parameters for word in ("-p", value))]
        words += ["-p", "qos_overrides./odometry.subscription.reliability:=reliable"]
        self.process = start(
            *("-u", "-m", "uwb_tdoa_tools.autopilot_node", *words),
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        self._reader = threading.Thread(target=self._collect, daemon=True)
        self._reader.start()
        self.wait(
            lambda: (
                self.values.get("publishers of odometry") == "1"
                and self.values.get("subscribers of odometry/gated") == "1"
                and self._status.get_subscription_count()
                and self._odometry.get_subscription_count()
            ),
            "the node",
        )

    def _collect(self):
        for line in self.process.stdout:
            self.lines.append(line)

    def wait(self, condition, what):
        """Process messages until condition() is true."""
        until = time.monotonic() + PATIENCE
        while not condition():
            self._executor.spin_once(timeout_sec=0.005)
            self._turn()
            assert self.process.poll() is None, f"the node has ended: {''.join(self.lines)}"
            assert time.monotonic() < until, f"no {what}: {self.text} {self.values}"

    def tell(self, status, yaw_known=True, why=""):
        """Publish a status."""
        self._status.publish(EstimatorStatus(status=status, yaw_known=yaw_known, why=why))

    def publish(self, messages):
        """Publish odometry messages."""
        for message in messages:
            self._odometry.publish(message)
            self.sent += 1

    def settle(self):
        """Wait until the diagnostics of the node count all messages sent so far."""
        self.wait(lambda: self.values.get("received") == str(self.sent), "count of all messages")

    def end(self):
        """Send Ctrl-C and return the exit code."""
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(timeout=PATIENCE)

    def close(self):
        if self.process is not None:
            if self.process.poll() is None:
                os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
            self._reader.join()
            self.process.stdout.close()
        self._executor.shutdown()
        self.node.destroy_node()


@contextmanager
def bench(turn):
    """Return a Bench that calls turn() while it waits."""
    rclpy.init()
    made = Bench(turn)
    try:
        yield made
    finally:
        made.close()
        rclpy.shutdown()


class Path:
    """A helix that a vehicle flies nose first, banked and pitched, with noisy estimates.

    The errors of the estimates match their covariance. truth : positions (n, 3), m.
    """

    def __init__(self, seconds, seed=1):
        """seconds : length of the path, s."""
        rng = np.random.default_rng(seed)
        self.t = np.arange(0.0, seconds, PERIOD)
        angle = 0.8 * self.t
        self.truth = np.stack([np.cos(angle), np.sin(angle), 0.3 + 0.2 * self.t], axis=1)
        v = np.stack([-0.8 * np.sin(angle), 0.8 * np.cos(angle), 0.2 + 0.0 * angle], axis=1)
        turn = Rotation.from_euler(
            "ZYX", np.stack([angle + 0.5 * np.pi, -0.2 + 0.0 * angle, 0.1 + 0.0 * angle], axis=1)
        )
        pose, twist = _covariance(rng, 0.03), _covariance(rng, 0.05)
        # slowly varying, as errors of a filter
        slow = rng.multivariate_normal(np.zeros(3), pose[:3, :3])
        n = len(self.t)
        self.pose = np.hstack([self.truth + slow, turn.as_quat(), np.tile(pose.ravel(), (n, 1))])
        rates = np.tile([0.1, -0.2, 0.8], (n, 1))
        self.twist = np.hstack([turn.inv().apply(v), rates, np.tile(twist.ravel(), (n, 1))])

    def messages(self, begin):
        """Return the Odometry messages of the path.

        The first has the stamp `begin`, s since 1970.
        """
        return [message_of(begin + t, *row) for t, *row in zip(self.t, self.pose, self.twist)]


def at_rest(count, step=PERIOD, jump=0.0):
    """Return messages of a vehicle at rest, `step` s apart, up to now.

    jump : shift of the second half, m
    """
    path = Path(PERIOD)
    pose, twist = path.pose[0], path.twist[0]
    twist[:6] = 0.0
    now, out = time.time(), []
    for k in range(count):
        pose[0] = path.truth[0, 0] + (jump if 2 * k >= count else 0.0)
        out.append(message_of(now - step * (count - 1 - k), pose, twist))
    return out


def _covariance(rng, std):
    """Return a covariance (6, 6) with correlations and variances of about std^2."""
    root = std * (np.eye(6) + 0.3 * rng.standard_normal((6, 6)))
    return root @ root.T


def message_of(t, pose, twist):
    """Return an Odometry at t s since 1970. pose : (43,), twist : (42,) numbers."""
    message = Odometry(child_frame_id="base_link")
    message.header.frame_id = "map"
    nanoseconds = round(1e9 * t)
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)
    at, turn = message.pose.pose.position, message.pose.pose.orientation
    at.x, at.y, at.z, turn.x, turn.y, turn.z, turn.w = pose[:7].tolist()
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    linear.x, linear.y, linear.z, angular.x, angular.y, angular.z = twist[:6].tolist()
    message.pose.covariance, message.twist.covariance = pose[7:], twist[6:]
    return message


def usec(message):
    """Return the stamp of an Odometry, us since 1970."""
    return message.header.stamp.sec * 10**6 + message.header.stamp.nanosec // 1000


def numbers(message):
    """Return (position, Rotation, velocity, angular velocity, both covariances) of an Odometry."""
    at, turn = message.pose.pose.position, message.pose.pose.orientation
    linear, angular = message.twist.twist.linear, message.twist.twist.angular
    return (
        np.array([at.x, at.y, at.z]),
        Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]),
        np.array([linear.x, linear.y, linear.z]),
        np.array([angular.x, angular.y, angular.z]),
        np.reshape(message.pose.covariance, (6, 6)),
        np.reshape(message.twist.covariance, (6, 6)),
    )


def numbers_of_mavlink(message):
    """Return the same as `numbers`, from an ODOMETRY of MAVLink."""
    w, x, y, z = message.q
    return (
        np.array([message.x, message.y, message.z]),
        Rotation.from_quat([x, y, z, w]),
        np.array([message.vx, message.vy, message.vz]),
        np.array([message.rollspeed, message.pitchspeed, message.yawspeed]),
        _whole(message.pose_covariance),
        _whole(message.velocity_covariance),
    )


def _whole(upper):
    """Return the matrix (6, 6) from its upper triangle by rows, (21,)."""
    whole, k = np.empty((6, 6)), 0
    for i in range(6):
        for j in range(i, 6):
            whole[i, j] = whole[j, i] = upper[k]
            k += 1
    return whole
