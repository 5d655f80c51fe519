# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""debias_node: odometry in, odometry with the bias of its position taken out.

odometry (nav_msgs/Odometry), uwb/anchors (AnchorArray)
  -> odometry/debiased (nav_msgs/Odometry: one for each, same stamp and frames),
     /diagnostics (diagnostic_msgs/DiagnosticArray).
Every parameter is documented in config/debias_node.yaml.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from copy import copy
import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.ros.anchors import ANCHORS_FILE, AnchorsInput
from uwb_tdoa_bias.ros.node import (
    FROZEN,
    Diagnostics,
    Parameter,
    Rate,
    StreamNode,
    declare_all,
    refuse_unknown,
    run,
)
from uwb_tdoa_bias.ros.topics import OVERRIDES, STREAM_QOS, Input, publish_stream

from .debias import BiasMap

LARGEST_OUTSIDE = 0.5  # share of positions outside the map that raises a warning
# in the order of config/debias_node.yaml
PARAMETERS = {
    "map": Parameter("", "file that `debias` wrote; must be given"),
    "anchors_file": ANCHORS_FILE,
    "frozen": FROZEN,
}


class DebiasNode(StreamNode):
    """Convert messages for a BiasMap and count them.

    Each message has one result: received = corrected + faded + outside + refused + invalid.
    """

    NAME = "debias_node"

    def __init__(self) -> None:
        """Load the map, subscribe to odometry and anchors, and advertise the corrected odometry."""
        super().__init__(self.NAME)
        own = declare_all(self, PARAMETERS)
        refuse_unknown(self)
        file = own["map"]
        if not file:
            raise InputError("map: is empty; give a file that `debias` wrote.")
        self._map, self._rate = BiasMap.load(file), Rate()
        self._counts: Counter[str] = Counter()
        self._counts_before: Counter[str] = Counter()
        self._publisher = publish_stream(self, Odometry, "odometry/debiased")
        self._input = Input(
            self,
            Odometry,
            "odometry",
            self._on_odometry,
            copy(STREAM_QOS),
            qos_overriding_options=OVERRIDES,
        )
        # whether the map was made for the anchors; None until anchors arrive
        self._map_fits_anchors: bool | None = None
        self._anchors = AnchorsInput(self, self._on_anchors, own["anchors_file"])
        self._anchors.start()
        self._diagnostics = Diagnostics(self, self._report)
        self.ready = f"ready; {len(self._map.at)} markers"

    def _on_anchors(self, anchors: Anchors) -> None:
        self._map_fits_anchors = self._map.belongs_to(anchors)

    def _on_odometry(self, message: Odometry) -> None:
        """Publish the odometry with position and position covariance corrected; count the result.

        Other messages pass unchanged: invalid ones, and all while the map does not fit the anchors.
        """
        self._counts["received"] += 1
        point = message.pose.pose.position
        p = np.array([point.x, point.y, point.z])
        if message.header.frame_id != self._map.frame or not np.isfinite(p).all():
            kind = "invalid"
        elif not self._map_fits_anchors:
            kind = "refused"
        else:
            covariance = np.array(message.pose.covariance).reshape(6, 6)
            positions, covariances, validities = self._map.correct(
                p[None], covariance[None, :3, :3]
            )
            point.x, point.y, point.z = positions[0].tolist()
            covariance[:3, :3] = covariances[0]
            validity = validities[0]
            kind = "corrected" if validity == 1.0 else "faded" if validity > 0.0 else "outside"
            message.pose.covariance = covariance.ravel()
        self._counts[kind] += 1
        self._publisher.publish(message)

    def _report(self) -> tuple[bytes, str, dict[str, str | int]]:
        kinds = ("corrected", "faded", "outside", "refused", "invalid")
        recent = {name: self._counts[name] - self._counts_before[name] for name in kinds}
        self._counts_before = Counter(self._counts)
        rate = self._rate.of(self._counts["received"])
        values: dict[str, Any] = {name: self._counts[name] for name in ("received", *kinds)}
        values |= {
            "odometry rate": f"{rate:.1f} Hz",
            "map": self._map.source,
            "markers": len(self._map.at),
        }
        values |= {"publishers of odometry": self._input.subscription.get_publisher_count()}
        values |= {"subscribers of odometry/debiased": self._publisher.get_subscription_count()}
        values |= {"unreadable on odometry": self._input.refusals.count}
        level, text = self._status(recent, sum(recent.values()))
        unreadable = self._input.refusals.trouble() or self._anchors.refused
        if unreadable and level != DiagnosticStatus.ERROR:
            level, text = DiagnosticStatus.WARN, unreadable
        return level, text, values

    def _status(self, recent: dict[str, int], total: int) -> tuple[bytes, str]:
        if not total:
            return (
                DiagnosticStatus.WARN,
                "no odometry: start ekf_node in this namespace, or see its status",
            )
        if recent["invalid"]:
            what = (
                f"odometry is not finite, or not in the map's frame '{self._map.frame}', and is "
                "passed on as it is"
            )
            return (
                DiagnosticStatus.ERROR,
                f"{what}: correct world_frame of ekf_node, or make a map in its frame",
            )
        if recent["refused"] and self._map_fits_anchors is None:
            return (
                DiagnosticStatus.WARN,
                (
                    "no anchors, so positions pass uncorrected: start anchors_node, or give "
                    "anchors_file"
                ),
            )
        if recent["refused"]:
            what = "the map was made for other anchors, so positions pass uncorrected"
            return DiagnosticStatus.ERROR, f"{what}: make one for these with debias fit"
        if recent["outside"] > LARGEST_OUTSIDE * total:
            return (
                DiagnosticStatus.WARN,
                "most positions are outside of the map, not corrected: map more of the room",
            )
        return DiagnosticStatus.OK, "debiasing"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node and return the exit code."""
    return run(DebiasNode, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
