"""What ekf_node publishes: odometry, transforms, residuals."""

from builtin_interfaces.msg import Time
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
import numpy as np
from scipy.spatial.transform import Rotation
from tf2_msgs.msg import TFMessage
from uwb_tdoa_bias.foundation import ros
from uwb_tdoa_bias.foundation.ros_frames import TF_QOS
from uwb_tdoa_bias.foundation.ros_wire import Wire
from uwb_tdoa_msgs.msg import TdoaResidual

from .ekf_parameters import NONE, ODOM
from .frames import to_odometry

UNKNOWN_RATE = 1e6  # (rad/s)^2, variance of an angular velocity that nothing measured
ODOMETRY = (
    "pose.pose.position", "pose.pose.orientation", "pose.covariance", "twist.twist.linear", "twist.twist.angular",
    "twist.covariance",
)  # fmt: skip
RESIDUAL = "anchor_a", "anchor_b", "innovation", "innovation_variance", "weight", "verdict"
UNPLACED = 100  # odometries in a row without odom -> body on /tf, before it is a trouble


class Outputs:
    """published : number of messages on odometry; stamp : of the newest; world : name of its frame; odometry, residual : the
    publishers."""

    def __init__(self, node, epoch, frames, body, publish_tf, odom):
        """epoch : ros.Epoch; frames : transforms.Frames; body, odom : names of frames; publish_tf : of PUBLISH_TF."""
        self._epoch, self._frames, self._body = epoch, frames, body
        self._odom = odom if publish_tf == ODOM else None
        self.published = self._unplaced = 0  # messages; those in a row for which /tf had no odom -> body
        self._wires = Wire(Odometry, *ODOMETRY), Wire(TdoaResidual, *RESIDUAL)
        self._transform = TransformStamped(child_frame_id=self._odom or body)
        self._tf = TFMessage(transforms=[self._transform])  # one for all: what is published is copied
        self.stamp = Time()  # of the newest odometry
        self.set_world("")
        self.odometry = ros.publish_stream(node, Odometry, "odometry")
        self.residual = ros.publish_stream(node, TdoaResidual, "uwb/residual")
        self._tf_publisher = node.create_publisher(TFMessage, "/tf", TF_QOS) if publish_tf != NONE else None

    def set_world(self, frame):
        """Name the world frame."""
        self.world = self._transform.header.frame_id = frame
        messages = Odometry(child_frame_id=self._body), TdoaResidual()
        for message in messages:
            message.header.frame_id = frame
        self._odometry, self._residual = (wire.template(message) for wire, message in zip(self._wires, messages))

    @property
    def trouble(self):
        """What keeps a transform from being published, or None."""
        if self._unplaced < UNPLACED:
            return None
        return (
            f"publish_tf is odom, and /tf has no {self._odom} -> {self._body} at the time of the odometry: start what "
            "publishes it, or set publish_tf to base"
        )

    def publish_residuals(self, residuals):
        """Publish Residuals."""
        if not self.residual.get_subscription_count():
            return  # nobody can come and ask for them later
        rows = self._residual.rows(len(residuals.t))
        rows["sec"], rows["nanosec"] = self._epoch.parts(residuals.t)
        columns = (
            residuals.a, residuals.b, residuals.innovation, residuals.variance, residuals.weight, residuals.verdict,
        )  # fmt: skip
        for name, column in zip(RESIDUAL, columns):
            rows[name] = column
        for message in self._residual.messages(rows):
            self.residual.publish(message)

    def publish_odometry(self, odometry, rates, rate_variance):
        """Publish Odometry. rates (n, 3) rad/s, NaN where not known, and their variance, rad^2/s^2."""
        n, known = len(odometry), np.isfinite(rates[:, 0])
        velocity, covariance = to_odometry(odometry.q, odometry.v, odometry.covariance)
        twist = np.zeros((n, 6, 6))
        twist[:, :3, :3] = covariance[:, 6:, 6:]
        twist[:, [3, 4, 5], [3, 4, 5]] = np.where(known, rate_variance, UNKNOWN_RATE)[:, None]
        rows = self._odometry.rows(n)
        rows["sec"], rows["nanosec"] = self._epoch.parts(odometry.t)
        columns = (
            odometry.p, odometry.q, covariance[:, :6, :6].reshape(n, 36), velocity, np.where(known[:, None], rates, 0.0),
            twist.reshape(n, 36),
        )  # fmt: skip
        for name, column in zip(ODOMETRY, columns):
            rows[name] = column
        transformed = self._tf_publisher is not None and (self._odom or self._tf_publisher.get_subscription_count())
        for k, message in enumerate(self._odometry.messages(rows)):
            self.odometry.publish(message)
            if transformed:
                self.stamp = self._epoch.stamp(odometry.t[k].item())
                self._publish_transform(odometry.t[k], odometry.p[k].tolist(), odometry.q[k].tolist())
        if n:
            self.stamp = self._epoch.stamp(odometry.t[-1].item())
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
        self._transform.header.stamp = self.stamp
        out.translation.x, out.translation.y, out.translation.z = p
        out.rotation.x, out.rotation.y, out.rotation.z, out.rotation.w = q
        self._tf_publisher.publish(self._tf)
