# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""autopilot_node: odometry that may be flown by to an autopilot, and samples of a Crazyflie.

odometry (nav_msgs/Odometry), status (EstimatorStatus)
  -> odometry/gated (nav_msgs/Odometry: what was sent), /diagnostics
     (diagnostic_msgs/DiagnosticArray), and by `protocol`
     mavlink: ODOMETRY to PX4 or ArduPilot;
     crazyflie: positions or poses by cflib, and its log blocks -> uwb/tdoa (Tdoa),
     imu/data (sensor_msgs/Imu), height (sensor_msgs/Range), pressure (sensor_msgs/FluidPressure).
Every parameter is documented in config/autopilot_node.yaml.
"""

from __future__ import annotations

from collections.abc import Sequence
import sys
from typing import Any

from diagnostic_msgs.msg import DiagnosticStatus
from nav_msgs.msg import Odometry
import numpy as np

from uwb_tdoa_bias.common.errors import InputError, refuse_others
from uwb_tdoa_bias.ros.anchors import ANCHORS_QOS as STATUS_QOS
from uwb_tdoa_bias.ros.cdr import CdrCodec
from uwb_tdoa_bias.ros.node import (
    Diagnostics,
    Parameter,
    Rate,
    StreamNode,
    declare_all,
    refuse_unknown,
    run,
)
from uwb_tdoa_bias.ros.topics import OVERRIDES, STREAM_QOS, Input, publish_stream
from uwb_tdoa_msgs.msg import EstimatorStatus

from .autopilot.crazyflie import POSE, POSITION, TOPICS, CrazyflieLink, VehicleTopics
from .autopilot.estimate import FRD, WORLDS, Estimate, Gate, Link
from .autopilot.mavlink import FORMS, MavlinkLink

REST = 0.004  # s between two turns: PX4 uses a TIMESYNC answer that took less than 10 ms
NONE, MAVLINK, CRAZYFLIE = "none", "mavlink", "crazyflie"
PARAMETERS = {  # in the order of config/autopilot_node.yaml
    "protocol": Parameter(
        NONE,
        "what the autopilot speaks; none: publish odometry/gated alone",
        choices=(NONE, MAVLINK, CRAZYFLIE),
    ),
    "connection": Parameter(
        "", f"of mavlink: {FORMS}; of crazyflie: an address of cflib (radio://0/80/2M/E7E7E7E7E7)"
    ),
    "baud": Parameter(921600, "bits/s of a serial port", 1200, 12_000_000),
    "system_id": Parameter(
        1, "MAVLink system id of the vehicle (MAV_SYS_ID, SYSID_THISMAV)", 1, 255
    ),
    "world": Parameter(
        FRD,
        (
            "frame of ODOMETRY: frd keeps the x axis of the anchors' frame; ned makes north the x axis, "
            "by hall_yaw"
        ),
        choices=WORLDS,
    ),
    "hall_yaw": Parameter(
        0.0,
        "rad; from east to the x axis of the anchors' frame, counterclockwise, for world ned",
        -6.3,
        6.3,
    ),
    "origin": Parameter(
        [0.0],
        (
            "latitude and longitude, deg, and altitude, m, of the origin of the anchors' frame, for "
            "SET_GPS_GLOBAL_ORIGIN; [0.0]: it is not sent"
        ),
    ),
    "statustext": Parameter(True, "send a MAVLink STATUSTEXT with the reason if nothing is sent"),
    "content": Parameter(
        POSE,
        "what a Crazyflie gets: pose, or position, which needs no yaw",
        choices=(POSE, POSITION),
    ),
    "rate": Parameter(50.0, "Hz; most estimates per second of their stamps", 5.0, 200.0),
    "largest_deviation": Parameter(
        1.5,
        "m; an estimate with a larger standard deviation of a coordinate is not sent",
        0.01,
        100.0,
    ),
    "log": Parameter(
        [""],
        f'log blocks of a Crazyflie to publish, of {", ".join(TOPICS)}; [""] for none',
    ),
}


class AutopilotNode(StreamNode):
    """Read messages for a Gate, and give what passes it to a Link."""

    NAME = "autopilot_node"
    PERIOD = REST  # see `take`

    def __init__(self) -> None:
        """Open the link, subscribe to odometry and status."""
        super().__init__(self.NAME)
        own = declare_all(self, PARAMETERS)
        refuse_unknown(self)
        needs_yaw = own["protocol"] != CRAZYFLIE or own["content"] == POSE
        self._gate = Gate(own["rate"], own["largest_deviation"], needs_yaw)
        self._codec, self._rate = CdrCodec(Odometry, "pose", "twist"), Rate()
        self._waiting: list[bytes] = []
        self._received = self._invalid = self._received_before = 0
        self._topics = VehicleTopics(self, own["log"])
        self._link, self._says = self._open(own), own["statustext"]
        self._publisher = publish_stream(self, Odometry, "odometry/gated")
        self._input = Input(
            self,
            Odometry,
            "odometry",
            self._waiting.append,
            STREAM_QOS,
            read=bytes,
            served=False,
            qos_overriding_options=OVERRIDES,
        )
        self._status = Input(self, EstimatorStatus, "status", self._on_status, STATUS_QOS)
        self._diagnostics = Diagnostics(self, self._report)
        self.turns = self
        self.ready = f"ready; protocol {own['protocol']}"

    def _open(self, own: dict[str, Any]) -> Link:
        """Return the Link that the parameters ask for."""
        protocol, streams = own["protocol"], [name for name in own["log"] if name]
        refuse_others("log", streams, TOPICS)
        if streams and protocol != CRAZYFLIE:
            raise InputError("log: only a Crazyflie has log blocks; set protocol to crazyflie.")
        if protocol == MAVLINK:
            origin = [] if len(own["origin"]) == 1 else own["origin"]
            if origin and not (len(origin) == 3 and (np.abs(origin) <= (90.0, 180.0, 1e5)).all()):
                raise InputError(
                    f"origin: {list(origin)} is no latitude, longitude (deg) and altitude (m)."
                )
            world = own["world"], own["hall_yaw"]
            return MavlinkLink(
                own["connection"], own["baud"], own["system_id"], world, origin, self._now
            )
        if protocol == CRAZYFLIE:
            return CrazyflieLink(
                own["connection"], own["content"], streams, self._topics, self._now
            )
        return Link()

    def _now(self) -> int:
        return self.get_clock().now().nanoseconds

    def _on_status(self, message: EstimatorStatus) -> None:
        self._gate.set_status(message.status, message.yaw_known, message.why)

    def take(self) -> float:
        """Run one turn, and return the rest after it, in s."""
        self._link.turn()
        self._input.take_all()
        if self._waiting:
            messages, now = self._waiting[:], self._now()
            self._waiting.clear()
            self._gate.publishers = max(
                each.subscription.get_publisher_count() for each in (self._input, self._status)
            )
            for _, rows, some in self._codec.read(messages, self._input.refusals.add):
                for row, data in zip(rows, messages[some]):
                    self._pass_on(row, data, now)
        return REST

    def _pass_on(self, row: Any, data: bytes, now: int) -> None:
        """Send one message of odometry if it may be flown by."""
        self._received += 1
        stamp = int(row["sec"]) * 10**9 + int(row["nanosec"])
        estimate = Estimate.from_numbers(stamp, row["pose"], row["twist"])
        if estimate is None:
            self._invalid += 1
        elif self._gate.admit(estimate, now):
            self._link.send(estimate, self._gate.resets)
            self._publisher.publish(data)

    def _report(self) -> tuple[bytes, str, dict[str, Any]]:
        trouble, counts = self._link.report()
        recent, self._received_before = self._received - self._received_before, self._received
        values = {
            "received": self._received,
            "passed": self._gate.passed,
            "invalid": self._invalid,
            "resets": self._gate.resets,
            "held back because": self._gate.why,
            "rate": f"{self._rate.of(self._gate.passed):.1f} Hz",
            **counts,
            "publishers of odometry": self._input.subscription.get_publisher_count(),
            "publishers of status": self._status.subscription.get_publisher_count(),
            "subscribers of odometry/gated": self._publisher.get_subscription_count(),
            "unreadable on odometry": self._input.refusals.count,
            "unreadable on status": self._status.refusals.count,
            **self._topics.subscribers,
        }
        text = (
            self._input.refusals.trouble()
            or self._status.refusals.trouble()
            or trouble
            or (
                "" if recent else "no odometry: start ekf_node in this namespace, or see its status"
            )
            or (self._gate.why and f"nothing is sent to the autopilot: {self._gate.why}")
        )
        if self._says:
            self._link.say(text)
        if text:
            return DiagnosticStatus.WARN, text, values
        return DiagnosticStatus.OK, "the autopilot gets odometry", values

    def destroy_node(self) -> None:
        """End the link and the node."""
        self._link.close()
        super().destroy_node()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node and return the exit code."""
    return run(AutopilotNode, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
