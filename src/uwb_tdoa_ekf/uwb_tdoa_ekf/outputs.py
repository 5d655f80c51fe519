# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Publish the results of ekf_node: odometry, transforms, residuals and status."""

from __future__ import annotations

import math
import time

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry as OdometryMessage
import numpy as np
from tf2_msgs.msg import TFMessage

from uwb_tdoa_bias.common.arrays import rotations
from uwb_tdoa_bias.common.transforms import Frames
from uwb_tdoa_bias.ros.anchors import ANCHORS_QOS as STATUS_QOS, TF_QOS
from uwb_tdoa_bias.ros.cdr import CdrCodec
from uwb_tdoa_bias.ros.node import StreamNode
from uwb_tdoa_bias.ros.topics import Epoch, StreamOutput
from uwb_tdoa_msgs.msg import EstimatorStatus, TdoaResidual

from .ekf_parameters import NONE, ODOM
from .monitoring.status import Status
from .results import Odometry, Residuals, pose_and_twist

STATUS_PERIOD = 0.95  # s; the node checks five times a second
ODOMETRY = "pose", "twist"
RESIDUAL = "anchor_a", "anchor_b", "innovation", "innovation_variance", "weight", "verdict"
UNPLACED = 100  # consecutive odometry messages without odom -> body on /tf before a warning


class StatusOutput:
    """Publish EstimatorStatus on `status` once per second, and at once after a change."""

    def __init__(self, node: StreamNode) -> None:
        self._publisher = node.create_publisher(EstimatorStatus, "status", STATUS_QOS)
        self._said: Status | None = None
        self._due = -math.inf

    def publish(
        self, status: Status, yaw_std: float, tdoa_age: float, stamp: Time, frame: str
    ) -> None:
        """Publish the status if it is due.

        Parameters
        ----------
        status : monitoring.status.Status
            Current status.
        yaw_std : float
            Standard deviation of the yaw, in rad.
        tdoa_age : float
            Time since a TDOA was used, in s.
        stamp : builtin_interfaces/Time
            Stamp of the message.
        frame : str
            World frame.
        """
        now = time.monotonic()
        if status == self._said and now < self._due:
            return
        self._said, self._due = status, now + STATUS_PERIOD
        message = EstimatorStatus(
            status=status.status, lost=status.lost, yaw_known=status.yaw_known, why=status.why
        )
        message.header.stamp, message.header.frame_id = stamp, frame
        message.yaw_std, message.tdoa_age = float(yaw_std), float(tdoa_age)
        self._publisher.publish(message)


class Outputs:
    """Publish odometry, transforms and residuals.

    Attributes
    ----------
    published : int
        Number of odometry messages so far.
    stamp : builtin_interfaces/Time
        Stamp of the newest odometry.
    world : str
        Name of the world frame.
    odometry, residual : StreamOutput
        Outputs on `odometry` and `uwb/residual`.
    """

    def __init__(
        self,
        node: StreamNode,
        epoch: Epoch,
        frames: Frames,
        body: str,
        publish_tf: str,
        odom: str,
        planar: bool = False,
    ) -> None:
        """Create the publishers.

        Parameters
        ----------
        node : StreamNode
            Node that publishes.
        epoch : Epoch
            Conversion from seconds to stamps.
        frames : transforms.Frames
            Transforms from /tf.
        body, odom : str
            Names of the body frame and of the odom frame.
        publish_tf : str
            Value from PUBLISH_TF.
        planar : bool
            Let world -> odom rotate about the vertical axis only.
        """
        self._epoch, self._frames, self._body, self._planar = epoch, frames, body, planar
        self._odom = odom if publish_tf == ODOM else None
        # messages; consecutive messages without odom -> body on /tf
        self.published = self._unplaced = 0
        self._placed = False  # True after the first transform
        self._wires = CdrCodec(OdometryMessage, *ODOMETRY), CdrCodec(TdoaResidual, *RESIDUAL)
        self._transform = TransformStamped(child_frame_id=self._odom or body)
        # one message for all, because publishing copies it
        self._tf = TFMessage(transforms=[self._transform])
        self.stamp = Time()  # stamp of the newest odometry
        self.set_world("")
        self.odometry = StreamOutput(node, OdometryMessage, "odometry")
        self.residual = StreamOutput(node, TdoaResidual, "uwb/residual")
        self._tf_publisher = (
            node.create_publisher(TFMessage, "/tf", TF_QOS) if publish_tf != NONE else None
        )

    def set_world(self, frame: str) -> None:
        """Set the name of the world frame."""
        self.world = self._transform.header.frame_id = frame
        messages = OdometryMessage(child_frame_id=self._body), TdoaResidual()
        for message in messages:
            message.header.frame_id = frame
        self._odometry, self._residual = (
            codec.template(message) for codec, message in zip(self._wires, messages)
        )

    @property
    def trouble(self) -> str | None:
        """Return a sentence on why the transform cannot be published, or None."""
        if self._unplaced < UNPLACED:
            return None
        return (
            f"publish_tf is odom, and /tf has no {self._odom} -> {self._body} at the time of "
            "the odometry: start what "
            "publishes it, or set publish_tf to base"
        )

    def publish_residuals(self, residuals: Residuals) -> None:
        """Publish Residuals if there is a subscriber."""
        if not self.residual.publisher.get_subscription_count():
            return  # the topic is volatile: a later subscriber cannot get old residuals
        rows = self._residual.rows(len(residuals.t))
        rows["sec"], rows["nanosec"] = self._epoch.parts(residuals.t)
        columns = (
            residuals.a,
            residuals.b,
            residuals.innovation,
            residuals.variance,
            residuals.weight,
            residuals.verdict,
        )
        for name, column in zip(RESIDUAL, columns):
            rows[name] = column
        self.residual.publish(self.world, self._residual, rows)

    def publish_odometry(self, odometry: Odometry, turns: np.ndarray, held: bool = False) -> None:
        """Publish Odometry and its transforms.

        Parameters
        ----------
        odometry : Odometry
            n estimates.
        turns : (n,) bool
            The yaw may turn by 90 degrees: publish no transform.
        held : bool
            Keep the last world -> odom transform.
        """
        n = len(odometry)
        rows = self._odometry.rows(n)
        rows["sec"], rows["nanosec"] = self._epoch.parts(odometry.t)
        numbers = pose_and_twist(odometry, odometry.rate, odometry.rate_variance)
        rows["pose"], rows["twist"] = numbers
        transformed = self._tf_publisher is not None and (
            self._odom or self._tf_publisher.get_subscription_count()
        )
        self.odometry.publish(self.world, self._odometry, rows)
        for k in np.flatnonzero(~turns).tolist() if transformed else ():
            self.stamp = self._epoch.stamp(odometry.t[k].item())
            self._publish_transform(
                odometry.t[k], odometry.p[k].tolist(), odometry.q[k].tolist(), held
            )
        if n:
            self.stamp = self._epoch.stamp(odometry.t[-1].item())
        self.published += n

    def _publish_transform(self, t: float, p: np.ndarray, q: np.ndarray, held: bool) -> None:
        """Publish world -> body, or world -> odom.

        With odom -> body of /tf, the transform world -> odom leads to the same pose of the body. If
        `held` is true, the last world -> odom is published again.
        """
        if self._odom and not (held and self._placed):
            between = self._frames.between(self._odom, self._body, t)
            self._unplaced = self._unplaced + 1 if between is None else 0
            if between is None:
                return
            turn = rotations.Rotation.from_quat(q) * between[0].inv()
            if self._planar:
                turn = rotations.Rotation.from_euler("Z", turn.as_euler("ZYX")[0])
            p, q = (p - turn.apply(between[1])).tolist(), turn.as_quat().tolist()
        out = self._transform.transform
        self._transform.header.stamp = self.stamp
        if not (self._odom and held and self._placed):
            out.translation.x, out.translation.y, out.translation.z = p
            out.rotation.x, out.rotation.y, out.rotation.z, out.rotation.w = q
        self._placed = True
        assert self._tf_publisher is not None  # the caller checks this
        self._tf_publisher.publish(self._tf)
