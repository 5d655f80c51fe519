# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Fly by a filter that is reached over topics.

Sensor samples are published. Odometry and status are received.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
import math
from statistics import median_low
import time
from types import SimpleNamespace
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from nav_msgs.msg import Odometry as OdometryMessage
import numpy as np
from rclpy.duration import Duration
from rosgraph_msgs.msg import Clock
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import Imu

from uwb_tdoa_bias.anchors_node import markers, transforms
from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_bias.ros.anchors import ANCHORS_QOS, TF_STATIC_QOS, anchors_to_message
from uwb_tdoa_bias.ros.cdr import CdrCodec, CdrTemplate, message_class
from uwb_tdoa_bias.ros.node import StreamNode
from uwb_tdoa_bias.ros.topics import OUTPUT_QOS, Input, StreamInput, StreamOutput
from uwb_tdoa_ekf.reorder_buffer import TRIAL
from uwb_tdoa_msgs.msg import EstimatorStatus, Tdoa

from ..bags.messages import BODY_FRAME
from .simulator import DT, Streams
from .trial import EstimateSource
from .vehicle import ATTITUDE, POSITION, World

LARGEST_CATCH_UP = 0.1  # s: a longer delay shifts all later turns
# s of stamps, more than the parameter `lag` of ekf_node: then the filter continues without a stream
LONGEST_GAP = 0.3
# s, more than the parameter `reorder` of ekf_node, which waits until streams are known to be ordered
UNTRUSTED = 0.005
# s of the wall clock: wait for an odometry, and for each further one after a missing odometry
PATIENCE, IMPATIENCE = 5.0, 0.05
REMEMBERED = 9  # odometries that determine their period


class RealTime:
    """Allow each turn at its time."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._began, self._now = clock, clock(), 0.0

    def sent(self, now: float, streams: Streams) -> None:
        """Note that all samples up to the stamp `now`, s, were published."""
        self._now = now

    def heard(self, t: float) -> None:
        """Ignore an odometry stamped t, s: only the clock counts."""

    def may_go_on(self) -> bool:
        """Return whether the next turn is due."""
        behind = self._clock() - self._began - self._now
        if behind > LARGEST_CATCH_UP:
            self._began += behind - LARGEST_CATCH_UP
        return behind >= 0.0


class Lockstep:
    """Allow the next turn when the odometry of the published samples has come.

    The same seed then gives the same flight on any computer. An odometry is awaited for PATIENCE, but
    for IMPATIENCE before the first one, and after a missing one until the next comes.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        # s of the wall clock, when samples were published; s of stamps that the filter can have reached
        self._clock, self._since, self._filter_time = clock, 0.0, 0.0
        self._newest: dict[str, float] = {}  # {stream: s, newest stamp}
        self._first: float | None = None  # s, stamp at which samples were published first
        self._heard: float | None = None  # s, newest stamp of odometry
        self._periods, self._overdue = deque([DT], REMEMBERED), True

    def sent(self, now: float, streams: Streams) -> None:
        """Note that all samples up to the stamp `now`, s, were published."""
        self._newest |= {name: part.t[-1] for name, part in streams.items() if len(part.t)}
        self._first = now if self._first is None else self._first
        # Until the end of TRIAL, the filter waits for messages that are out of order.
        unordered_wait = 0.0 if now > self._first + TRIAL + UNTRUSTED else UNTRUSTED
        self._filter_time = (
            max(min(self._newest.values(), default=now), now - LONGEST_GAP) - unordered_wait
        )
        self._since = self._clock()

    def heard(self, t: float) -> None:
        """Note an odometry stamped t, s."""
        if self._heard is not None:
            self._periods.append(t - self._heard)
        self._heard = t

    def may_go_on(self) -> bool:
        """Return whether the last odometry up to the time of the filter has come, or the wait is over."""
        if self._heard is not None and self._heard + median_low(self._periods) > self._filter_time:
            self._overdue = False
            return True
        if self._clock() < self._since + (IMPATIENCE if self._overdue else PATIENCE):
            return False
        self._overdue = True
        return True


FARTHEST, FASTEST = 1e3, 100.0  # m, m/s: limits of plausible odometry
CLOSEST = 0.5e-3  # s, least time between stored odometries: limits the memory
LATCHED_LIMIT = 5.0  # s, wait for acknowledgement of latched messages
MARKER_SIZE = 0.12  # m
# {stream: (topic, type of its messages, function from samples to {field: values} of messages)}
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


class OverTopics(EstimateSource):
    """Exchange samples and estimates with a filter over topics.

    Attributes
    ----------
    status : EstimatorStatus or None
        The newest status of the filter.
    """

    def __init__(
        self, node: StreamNode, world: World, pace: RealTime | Lockstep, clock: bool
    ) -> None:
        """Create publishers and subscriptions, and publish the anchors.

        Parameters
        ----------
        node : StreamNode
        world : World
        pace : RealTime or Lockstep
            It is informed of all messages.
        clock : bool
            Publish /clock and count stamps from 0. Otherwise stamps count from the present time.
        """
        super().__init__()
        self._node = node
        self._pace = pace
        self._anchors = world.anchors
        self._begin = 0 if clock else None  # ns, stamp of the start
        self._now = 0.0
        self._pending_pose: tuple[float, np.ndarray, float, float] | None = None
        self.status: EstimatorStatus | None = None
        self._outputs = {
            name: _Output(node, *STREAMS[name]) for name in ("imu", "tdoa", *world.sensors)
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
            ("uwb/anchors", ANCHORS_QOS, anchors),  # last: its acknowledgement implies the others
        ):
            self._latched = node.create_publisher(type(content), topic, qos)
            self._latched.publish(content)

    def is_connected(self) -> bool:
        """Return whether a filter subscribes to the samples and publishes odometry."""
        ends = [output.subscribers for output in (self._outputs["imu"], self._outputs["tdoa"])]
        return all(ends) and bool(self._odometry.get_publisher_count())

    def wait_for_anchors(self) -> None:
        """Wait until the subscribers have received the anchors."""
        self._latched.wait_for_all_acked(Duration(seconds=LATCHED_LIMIT))

    def set_pose(self, t: float, p: np.ndarray, std: float, yaw: float) -> None:
        """Set the initial pose at stamp t, s. It is published before the next samples.

        p is (3,) m, std its standard deviation in m, and of the yaw in rad. A yaw of NaN is unknown.
        """
        self._pending_pose = t, p, std, yaw

    def take(self, streams: Streams) -> None:
        """Publish samples."""
        if self._begin is None:
            self._begin = self._node.get_clock().now().nanoseconds
        if self._pending_pose:
            self._pose.publish(self._pose_of(*self._pending_pose))
            self._pending_pose = None
        self._sent = streams
        for name, part in streams.items():
            self._outputs[name].publish(*self._parts(part.t), part)

    def publish_truth(self, t: float, state: np.ndarray) -> None:
        """Publish the true state at t, s, and the time on /clock, and end the turn.

        `state` (17,) is that of `vehicle`. All samples up to t are published already, so `pace` waits
        for their odometry from now on.
        """
        self._now = t
        self._truth.publish(
            *self._parts(np.array([t])),
            SimpleNamespace(pose=np.concatenate([state[POSITION], state[ATTITUDE]])[None]),
        )
        if self._clock is not None:
            self._clock.publish(Clock(clock=self._stamp(t)))
        self._pace.sent(t, self._sent)

    def receive(self) -> None:
        """Store the odometry that has come."""
        for frame, rows, _ in self._odometry.fetch(self._odometry_codec):
            if self._begin is None:  # odometry of another vehicle: nothing was published yet
                continue
            t = (rows["sec"].astype(np.int64) * 10**9 + rows["nanosec"] - self._begin) / 1e9
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
        """Return the message of an initial pose. A variance of 0 means unknown."""
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
    def deviation(self) -> float:
        """Return the largest standard deviation of a coordinate, m.

        It is inf without an estimate, and unless the filter reports STATUS_RUNNING.
        """
        is_running = self.status and self.status.status == EstimatorStatus.STATUS_RUNNING
        return super().deviation if is_running else math.inf

    @property
    def yaw_known(self) -> bool:
        return self.status is not None and bool(self.status.yaw_known)

    @property
    def why(self) -> str:
        """Return the reason for which the estimate cannot be used, or ""."""
        if self.status is None:
            return "nothing came on status: start ekf_node"
        return self.status.why if self.status.status != EstimatorStatus.STATUS_RUNNING else ""

    def _parts(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return seconds and nanoseconds (n,) of the stamps t (n,) s."""
        assert self._begin is not None
        return np.divmod(self._begin + np.rint(t * 1e9).astype(np.int64), 10**9)

    def _stamp(self, t: float) -> Time:
        second, nanosecond = self._parts(np.array([t]))
        return Time(sec=int(second[0]), nanosec=int(nanosecond[0]))


class _Output:
    """Publish the samples of one stream as messages.

    Messages are serialized in bulk, because a message object takes tens of microseconds. Nothing is
    sent without a subscriber.
    """

    def __init__(
        self,
        node: StreamNode,
        topic: str,
        message_type: type,
        fields_of: Callable[[Any], dict[str, np.ndarray]],
        frame: str = BODY_FRAME,
    ) -> None:
        """Create the publisher.

        Parameters
        ----------
        node : StreamNode
        topic : str
        message_type : type
        fields_of : callable
            Returns {field: (n, ...)} of n samples. Other fields of a message keep their default.
        frame : str
            frame_id of the messages.
        """
        self._fields_of, self._message_type, self._frame = fields_of, message_type, frame
        self._template: CdrTemplate | None = None
        self._output = StreamOutput(node, message_type, topic)

    @property
    def subscribers(self) -> int:
        """Return the number of subscribers."""
        return self._output.publisher.get_subscription_count()

    def publish(self, seconds: np.ndarray, nanoseconds: np.ndarray, part: Any) -> None:
        """Publish one message per sample.

        `part` holds n samples of the stream; `seconds` and `nanoseconds` (n,) are their stamps.
        """
        fields = self._fields_of(part)
        if self._template is None:
            blank = self._message_type()
            blank.header.frame_id = self._frame
            self._template = CdrCodec(self._message_type, *fields).template(blank)
        rows = self._template.rows(len(seconds))
        rows["sec"], rows["nanosec"] = seconds, nanoseconds
        for field, values in fields.items():
            rows[field] = values
        self._output.publish(self._frame, self._template, rows)
