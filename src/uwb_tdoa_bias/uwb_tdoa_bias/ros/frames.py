# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Input of TF into a node: constant transforms, and on request moving ones."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from builtin_interfaces.msg import Time
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from tf2_msgs.msg import TFMessage

from ..common.errors import InputError
from ..common.transforms import Frames
from .parameters import MOST_QUOTED
from .topics import Input

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from .node import StreamNode

TF_QOS = QoSProfile(depth=100)  # as in tf2
MOVING_QOS = QoSProfile(depth=1000)  # 2 s at 500 Hz
TF_STATIC_QOS = QoSProfile(
    depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)

# sec, nanosec, parent, child, q, p
Transform = tuple[int, int, str, str, tuple[float, ...], tuple[float, ...]]


class FramesInput:
    """Frames of /tf_static, and of /tf on request.

    Messages of /tf wait until `catch_up`. In a frozen node the first constant transform of a frame is
    final.

    Attributes
    ----------
    trouble : fault of the last invalid transform, or None
    refusals : Refusals
    """

    def __init__(
        self,
        node: StreamNode,
        seconds: Callable[[Time], float],
        on_new: Callable[[], None],
        moving: bool = False,
    ) -> None:
        """Subscribe to /tf_static, and to /tf on request.

        Parameters
        ----------
        seconds : callable of a builtin_interfaces/Time -> s
        on_new : callable of (), called after a new constant transform
        moving : whether to read /tf
        """
        self.frames = Frames()
        self.trouble: str | None = None
        self._node, self._seconds, self._on_new = node, seconds, on_new
        static = Input(node, TFMessage, "/tf_static", self._on_static, TF_STATIC_QOS)
        self._moving = (
            [Input(node, TFMessage, "/tf", self._on_moving, MOVING_QOS, served=False)]
            if moving
            else []
        )
        self.refusals = [end.refusals for end in (static, *self._moving)]

    def catch_up(self) -> None:
        """Read all waiting messages of /tf."""
        for end in self._moving:
            end.take_all()

    def _on_static(self, message: TFMessage) -> None:
        transforms = read_transforms(message)
        new = [self._take("/tf_static", self._set, *transform[2:]) for transform in transforms]
        if any(new):
            self._on_new()

    def _set(self, parent: str, child: str, q: Sequence[float], p: Sequence[float]) -> bool:
        if self._node.frozen and self.frames.knows(child):
            if self.frames.differs(parent, child, q, p):
                self._node.refuse(f"another transform of {child!r:.{MOST_QUOTED}} on /tf_static")
            return False
        return self.frames.set(parent, child, q, p)

    def _on_moving(self, message: TFMessage) -> None:
        for sec, nanosec, *transform in read_transforms(message):
            if sec or nanosec:
                self._take(
                    "/tf",
                    self.frames.move,
                    *transform,
                    self._seconds(Time(sec=sec, nanosec=nanosec)),
                )

    def _take(self, topic: str, take: Callable[..., bool | None], *transform: Any) -> bool | None:
        try:
            return take(*transform)
        except InputError as error:
            self.trouble = f"{topic}: not taken: {error}"
            self._node.warn_at_times(topic, self.trouble)
            return False


def read_transforms(message: TFMessage) -> list[Transform]:
    """Return [(sec, nanosec, parent, child, q, p)] of a message: q x y z w, and p in m."""
    found: list[Transform] = []
    for each in message.transforms:
        q, p, stamp = each.transform.rotation, each.transform.translation, each.header.stamp
        names = each.header.frame_id.lstrip("/"), each.child_frame_id.lstrip("/")
        found.append((stamp.sec, stamp.nanosec, *names, (q.x, q.y, q.z, q.w), (p.x, p.y, p.z)))
    return found


def unknown_frame(topic: str, frame: str, body: str) -> str:
    """Return the sentence for a sensor whose place on the robot is unknown."""
    return (
        f"{topic} is in frame '{frame}', which /tf_static does not connect with '{body}': "
        f"taken as '{body}'; publish it: "
        f"static_transform_publisher --frame-id {body} --child-frame-id {frame}, or correct "
        "the driver's frame_id"
    )
