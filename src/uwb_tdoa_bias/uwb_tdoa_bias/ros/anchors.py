# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Anchors as messages, and their input into a node: a file or the topic uwb/anchors.

Input of TF into a node: constant transforms, and on request moving ones.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Pose, Quaternion
import numpy as np
from rclpy.event_handler import QoSRequestedIncompatibleQoSInfo, SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from tf2_msgs.msg import TFMessage

from uwb_tdoa_msgs.msg import Anchor, AnchorArray, Calibration

from ..common.anchors import MOST_NAMED, SAME_PLACE, Anchors, refuse_faulty
from ..common.errors import InputError
from ..common.survey import read_survey
from ..common.transforms import Frames
from ..effects import EffectSet
from ..effects.anchor import AnchorDelay, AnchorPosition
from .node import MOST_QUOTED, Parameter, StreamNode
from .topics import Input, Refusals, publishers_of

ANCHORS_QOS = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
CALIBRATION = "/uwb/calibration"  # of all tags of an installation
MOST_FRAMES = 100  # names that a node remembers; a topic may carry any number of them
SAME_TURN = 1e-3  # largest difference of quaternions of the same anchor
# Best effort and volatile: such a subscription receives messages from every publisher.
ANY_QOS = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
ANCHORS_FILE = Parameter(
    "",
    (
        'survey of the anchors, as the tools read it (YAML, CSV, total station); "" for those of '
        "uwb/anchors"
    ),
)


def anchors_to_message(anchors: Anchors) -> AnchorArray:
    """Return the AnchorArray of Anchors, with a stamp of 0, since anchors do not age."""
    message = AnchorArray()
    message.header.frame_id = anchors.frame
    known = np.where(np.isfinite(anchors.orientations), anchors.orientations, 0.0)
    for i, (x, y, z), q in zip(anchors.ids.tolist(), anchors.positions.tolist(), known.tolist()):
        orientation = Quaternion(x=q[0], y=q[1], z=q[2], w=q[3])
        message.anchors.append(
            Anchor(id=i, pose=Pose(position=Point(x=x, y=y, z=z), orientation=orientation))
        )
    return message


def same_anchors(one: Anchors, other: Anchors) -> bool:
    """Return whether two Anchors agree within SAME_PLACE and SAME_TURN for each anchor."""
    return (
        one.frame == other.frame
        and np.array_equal(one.ids, other.ids)
        and bool((np.linalg.norm(one.positions - other.positions, axis=1) <= SAME_PLACE).all())
        and np.allclose(
            one.orientations, other.orientations, rtol=0.0, atol=SAME_TURN, equal_nan=True
        )
    )


def in_words(before: Anchors, after: Anchors) -> str:
    """Return a sentence on the change between two Anchors: new, gone, moved, and what follows."""
    if before.frame != after.frame:
        return f"they are in frame '{after.frame}', and were in '{before.frame}': starting over"
    places = before.index(after.ids)
    stay = (places >= 0) & (
        np.linalg.norm(before.positions[places] - after.positions, axis=1) <= SAME_PLACE
    )
    named = {
        "new": after.ids[places < 0],
        "gone": before.ids[after.index(before.ids) < 0],
        "elsewhere": after.ids[(places >= 0) & ~stay],
    }
    parts = [
        f"{word}: {', '.join(map(str, ids[:MOST_NAMED]))}{', ...' if len(ids) > MOST_NAMED else ''}"
        for word, ids in named.items()
        if len(ids)
    ]
    return "; ".join(
        [*parts, f"going on with the {stay.sum()} that stay" if stay.any() else "starting over"]
    )


def calibration_to_message(effects: EffectSet, anchors: Anchors) -> Calibration:
    """Return a Calibration with the positions, delays and covariance of an EffectSet."""
    keys = [(AnchorPosition.name, f"{i}.{axis}") for i in anchors.ids.tolist() for axis in "xyz"]
    keys += [(AnchorDelay.name, str(i)) for i in anchors.ids.tolist()]
    values = {(one.name, key): value for one in effects for key, value in one.values.items()}
    numbers = [values.get(key, 0.0) for key in keys]
    message = Calibration(
        ids=anchors.ids.tolist(),
        shifts=numbers[: 3 * len(anchors)],
        delays=numbers[3 * len(anchors) :],
    )
    message.header.frame_id = anchors.frame
    if effects.covariance is not None:
        held, matrix = effects.covariance.of(keys)
        if len(held) == len(keys):
            message.covariance = matrix.ravel().tolist()
    return message


def of_calibration(message: Calibration) -> tuple[AnchorPosition, AnchorDelay]:
    """Return the effects that a Calibration states; raise InputError if it is faulty."""
    ids, numbers = message.ids.tolist(), [*message.shifts, *message.delays]
    if len(numbers) != 4 * len(ids) or len(message.shifts) != 3 * len(ids):
        raise InputError(
            f"{len(message.shifts)} shifts and {len(message.delays)} delays are no three and one "
            f"for each of {len(ids)} anchors."
        )
    if len(set(ids)) < len(ids):
        raise InputError(f"ids: {max(ids, key=ids.count)} is there twice.")
    shifts = {
        f"{i}.{axis}": value
        for i, of_anchor in zip(ids, np.reshape(message.shifts, (-1, 3)).tolist())
        for axis, value in zip("xyz", of_anchor)
    }
    delays = dict(zip(map(str, ids), message.delays.tolist()))
    return AnchorPosition(values=shifts), AnchorDelay(values=delays)


class AnchorsInput:
    """Input of anchors from a file or from uwb/anchors, transient local or repeated.

    Attributes
    ----------
    anchors : Anchors or None
    """

    def __init__(
        self, node: StreamNode, on_change: Callable[[Anchors], None], file: str = ""
    ) -> None:
        """Read the file if there is one, and subscribe to uwb/anchors.

        With a file, messages are only compared with it. `start` delivers its anchors, after the node
        is complete.

        on_change(anchors) : called with the first Anchors, and with changed ones
        file : path, "" for none; a faulty file raises InputError
        """
        self.anchors: Anchors | None = None
        self._refused: str | None = None
        self._node, self._on_change, self._file = node, on_change, file
        self._of_file = read_survey(file) if file else None
        self._repeated: Input | None = None  # subscription to volatile publishers
        events = SubscriptionEventCallbacks(incompatible_qos=self._on_incompatible)
        self._latched = Input(
            node, AnchorArray, "uwb/anchors", self._on_message, ANCHORS_QOS, event_callbacks=events
        )

    def start(self) -> None:
        """Deliver the anchors of the file, if there is one."""
        if self._of_file is not None:
            self.anchors = self._of_file
            self._on_change(self.anchors)

    @property
    def refused(self) -> str | None:
        """The fault of the last message that was refused, or None.

        With a file, it is forgotten once nobody publishes anchors any more.
        """
        if self._of_file is not None and not self._node.count_publishers("uwb/anchors"):
            self._refused = None
        return self._refused

    @property
    def refusals(self) -> list[Refusals]:
        """Refusals of each subscription."""
        return [end.refusals for end in (self._latched, self._repeated) if end is not None]

    def _on_incompatible(self, _: QoSRequestedIncompatibleQoSInfo) -> None:
        if self._repeated is None:
            self._node.get_logger().warning(
                "uwb/anchors is not published reliable and transient local: taken when it is "
                "repeated"
            )
            self._repeated = Input(
                self._node, AnchorArray, "uwb/anchors", self._on_message, ANY_QOS
            )

    def _on_message(self, message: AnchorArray) -> None:
        try:
            anchors, self._refused = refuse_faulty(Anchors.from_message(message)), None
        except InputError as error:
            self._refused = str(error)
            return
        if self._node.frozen and self.anchors is not None:
            if not same_anchors(anchors, self.anchors):
                self._node.refuse("other anchors on uwb/anchors")
            return
        if self._of_file is not None:
            if not same_anchors(anchors, self._of_file):
                self._refused = (
                    f"uwb/anchors has other anchors than anchors_file, {self._file}, which "
                    f"counts: stop {publishers_of(self._node, 'uwb/anchors')}, or, if that plays "
                    f"a bag, convert the bag with --survey {self._file}"
                )
            return
        if self.anchors is not None:
            if same_anchors(anchors, self.anchors):
                return
            self._node.get_logger().warning(
                f"the anchors have changed: {in_words(self.anchors, anchors)}"
            )
        self.anchors = anchors
        self._on_change(anchors)


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
