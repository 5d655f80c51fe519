"""What ekf_node publishes: odometry, transforms, residuals."""

from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
import numpy as np
from scipy.spatial.transform import Rotation
from tf2_msgs.msg import TFMessage
from uwb_tdoa_bias.foundation import ros
from uwb_tdoa_bias.foundation.ros_frames import TF_QOS
from uwb_tdoa_msgs.msg import TdoaResidual

from .ekf_parameters import NONE, ODOM
from .frames import to_odometry

UNKNOWN_RATE = 1e6  # (rad/s)^2, variance of an angular velocity that nothing measured
UNPLACED = 100  # odometries in a row without odom -> body on /tf, before it is a trouble


class Outputs:
    """published : number of messages on odometry; odometry, residual : the publishers."""

    def __init__(self, node, epoch, frames, body, publish_tf, odom):
        """epoch : ros.Epoch; frames : transforms.Frames; body, odom : names of frames; publish_tf : of PUBLISH_TF."""
        self._epoch, self._frames, self._body = epoch, frames, body
        self._odom = odom if publish_tf == ODOM else None
        self.published = self._unplaced = 0  # messages; those in a row for which /tf had no odom -> body
        # One message object each, for all: what is published is copied.
        self._odometry = Odometry(child_frame_id=body)
        self._transform = TransformStamped(child_frame_id=self._odom or body)
        self._tf, self._residual = TFMessage(transforms=[self._transform]), TdoaResidual()
        self.odometry = ros.publish_stream(node, Odometry, "odometry")
        self.residual = ros.publish_stream(node, TdoaResidual, "uwb/residual")
        self._tf_publisher = node.create_publisher(TFMessage, "/tf", TF_QOS) if publish_tf != NONE else None

    def set_world(self, frame):
        """Name the world frame."""
        for message in (self._odometry, self._transform, self._residual):
            message.header.frame_id = frame

    @property
    def world(self):
        """Name of the world frame."""
        return self._odometry.header.frame_id

    @property
    def trouble(self):
        """What keeps a transform from being published, or None."""
        if self._unplaced < UNPLACED:
            return None
        return (
            f"publish_tf is odom, and /tf has no {self._odom} -> {self._body} at the time of the odometry: start what "
            "publishes it, or set publish_tf to base"
        )

    @property
    def stamp(self):
        """builtin_interfaces/Time of the newest odometry."""
        return self._odometry.header.stamp

    def publish_residuals(self, residuals):
        """Publish Residuals."""
        columns = (
            residuals.t, residuals.a, residuals.b, residuals.innovation, residuals.variance, residuals.weight,
            residuals.verdict,
        )  # fmt: skip
        for row in zip(*(column.tolist() for column in columns)):
            self.publish_residual(*row)

    def publish_residual(self, t, a, b, innovation, variance, weight, verdict):
        """Publish what became of one TDOA."""
        out = self._residual
        out.header.stamp = self._epoch.stamp(t)
        out.anchor_a, out.anchor_b = a, b
        out.innovation, out.innovation_variance = innovation, variance
        out.weight, out.verdict = weight, verdict
        self.residual.publish(out)

    def publish_odometry(self, odometry, rates, rate_variance):
        """Publish Odometry. rates (n, 3) rad/s, NaN where not known, and their variance, rad^2/s^2."""
        n, known = len(odometry), np.isfinite(rates[:, 0])
        velocity, covariance = to_odometry(odometry.q, odometry.v, odometry.covariance)
        pose, twist = covariance[:, :6, :6].reshape(n, 36), np.zeros((n, 6, 6))
        twist[:, :3, :3] = covariance[:, 6:, 6:]
        twist[:, [3, 4, 5], [3, 4, 5]] = np.where(known, rate_variance, UNKNOWN_RATE)[:, None]
        twist = twist.reshape(n, 36)
        out = self._odometry
        columns = (odometry.t, odometry.p, odometry.q, velocity, np.where(known[:, None], rates, 0.0))
        for i, (t, p, q, u, rate) in enumerate(zip(*(column.tolist() for column in columns))):
            out.header.stamp = self._epoch.stamp(t)
            position, orientation, twist_out = out.pose.pose.position, out.pose.pose.orientation, out.twist.twist
            position.x, position.y, position.z = p
            orientation.x, orientation.y, orientation.z, orientation.w = q
            twist_out.linear.x, twist_out.linear.y, twist_out.linear.z = u
            twist_out.angular.x, twist_out.angular.y, twist_out.angular.z = rate
            out.pose.covariance, out.twist.covariance = pose[i], twist[i]
            self.odometry.publish(out)
            if self._tf_publisher is not None:
                self._publish_transform(t, p, q)
        self.published += n

    def _publish_transform(self, t, p, q):
        """World -> body, or world -> odom such that odom -> body of /tf leads to the same."""
        if self._odom:
            between = self._frames.between(self._odom, self._body, t)
            self._unplaced = self._unplaced + 1 if between is None else 0
            if between is None:
                return
            turn = Rotation.from_quat(q) * between[0].inv()
            p, q = (p - turn.apply(between[1])).tolist(), turn.as_quat().tolist()
        out = self._transform.transform
        self._transform.header.stamp = self._odometry.header.stamp
        out.translation.x, out.translation.y, out.translation.z = p
        out.rotation.x, out.rotation.y, out.rotation.z, out.rotation.w = q
        self._tf_publisher.publish(self._tf)
