"""What TF says, as far as a node needs it: constant transforms, and on request those that move."""

from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from tf2_msgs.msg import TFMessage

from .transforms import Frames

TF_QOS = QoSProfile(depth=100)  # what tf2 uses
TF_STATIC_QOS = QoSProfile(
    depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


class FramesInput:
    """Frames of /tf_static, and of /tf if they may move."""

    def __init__(self, node, seconds, on_new, moving=False):
        """seconds(stamp) : s of a builtin_interfaces/Time; on_new() is called when a constant transform is new."""
        self.frames = Frames()
        self._seconds, self._on_new = seconds, on_new
        node.create_subscription(TFMessage, "/tf_static", self._on_static, TF_STATIC_QOS)
        self._moving = node.create_subscription(TFMessage, "/tf", self._on_moving, TF_QOS) if moving else None

    def catch_up(self):
        """Take what has arrived of frames that move, before what was measured among them."""
        if self._moving is not None:
            with self._moving.handle:
                while (taken := self._moving.handle.take_message(TFMessage, False)) is not None:
                    self._on_moving(taken[0])

    def _on_static(self, message):
        new = [self.frames.set(*_of(transform)) for transform in message.transforms]
        if any(new):
            self._on_new()

    def _on_moving(self, message):
        for transform in message.transforms:
            stamp = transform.header.stamp
            if not (stamp.sec or stamp.nanosec):
                continue
            self.frames.move(*_of(transform), self._seconds(stamp))


def _of(message):
    """(parent, child, q, p) of a TransformStamped."""
    q, p = message.transform.rotation, message.transform.translation
    return message.header.frame_id.lstrip("/"), message.child_frame_id.lstrip("/"), (q.x, q.y, q.z, q.w), (p.x, p.y, p.z)


def unknown_frame(topic, frame, body):
    """The sentence for a sensor whose place on the robot nobody says."""
    return (
        f"{topic} is in frame '{frame}', which /tf_static does not connect with '{body}': taken as '{body}'; publish it: "
        f"static_transform_publisher --frame-id {body} --child-frame-id {frame}, or correct the driver's frame_id"
    )
