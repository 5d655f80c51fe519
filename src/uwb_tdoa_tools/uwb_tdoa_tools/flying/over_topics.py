"""A filter that is reached over topics, behind the calls that a flight needs: what is measured goes
out, odometry and status come in.
"""

from __future__ import annotations

from collections import deque
import math
from statistics import median_low
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry as OdometryMessage
import numpy as np
from rclpy.duration import Duration
from rosgraph_msgs.msg import Clock
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu

from uwb_tdoa_bias.anchors_node import markers, transforms
from uwb_tdoa_bias.foundation.ros_anchors import ANCHORS_QOS, anchors_to_message
from uwb_tdoa_bias.foundation.ros_cdr import CdrCodec, message_class
from uwb_tdoa_bias.foundation.ros_frames import TF_STATIC_QOS
from uwb_tdoa_bias.foundation.ros_streams import StreamOutput
from uwb_tdoa_bias.foundation.ros_topics import OUTPUT_QOS, Input, StreamInput
from uwb_tdoa_bias.foundation.sensors import SENSORS
from uwb_tdoa_ekf.reorder_buffer import TRIAL
from uwb_tdoa_ekf.results import Odometry
from uwb_tdoa_msgs.msg import EstimatorStatus, Tdoa

from ..bags.messages import BODY_FRAME
from .estimates import NO_ODOMETRY
from .simulator import DT
from .vehicle import ATTITUDE, POSITION

if TYPE_CHECKING:
    from collections.abc import Callable

    from uwb_tdoa_bias.foundation.ros_cdr import Template
    from uwb_tdoa_bias.foundation.ros_node import StreamNode

    from .mission import Pose
    from .simulator import SensorReadings
    from .world import World


LARGEST_CATCH_UP = 0.1  # s: a longer delay shifts all that follows
LONGEST_GAP = (
    0.3  # s of stamps after which the filter goes on without a stream: more than ekf_node's `lag`
)
# s that it waits for what is out of order, until it knows that nothing is: more than its `reorder`
UNTRUSTED = 0.005
PATIENCE, IMPATIENCE = (
    5.0,
    0.05,
)  # s of the wall clock for an estimate that is due, and for one after another that did not come
REMEMBERED = 9  # odometries by which their period is known


class RealTime:
    """Each turn at its time."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._began, self._now = clock, clock(), 0.0

    def sent(self, now: float, measured: SensorReadings) -> None:
        """SensorReadings, all up to `now`, s, were published."""
        self._now = now

    def heard(self, t: float) -> None:
        """An odometry stamped t, s, has come."""

    def may_go_on(self) -> bool:
        """Whether it is time for the next turn."""
        behind = self._clock() - self._began - self._now
        if behind > LARGEST_CATCH_UP:
            self._began += behind - LARGEST_CATCH_UP
        return behind >= 0.0


class Lockstep:
    """The next turn comes when the odometry is there that the filter makes of what was sent:
    whatever else the computer does, the same seed gives the same flight. One that does not come is
    waited for PATIENCE, and the next ones IMPATIENCE until one does.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._reach, self._since = clock, 0.0, 0.0
        self._newest: dict[str, float] = {}
        self._first: float | None = None
        self._heard: float | None = None
        self._periods, self._silent = deque([DT], REMEMBERED), True

    def sent(self, now: float, measured: SensorReadings) -> None:
        """SensorReadings, all up to `now`, s, were published."""
        self._newest |= {
            stream: part.t[-1] for stream, part in measured.streams.items() if len(part.t)
        }
        self._first = now if self._first is None else self._first
        unordered_wait = 0.0 if now > self._first + TRIAL + UNTRUSTED else UNTRUSTED
        self._reach = (
            max(min(self._newest.values(), default=now), now - LONGEST_GAP) - unordered_wait
        )
        self._since = self._clock()

    def heard(self, t: float) -> None:
        """An odometry stamped t, s, has come."""
        if self._heard is not None:
            self._periods.append(t - self._heard)
        self._heard = t

    def may_go_on(self) -> bool:
        """Whether what is due is there, or is not waited for any longer."""
        if self._heard is not None and self._heard + median_low(self._periods) > self._reach:
            self._silent = False
            return True
        if self._clock() < self._since + (IMPATIENCE if self._silent else PATIENCE):
            return False
        self._silent = True
        return True


FARTHEST, FASTEST = 1e3, 100.0  # m, m/s; what is beyond is no odometry of a hall
CLOSEST = 0.5e-3  # s between odometries that are kept: anybody may publish one for each nanosecond
LATCHED_LIMIT = 5.0  # s that somebody may take to acknowledge what is latched
MARKER_SIZE = 0.12  # m
# {stream: (topic, class of its messages, {field: values} of its part)}
STREAMS: dict[str, tuple[str, type, Callable[[Any], dict[str, Any]]]] = {
    "imu": (
        "imu/data",
        Imu,
        lambda imu: {"angular_velocity": imu.gyro, "linear_acceleration": imu.accel},
    ),
    "tdoa": (
        "uwb/tdoa",
        Tdoa,
        lambda of: {
            "anchor_a": of.a,
            "anchor_b": of.b,
            "distance_difference": of.d,
            "variance": of.variance,
        },
    ),
    "truth": ("ground_truth/pose", PoseStamped, lambda truth: {"pose": truth.pose}),
} | {name: (of.topics[0][0], message_class(of.message), of.content) for name, of in SENSORS.items()}


class OverTopics:
    """See `estimates.OurFilter`. deviation : m, as there; inf unless the filter says that it is
    running; status : EstimatorStatus, the newest, or None.
    """

    def __init__(
        self, node: StreamNode, world: World, pace: RealTime | Lockstep, clock: bool
    ) -> None:
        """node : StreamNode; world : World; pace : of `pace`, which hears of all that goes and
        comes; clock : publish /clock, and count stamps from 0, not from now.
        """
        self._node, self._pace, self._anchors = node, pace, world.anchors
        self._begin = 0 if clock else None  # ns, stamp of the start; of now without /clock
        self._now = 0.0
        self._pending_pose: tuple[float, np.ndarray, float, float] | None = None
        self.status: EstimatorStatus | None = None
        self._outputs = {
            name: _Output(node, *STREAMS[name]) for name in ("imu", "tdoa", *world.aids)
        }
        self._truth = _Output(node, *STREAMS["truth"], frame=self._anchors.frame)
        self._clock = node.create_publisher(Clock, "/clock", 10) if clock else None
        self._pose = node.create_publisher(PoseWithCovarianceStamped, "initialpose", OUTPUT_QOS)
        self._odometry_codec = CdrCodec(OdometryMessage, "pose", "twist")
        self._odometry = StreamInput(node, OdometryMessage, "odometry")
        self._status = Input(node, EstimatorStatus, "status", self._on_status, ANCHORS_QOS)
        anchors = anchors_to_message(self._anchors)
        for topic, qos, content in (
            ("/tf_static", TF_STATIC_QOS, transforms(anchors)),
            ("uwb/anchors/markers", ANCHORS_QOS, markers(anchors, MARKER_SIZE)),
            ("uwb/anchors", ANCHORS_QOS, anchors),  # the last one: who has it hears the others
        ):
            self._latched = node.create_publisher(type(content), topic, qos)
            self._latched.publish(content)
        # (t s, p, v, q, covariance (3, 3)) of each odometry
        self._rows: list[tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]] = []

    def is_connected(self) -> bool:
        """Whether somebody listens to what is measured, and says what comes of it."""
        ends = [output.subscribers for output in (self._outputs["imu"], self._outputs["tdoa"])]
        return all(ends) and bool(self._odometry.get_publisher_count())

    def wait_for_anchors(self) -> None:
        """Wait until those who listen have the anchors, and hear everything else, too."""
        self._latched.wait_for_all_acked(Duration(seconds=LATCHED_LIMIT))

    def set_pose(self, t: float, p: np.ndarray, std: float, yaw: float) -> None:
        """See OurFilter; is said before what is measured first."""
        self._pending_pose = t, p, std, yaw

    def take(self, measured: SensorReadings) -> None:
        """Publish SensorReadings."""
        if self._begin is None:
            self._begin = self._node.get_clock().now().nanoseconds
        if self._pending_pose:
            self._pose.publish(self._pose_of(*self._pending_pose))
            self._pending_pose = None
        self._measured = measured
        for name, part in measured.streams.items():
            self._outputs[name].publish(*self._parts(part.t), part)

    def publish_truth(self, t: float, state: np.ndarray) -> None:
        """Publish what is true at t, s, up to which everything was published: state (17,), as of
        `vehicle`; and on /clock the time.
        """
        self._now = t
        self._truth.publish(
            *self._parts(np.array([t])),
            SimpleNamespace(pose=np.concatenate([state[POSITION], state[ATTITUDE]])[None]),
        )
        if self._clock is not None:
            self._clock.publish(Clock(clock=self._stamp(t)))
        self._pace.sent(t, self._measured)

    def receive(self) -> None:
        """Take the odometry that has come."""
        for frame, rows, _ in self._odometry.fetch(self._odometry_codec):
            if self._begin is None:  # nothing was measured yet: whose odometry is that?
                continue
            t = 1e-9 * (rows["sec"].astype(np.int64) * 10**9 + rows["nanosec"] - self._begin)
            usable = (
                np.isfinite(rows["pose"]).all(axis=1)
                & np.isfinite(rows["twist"]).all(axis=1)
                & (frame == self._anchors.frame)
            )
            for k in np.flatnonzero(usable & (t <= self._now)):
                self._add_odometry(t[k], rows["pose"][k], rows["twist"][k])

    def _add_odometry(self, t: float, pose: np.ndarray, twist: np.ndarray) -> None:
        p, q, covariance = pose[:3].copy(), pose[3:7].copy(), pose[7:].reshape(6, 6)[:3, :3].copy()
        length = np.linalg.norm(q)
        valid = length > 0.5 and (np.diag(covariance) >= 0.0).all()
        near = np.abs(p).max() < FARTHEST and np.abs(twist[:3]).max() < FASTEST
        if not (valid and near) or (self._rows and t < self._rows[-1][0] + CLOSEST):
            return
        q /= length
        self._rows.append((float(t), p, Rotation.from_quat(q).apply(twist[:3]), q, covariance))
        self._pace.heard(float(t))

    def _pose_of(
        self, t: float, p: np.ndarray, std: float, yaw: float
    ) -> PoseWithCovarianceStamped:
        """PoseWithCovarianceStamped, see `set_pose`; a variance of 0 says that nobody knows."""
        message, known = PoseWithCovarianceStamped(), not math.isnan(yaw)
        message.header.stamp, message.header.frame_id = self._stamp(t), self._anchors.frame
        at, turn = message.pose.pose.position, message.pose.pose.orientation
        at.x, at.y, at.z = p.tolist()
        turn.z, turn.w = (math.sin(0.5 * yaw), math.cos(0.5 * yaw)) if known else (0.0, 1.0)
        message.pose.covariance = np.diag(
            [*[std**2] * 3, 0.0, 0.0, std**2 if known else 0.0]
        ).ravel()
        return message

    def _on_status(self, message: EstimatorStatus) -> None:
        self.status = message

    @property
    def pose(self) -> Pose | None:
        """(t s, p (3,) m, v (3,) m/s, q (4,)) of the newest estimate, or None."""
        return self._rows[-1][:4] if self._rows else None

    @property
    def deviation(self) -> float:
        """Largest standard deviation of a coordinate of the newest estimate, m; inf without one, or
        where the filter says that it is lost.
        """
        if (
            not self._rows
            or self.status is None
            or self.status.status != EstimatorStatus.STATUS_RUNNING
        ):
            return math.inf
        return math.sqrt(np.diag(self._rows[-1][4]).max())

    @property
    def why(self) -> str:
        """What keeps it from being flown by, in words, "" if nothing is said."""
        if self.status is None:
            return "nothing came on status: start ekf_node"
        return self.status.why if self.status.status != EstimatorStatus.STATUS_RUNNING else ""

    @property
    def odometry(self) -> Odometry:
        """Odometry, all that came; of its covariance only that of the position, the rest 0."""
        if not self._rows:
            return NO_ODOMETRY
        t, p, v, q, covariance = map(np.array, zip(*self._rows))
        whole = np.zeros((len(t), 9, 9))
        whole[:, :3, :3] = covariance
        return Odometry(
            t, p, v, q, np.zeros(p.shape), np.zeros(p.shape), whole, np.zeros((len(t), 3, 3))
        )

    def _parts(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Seconds and nanoseconds of the stamps, (n,) each, of t (n,) s."""
        assert self._begin is not None
        return np.divmod(self._begin + np.rint(t * 1e9).astype(np.int64), 10**9)

    def _stamp(self, t: float) -> Time:
        second, nanosecond = self._parts(np.array([t]))
        return Time(sec=int(second[0]), nanosec=int(nanosecond[0]))


class _Output:
    """A stream of which only some fields are not 0. subscribers : how many hear it."""

    def __init__(
        self,
        node: StreamNode,
        topic: str,
        kind: type,
        content: Callable[[Any], dict[str, np.ndarray]],
        frame: str = BODY_FRAME,
    ) -> None:
        self._content, self._kind, self._frame = content, kind, frame
        self._template: Template | None = None
        self._output = StreamOutput(node, kind, topic)

    @property
    def subscribers(self) -> int:
        return self._output.publisher.get_subscription_count()

    def publish(self, seconds: np.ndarray, nanoseconds: np.ndarray, part: Any) -> None:
        """Publish the rows of a part of a stream, with stamps of these seconds and nanoseconds (n,)
        each.
        """
        content = self._content(part)
        if self._template is None:
            blank = self._kind()
            blank.header.frame_id = self._frame
            self._template = CdrCodec(self._kind, *content).template(blank)
        rows = self._template.rows(len(seconds))
        rows["sec"], rows["nanosec"] = seconds, nanoseconds
        for field, values in content.items():
            rows[field] = values
        self._output.publish(self._frame, self._template, rows)
