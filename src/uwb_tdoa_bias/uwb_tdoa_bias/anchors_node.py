# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""anchors_node: the anchors of a survey file, for nodes, RViz and bags.

  -> uwb/anchors (AnchorArray), /tf_static (tf2_msgs/TFMessage: the frame of the survey ->
  anchor_<id>),
     uwb/anchors/markers (visualization_msgs/MarkerArray); all transient local.
One for all tags of a room: remap their uwb/anchors to its own. Every parameter is documented in
config/anchors_node.yaml.
"""

from __future__ import annotations

from collections.abc import Sequence
import sys

from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from uwb_tdoa_msgs.msg import AnchorArray

from .common.errors import InputError
from .common.survey import read_survey
from .ros.anchors import ANCHORS_FILE, ANCHORS_QOS, TF_STATIC_QOS, anchors_to_message
from .ros.node import (
    FROZEN,
    Parameter,
    StreamNode,
    declare_all,
    refuse_unknown,
    run,
)

PARAMETERS = {  # in the order of config/anchors_node.yaml
    "anchors_file": Parameter(
        ANCHORS_FILE.default, "survey of the anchors, as the tools read it; must be given"
    ),
    "marker_size": Parameter(
        0.12, "m; edge of the cube that shows an anchor, and height of its number", 0.001, 10.0
    ),
    "frozen": FROZEN,
}
LEVEL = Quaternion(w=1.0)  # of an anchor whose orientation was not surveyed


class AnchorsNode(StreamNode):
    """A node that publishes the anchors once, latched, and keeps running for late subscribers."""

    NAME = "anchors_node"

    def __init__(self) -> None:
        """Publish the anchors."""
        super().__init__(self.NAME)
        own = declare_all(self, PARAMETERS)
        refuse_unknown(self)
        if not own["anchors_file"]:
            raise InputError(
                "anchors_file: is empty; give a survey of the anchors, e.g. anchors.yaml."
            )
        anchors = read_survey(own["anchors_file"])
        message = anchors_to_message(anchors)
        for topic, qos, content in (
            ("uwb/anchors", ANCHORS_QOS, message),
            ("/tf_static", TF_STATIC_QOS, transforms(message)),
            ("uwb/anchors/markers", ANCHORS_QOS, markers(message, own["marker_size"])),
        ):
            self.create_publisher(type(content), topic, qos).publish(content)
        self.get_logger().info(
            f"{len(anchors)} anchors of {own['anchors_file']} in frame '{anchors.frame}'"
        )


def transforms(message: AnchorArray) -> TFMessage:
    """Return the TFMessage of an AnchorArray: a frame anchor_<id> for each anchor.

    Anchors with unknown orientation are level.
    """
    out = TFMessage()
    for anchor in message.anchors:
        p, q = anchor.pose.position, anchor.pose.orientation
        transform = Transform(
            translation=Vector3(x=p.x, y=p.y, z=p.z), rotation=q if _known(q) else LEVEL
        )
        out.transforms.append(
            TransformStamped(
                header=message.header, child_frame_id=f"anchor_{anchor.id}", transform=transform
            )
        )
    return out


def markers(message: AnchorArray, size: float) -> MarkerArray:
    """Return the MarkerArray of an AnchorArray: a cube and a number for each anchor.

    size : m, edge of a cube
    """
    out = MarkerArray()
    for anchor in message.anchors:
        for kind, name in ((Marker.CUBE, "anchors"), (Marker.TEXT_VIEW_FACING, "numbers")):
            marker = Marker(
                header=message.header, ns=name, id=anchor.id, type=kind, text=str(anchor.id)
            )
            q, p = anchor.pose.orientation, anchor.pose.position
            marker.pose.orientation = q if _known(q) else LEVEL
            marker.pose.position.x, marker.pose.position.y = p.x, p.y
            marker.pose.position.z = p.z + (1.5 * size if kind == Marker.TEXT_VIEW_FACING else 0.0)
            marker.scale.x = marker.scale.y = marker.scale.z = size
            marker.color.r, marker.color.g, marker.color.b, marker.color.a = 0.1, 0.4, 0.9, 1.0
            out.markers.append(marker)
    return out


def _known(q: Quaternion) -> bool:
    return any((q.x, q.y, q.z, q.w))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node, and return the exit code."""
    return run(AnchorsNode, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
