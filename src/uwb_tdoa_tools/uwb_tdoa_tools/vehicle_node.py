# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""vehicle_node: a simulated quadrotor or rover that goes by the odometry of our nodes, or of others.

odometry (nav_msgs/Odometry), status (EstimatorStatus)
  -> imu/data (sensor_msgs/Imu), uwb/tdoa (Tdoa), uwb/anchors (AnchorArray, latched),
  ground_truth/pose (geometry_msgs/PoseStamped),
     initialpose (geometry_msgs/PoseWithCovarianceStamped, once), verdict (std_msgs/String: JSON,
     latched); if asked for: the topics of SENSORS, e.g. height (sensor_msgs/Range), and /clock.
Services takeoff, go_to, land (Takeoff, GoTo, Land), as users of crazyswarm2 know them.
Every parameter is documented in config/vehicle_node.yaml.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
import json
import sys
import time
from typing import Any, TypeVar

from builtin_interfaces.msg import Duration as DurationMessage
from rclpy.duration import Duration
from std_msgs.msg import String

from uwb_tdoa_bias.common.errors import InputError, refuse_others
from uwb_tdoa_bias.common.flight import SENSOR_NAMES
from uwb_tdoa_bias.ros.anchors import ANCHORS_QOS
from uwb_tdoa_bias.ros.node import (
    Parameter,
    StreamNode,
    StreamPoller,
    declare_all,
    refuse_unknown,
    run,
)
from uwb_tdoa_msgs.srv import GoTo, Land, Takeoff

from .choices import FLOWN
from .flying import rover
from .flying.mission import Circles, Waypoints
from .flying.over_topics import Lockstep, OverTopics, RealTime
from .flying.pilot import Pilot
from .flying.trial import Task, Trial
from .flying.vehicle import WORLDS, world_of
from .flying.verdict import reached, sentence, verdict_of

Response = TypeVar("Response", Takeoff.Response, GoTo.Response, Land.Response)
PARAMETERS = {  # in the order of config/vehicle_node.yaml
    "vehicle": Parameter(
        "quadrotor",
        "what it is; a rover drives, with mission alone, and publishes velocity",
        choices=FLOWN,
    ),
    "world": Parameter("hall", "what it flies in (docs/flying.md)", choices=tuple(WORLDS)),
    "seed": Parameter(1, "of all that is random, as of fly", 0, 2**31 - 1),
    "told": Parameter(
        "place",
        "prior that the filter gets at the start: its place and yaw, to 0.1 m and 0.1 rad",
        choices=("nothing", "place"),
    ),
    "sensors": Parameter(
        [""], f'what else it measures, of {", ".join(SENSOR_NAMES)}; [""] for nothing'
    ),
    "mission": Parameter(
        False,
        (
            "fly the standard mission, publish the verdict, and end, with exit code 1 unless it "
            "has landed"
        ),
    ),
    "simulated_time": Parameter(
        False, "publish /clock, and continue when the odometry is there; else in real time"
    ),
    "duration": Parameter(600.0, "s; how long it can be flown, without the mission", 10.0, 1800.0),
}
COMMANDS: dict[str, tuple[type, Callable[..., None], Callable[[Any], tuple[Any, ...]]]] = {
    # {service: (type, method of Pilot, its values in a request)}
    "takeoff": (
        Takeoff,
        Pilot.take_off,
        lambda of: (of.group_mask, of.height, _seconds(of.duration)),
    ),
    "go_to": (
        GoTo,
        Pilot.go_to,
        lambda of: (
            of.group_mask,
            of.relative,
            (of.goal.x, of.goal.y, of.goal.z),
            of.yaw,
            _seconds(of.duration),
        ),
    ),
    "land": (
        Land,
        Pilot.land,
        lambda of: (of.group_mask, of.height, _seconds(of.duration)),
    ),
}
SETTLE = 1.0  # s from the first subscription until the other nodes have discovered each other


class VehicleNode(StreamNode):
    """A Trial on topics, with services to command it."""

    NAME = "vehicle_node"

    def __init__(self) -> None:
        """Declare the parameters, and wait for listeners."""
        super().__init__(self.NAME)
        own = declare_all(self, PARAMETERS)
        refuse_unknown(self)
        self._mission, sensors = own["mission"], [name for name in own["sensors"] if name]
        refuse_others("sensors", sensors, SENSOR_NAMES)
        drives = own["vehicle"] == "rover"
        if drives and (sensors or not self._mission):
            raise InputError(
                "vehicle: a rover takes no commands and no sensors; set mission to true."
            )
        world = world_of(own["world"], sensors=rover.SENSOR_NAMES if drives else sensors)
        known = own["told"] == "place"
        path = Waypoints() if drives else Circles()
        task = Task(world, own["seed"], own["told"], "known" if known else "unknown", path=path)
        self._pace = Lockstep() if own["simulated_time"] else RealTime()
        self._topics = OverTopics(self, world, self._pace, own["simulated_time"])
        lasts = None if self._mission else own["duration"]
        self._trial = (rover.RoverTrial if drives else Trial)(task, self._topics, lasts)
        self._pilot, self._reported = Pilot(self._trial), 0  # missions that were judged
        self._verdict = self.create_publisher(String, "verdict", ANCHORS_QOS)
        self._offered = (
            ()
            if self._mission
            else [
                self.create_service(kind, name, partial(self._answer, name))
                for name, (kind, *_) in COMMANDS.items()
            ]
        )
        self._starts: float | None = None  # time.monotonic() of the start, s, after a subscription
        self.turns = StreamPoller([self.take])
        self.get_logger().info(
            "ready; waiting for who listens to imu/data and uwb/tdoa, and publishes odometry"
        )

    def take(self) -> bool:
        """Run one turn if it is due, and return True: another one follows."""
        self._topics.receive()
        if self._starts is None and self._topics.is_connected():
            self._topics.wait_for_anchors()
            self._starts = time.monotonic() + SETTLE
        if self._starts is None or time.monotonic() < self._starts or not self._pace.may_go_on():
            return True
        trial = self._trial
        if self._mission and not trial.missions:
            trial.begin()
        trial.turn()
        self._topics.publish_truth(trial.simulator.now, trial.simulator.state)
        if len(trial.missions) > self._reported and trial.over:
            self._report_verdict()
        if trial.crash or trial.simulator.over:
            self.get_logger().error(f"the flight is over: {trial.crash or 'its time is up'}")
            raise SystemExit(1)
        return True

    def _report_verdict(self) -> None:
        """Publish and log the verdict of the mission under way.

        After the standard mission, exit with the code of the verdict.
        """
        verdict, self._reported = verdict_of(self._trial.result), len(self._trial.missions)
        self._verdict.publish(String(data=json.dumps(verdict)))
        self.get_logger().info(sentence(verdict))
        if self._mission:
            self._verdict.wait_for_all_acked(Duration(seconds=SETTLE))
            raise SystemExit(int(not reached(verdict)))

    def _answer(self, name: str, request: Any, response: Response) -> Response:
        """Execute a request for one of COMMANDS, or state why not in the response."""
        _, command, values = COMMANDS[name]
        try:
            command(self._pilot, *values(request))
            response.success = True
        except InputError as error:
            response.message = str(error)
        return response


def _seconds(duration: DurationMessage) -> float:
    return duration.sec + 1e-9 * duration.nanosec


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node, and return the exit code."""
    return run(VehicleNode, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
