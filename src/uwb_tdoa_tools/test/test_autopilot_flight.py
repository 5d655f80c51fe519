# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""A measured flight through the real nodes to an autopilot.

It includes a wrong pose, the recovery from it, a reset, and a loss of all TDOAs.

The clock advances when the nodes have kept up, so a busy machine changes nothing. It is not faster
than real time, because `status` is published in real time.
"""

from contextlib import contextmanager
import time

import numpy as np
import pytest

rclpy = pytest.importorskip("rclpy")
pytest.importorskip("uwb_tdoa_msgs.msg", reason="needs the built workspace: ./dev build")
pytest.importorskip("pymavlink")

from autopilots import Px4, numbers, usec  # noqa: E402
from geometry_msgs.msg import PoseWithCovarianceStamped  # noqa: E402
from nav_msgs.msg import Odometry  # noqa: E402
from rosgraph_msgs.msg import Clock  # noqa: E402
from sensor_msgs.msg import Imu  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from uwb_tdoa_bias.ros.anchors import ANCHORS_QOS, anchors_to_message  # noqa: E402
from uwb_tdoa_bias.ros.topics import OUTPUT_QOS  # noqa: E402
from uwb_tdoa_msgs.msg import AnchorArray, Tdoa  # noqa: E402
from uwb_tdoa_tools.live.processes import Processes, own_domain, wait  # noqa: E402
from uwb_tdoa_tools.live.session import session  # noqa: E402
from uwb_tdoa_tools.readers import read_flight  # noqa: E402

pytestmark = pytest.mark.slow  # starts nodes

EPOCH = 1_700_000_000  # s
STEP = 0.05  # s of the flight
PATIENCE, IMPATIENCE = (
    5.0,
    0.05,
)  # s of real time: limit for odometry, and limit for the next if none came
POSE, RESET, SILENCE, END = 12.0, 18.0, (23.0, 32.0), 37.0  # s of the flight
RATE = 50.0
NODES = {
    ("uwb_tdoa_bias", "bias_node"): ["qos_overrides./uwb/tdoa.subscription.reliability:=reliable"],
    ("uwb_tdoa_ekf", "ekf_node"): [
        "qos_overrides./imu/data.subscription.reliability:=reliable",
        "initial_yaw:=0.0",
        "initial_yaw_std:=0.1",
    ],
}


class Player:
    """Play a flight and record the output of the nodes."""

    def __init__(self, node, processes, flight, px4):
        self.node, self.px4, self.gated, self._processes = node, px4, [], processes
        self._begin, self._newest, self._silent = flight.imu.t[0], 0.0, False
        self._due = 0.0  # time.monotonic() at which a step may end, s
        make = node.create_publisher
        self._tdoas, self._samples = (
            make(Tdoa, "uwb/tdoa", OUTPUT_QOS),
            make(Imu, "imu/data", OUTPUT_QOS),
        )
        self._clock, self._anchors = (
            make(Clock, "/clock", 10),
            make(AnchorArray, "uwb/anchors", ANCHORS_QOS),
        )
        self._pose = make(PoseWithCovarianceStamped, "initialpose", 10)
        self._reset = node.create_client(Trigger, "ekf_node/reset")
        node.create_subscription(Odometry, "odometry", self._on_odometry, OUTPUT_QOS)
        node.create_subscription(Odometry, "odometry/gated", self.gated.append, OUTPUT_QOS)
        self._anchors.publish(anchors_to_message(flight.anchors))
        rows = [(t, None, k) for k, t in enumerate(flight.tdoa.t)]
        rows += [(t, k, None) for k, t in enumerate(flight.imu.t) if k % 5 == 0]
        self._rows, self._flight = sorted(rows, key=lambda row: row[0]), flight

    def _on_odometry(self, message):
        self._newest = 1e-6 * usec(message) - EPOCH

    def wait(self, condition, what):
        wait(400.0, what, self._processes, self.node, condition)

    def is_connected(self):
        self.px4.receive()
        return (
            self.px4.beats
            and self._tdoas.get_subscription_count()
            and self._samples.get_subscription_count()
            and self._clock.get_subscription_count() == 3
            and self.node.count_publishers("odometry/gated")
            and self.node.count_subscribers("odometry") == 3
            and self._reset.service_is_ready()
            and self._pose.get_subscription_count()
        )

    def play(self, until, silent=(0.0, 0.0)):
        """Play up to a time of the flight, s; without TDOAs from silent[0] to silent[1]."""
        while self._rows and self._rows[0][0] - self._begin < until:
            end = self._rows[0][0] - self._begin + STEP
            while self._rows and self._rows[0][0] - self._begin < end:
                self._publish(*self._rows.pop(0), silent)
            self._keep_up(end)

    def _publish(self, t, sample, tdoa, silent):
        t -= self._begin
        if sample is not None:
            message, imu = Imu(), self._flight.imu
            rates, forces = message.angular_velocity, message.linear_acceleration
            rates.x, rates.y, rates.z = imu.gyro[sample].tolist()
            forces.x, forces.y, forces.z = imu.accel[sample].tolist()
            self._stamp(message.header, t, "base_link")
            self._samples.publish(message)
        elif not silent[0] <= t < silent[1]:
            of = self._flight.tdoa
            message = Tdoa(anchor_a=int(of.a[tdoa]), anchor_b=int(of.b[tdoa]))
            message.distance_difference = float(of.d[tdoa])
            self._stamp(message.header, t, "base_link")
            self._tdoas.publish(message)

    def _keep_up(self, end):
        """Set the clock. Wait for odometry of this time and for the messages to the autopilot."""
        due, self._due = self._due, time.monotonic() + STEP
        while time.monotonic() < due:
            rclpy.spin_once(self.node, timeout_sec=0.01)
        clock = Clock()
        clock.clock.sec, clock.clock.nanosec = divmod(round(1e9 * (EPOCH + end)), 10**9)
        self._clock.publish(clock)
        limit = time.monotonic() + (IMPATIENCE if self._silent else PATIENCE)
        while self._newest < end - STEP and time.monotonic() < limit:
            rclpy.spin_once(self.node, timeout_sec=0.01)
        self._silent = self._newest < end - STEP
        self.px4.beat()
        answers = len(self.px4.answers)
        self.px4.port.mav.timesync_send(0, round(1e9 * end))
        while len(self.px4.answers) == answers:
            rclpy.spin_once(self.node, timeout_sec=0.002)
            self.px4.receive()
            self._processes.check()

    def _stamp(self, header, t, frame):
        header.stamp.sec, header.stamp.nanosec = divmod(round(1e9 * (EPOCH + t)), 10**9)
        header.frame_id = frame

    def set_wrong_pose(self, place, t):
        message = PoseWithCovarianceStamped()
        self._stamp(message.header, t, "map")
        at = message.pose.pose.position
        at.x, at.y, at.z = place
        message.pose.covariance = np.diag([0.05**2] * 3 + [0.0] * 3).ravel()
        self._pose.publish(message)

    def reset(self):
        answer = self._reset.call_async(Trigger.Request())
        self.wait(answer.done, "the reset")
        assert answer.result().success


@contextmanager
def playing(folder, flight, px4):
    """Give a Player of a flight. The nodes have discovered each other."""
    with own_domain(), session("test", []) as (node, stop), Processes(folder, stop) as processes:
        autopilot = [
            "protocol:=mavlink",
            f"connection:=udpout:{px4.address}",
            f"rate:={RATE}",
            "qos_overrides./odometry.subscription.reliability:=reliable",
        ]
        for (package, name), values in {
            **NODES,
            ("uwb_tdoa_tools", "autopilot_node"): autopilot,
        }.items():
            words = [word for value in ["use_sim_time:=true", *values] for word in ("-p", value)]
            processes.start(package, name, "--ros-args", *words)
        player = Player(node, processes, flight, px4)
        player.wait(player.is_connected, "the nodes")
        yield player


def test_an_autopilot_gets_a_measured_flight(shared_data, tmp_path):
    log, survey = shared_data / "flights/0426/0426-traj7", shared_data / "surveys/anchor_0426.txt"
    flight, px4 = read_flight(log, survey), Px4()
    begin = flight.imu.t[0]

    def truth(t):
        return np.array([np.interp(begin + t, flight.truth.t, axis) for axis in flight.truth.p.T])

    try:
        with playing(tmp_path, flight, px4) as player:
            player.play(POSE)
            player.set_wrong_pose(truth(POSE) + [2.0, 2.0, 0.0], POSE)
            player.play(RESET)
            player.reset()
            player.play(END, SILENCE)
        stream = [(1e-6 * m.time_usec - EPOCH, m) for m in px4.odometry]
    finally:
        px4.close()
    _check_start(stream, truth)
    _check_jumps(stream, truth)
    _check_silences(stream)
    _check_for_mavros(player.gated)


def _check_start(stream, truth):
    first = stream[0][0]
    assert first < 6.0
    steady = [(t, m) for t, m in stream if t < POSE]
    assert (len(steady) - 1) / (steady[-1][0] - first) == pytest.approx(RATE, rel=0.02)
    assert {m.reset_counter for _, m in steady} == {0}
    errors = [np.linalg.norm([m.x, -m.y, -m.z] - truth(t)) for t, m in steady if t > 6.0]
    assert np.median(errors) < 0.4 and np.max(errors) < 1.0
    climb = [m.vz for t, m in steady if 2.0 < t < 4.0 or t < 6.0]
    # it takes off, or is in the air already
    assert min(climb, default=-1.0) < -0.1 or truth(first)[2] > 1.0


def _resets(stream, begin, end):
    """Return [(t s, change m)] of each step of the reset counter between begin and end, s."""
    steps = zip(stream, stream[1:])
    return [
        (t, np.linalg.norm([m.x - b.x, m.y - b.y, m.z - b.z]))
        for (_, b), (t, m) in steps
        if begin <= t < end and m.reset_counter != b.reset_counter
    ]


def _check_jumps(stream, truth):
    """Check that the wrong pose and the recovery from it each cause a reset."""
    resets = _resets(stream, POSE, RESET)
    (first, out), (second, back) = resets[0], resets[-1]
    assert first < POSE + 0.5 and out > 1.5 and second > first and back > 0.5
    after = [(t, m) for t, m in stream if second <= t < RESET]
    errors = [np.linalg.norm([m.x, -m.y, -m.z] - truth(t)) for t, m in after]
    assert np.median(errors) < 0.5


def _check_silences(stream):
    """Check the reset and the gap after the loss of all TDOAs. The quality falls before the gap."""
    times = np.array([t for t, _ in stream])
    lost = [k for k in np.flatnonzero(np.diff(times) > 1.0) if times[k] > RESET]
    (k,) = lost
    (before, last), (after, found) = stream[k], stream[k + 1]
    assert SILENCE[0] < before < SILENCE[1] < after < END
    assert found.reset_counter == last.reset_counter + 1
    good = next(m for t, m in stream if t > SILENCE[0] - 0.5)
    assert last.quality < 0.5 * good.quality
    assert _resets(stream, RESET, RESET + 3.0)


def _check_for_mavros(messages):
    """Check the frames, the velocity in the body frame, and the covariances.

    mavros converts these frames itself.
    """
    for message in messages:
        assert (message.header.frame_id, message.child_frame_id) == ("map", "base_link")
        *_, pose, twist = numbers(message)
        assert np.linalg.eigvalsh(pose).min() > 0.0 and np.linalg.eigvalsh(twist).min() > 0.0
    here = [m for m in messages if 5.0 < 1e-6 * usec(m) - EPOCH < POSE]
    p, turn, v, *_ = zip(*map(numbers, here))
    moved = np.diff(p, axis=0) * RATE
    told = np.array([of.apply(u) for of, u in zip(turn, v)])[1:]
    assert np.sqrt(np.mean((moved - told) ** 2)) < 0.5
