# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Anchors as messages, and their input into a node: a file or the topic uwb/anchors."""

from __future__ import annotations

from typing import TYPE_CHECKING

from geometry_msgs.msg import Point, Pose, Quaternion
import numpy as np
from rclpy.event_handler import QoSRequestedIncompatibleQoSInfo, SubscriptionEventCallbacks
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from uwb_tdoa_msgs.msg import Anchor, AnchorArray

from ..common.anchors import SAME_PLACE, Anchors, refuse_faulty
from ..common.errors import InputError
from ..common.survey import read_survey
from .parameters import Parameter
from .topics import Input, Refusals, publishers_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from .node import StreamNode

ANCHORS_QOS = QoSProfile(
    depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)
MOST_NAMED = 10  # anchors named in a sentence
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
