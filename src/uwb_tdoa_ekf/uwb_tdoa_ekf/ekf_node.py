# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""ekf_node: inertial samples and corrected TDOAs in, odometry out.

imu/data (sensor_msgs/Imu), uwb/tdoa_corrected (TdoaCorrected), uwb/anchors (AnchorArray),
/tf_static; if they are there: SENSORS, initialpose (geometry_msgs/PoseWithCovarianceStamped),
/uwb/calibration (Calibration, which bias_node applies)
  -> odometry (nav_msgs/Odometry), /tf (tf2_msgs/TFMessage), uwb/residual (TdoaResidual: one for
  each TdoaCorrected),
     status (EstimatorStatus: whether the odometry may be flown by), /diagnostics
     (diagnostic_msgs/DiagnosticArray).
Service ~/reset (std_srvs/Trigger): start anew.
Every parameter is documented in config/ekf_node.yaml.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Collection, Sequence
from functools import partial
import math
import sys
from typing import Any, cast

from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
from rclpy.clock import ROSClock
from rclpy.time import Time
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

from uwb_tdoa_bias.common import sensors
from uwb_tdoa_bias.common.anchors import Anchors, FlyableVolume
from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors import SENSORS
from uwb_tdoa_bias.common.transforms import Place
from uwb_tdoa_bias.correction.corrector import LARGEST_YAW_STD
from uwb_tdoa_bias.effects import EffectSet, ImuCorrector, StreamCorrector
from uwb_tdoa_bias.effects.tag import TagLeverArm
from uwb_tdoa_bias.ros.anchors import (
    ANCHORS_QOS,
    CALIBRATION,
    MOST_FRAMES,
    AnchorsInput,
    FramesInput,
    unknown_frame,
)
from uwb_tdoa_bias.ros.cdr import CdrCodec, message_class
from uwb_tdoa_bias.ros.node import (
    Diagnostics,
    Elapsed,
    Report,
    StreamNode,
    StreamPoller,
    refuse_unknown,
    run,
)
from uwb_tdoa_bias.ros.topics import Epoch, Input, Refusals, Streams, several_publishers
from uwb_tdoa_msgs.msg import Calibration, TdoaCorrected

from .compile_nodes import warm_up
from .core.config import FilterConfig
from .core.memory import INVALID
from .ekf_parameters import ODOM, declare_parameters, follow_changes
from .estimator import Estimator
from .frames import ImuMount, pose_from_message
from .monitoring.finding import Finding, most_severe_first
from .monitoring.health import OK, WARN, Health, off_the_clock, together
from .monitoring.status import FAULT, Status, status_of, with_fault_covariance, yaw_in_words
from .monitoring.stream_rules import FEW_ANCHORS, StreamWatch
from .outputs import Outputs, StatusOutput
from .reorder_buffer import STREAMS
from .results import VERDICTS, Odometry, Residuals, poses_of, rotation_std

# Topic, message type and fields to read, for each stream.
TOPICS = {
    "imu": [
        (
            "imu/data",
            Imu,
            "angular_velocity",
            "linear_acceleration",
            "angular_velocity_covariance",
            "linear_acceleration_covariance",
        )
    ],
    "tdoa": [
        (
            "uwb/tdoa_corrected",
            TdoaCorrected,
            "anchor_a",
            "anchor_b",
            "raw",
            "corrected",
            "bias_std",
            "variance",
            "bias_slope",
            "bias_state",
        )
    ],
} | {
    name: [(topic, message_class(kind), *sensor.fields) for topic, kind in sensor.topics]
    for name, sensor in SENSORS.items()
}
MOST_NAMED = 3  # frames that one message names
MAST = 0.1  # m, height of an antenna over the body from which the two heights differ visibly
EARLY = 5000  # messages kept until anchors arrive


class EkfNode(StreamNode):
    """Convert messages for an Estimator and publish its results.

    The node contains no filter code.
    """

    NAME = "ekf_node"

    def __init__(self, member: set[str] | None = None, **options: Any) -> None:
        """Declare parameters, compile the filter, and connect all topics.

        Parameters
        ----------
        member : set of str or None
            Given by a localization_node: names of parameters that may belong to its other nodes.
            The node then takes turns from its owner and receives corrected TDOAs in memory.
        **options
            Options of rclpy's Node.
        """
        super().__init__(self.NAME, **options)
        self._config, own = declare_parameters(self)
        self._reorder, self._lag, self._world, self._body = (
            own[name] for name in ("reorder", "lag", "world_frame", "body_frame")
        )
        if not self._reorder < self._lag:
            raise InputError(
                f"reorder, lag: {self._reorder!r}, {self._lag!r} must be seconds with 0 <= "
                "reorder < lag."
            )
        volume, effects_file = own["flyable_volume"], own["effects_file"]
        self._effects = EffectSet.from_yaml(effects_file) if effects_file else EffectSet()
        self._stream_corrector = StreamCorrector(self._effects.effects)
        self._estimator: Estimator = None  # type: ignore[assignment]  # None until anchors arrive
        self._said_restart: Finding | None = None
        self._epoch, self._ros_clock = Epoch(), cast("ROSClock", self.get_clock())
        # quaternion and covariance of the newest odometry
        self._attitude: tuple[np.ndarray, np.ndarray] | None = None
        self._findings: list[Finding] = []  # findings of the last report
        self._assumed: dict[
            str, tuple[str, ...]
        ] = {}  # by sensor: parameters that replace deviations which its messages do not state
        # True while a finding, or the use of TDOAs, makes the position unreliable
        self._fault = False
        self._received_before: dict[str, int] = {}  # messages by topic at the last report
        # Messages that arrived before the anchors, as (stream, (frame, stamps, rows, arrivals))
        # with one message each.
        self._early: deque[tuple[str, tuple[Any, ...]]] = deque()
        self._imu_missing = False  # whether only TDOAs had a publisher at the last report
        # counts of earlier estimators, and of messages that no estimator received
        self._past: Counter[str] = Counter()
        self._lately: list[
            str
        ] = []  # frames of the IMU since the last report, and the last frame before it
        self._placed: dict[
            str, tuple[ImuMount | None, str | None]
            # by frame of the IMU, in order of arrival: ImuMount (None for the body frame), and the
            # problem with it
        ] = {}
        # by sensor in SENSORS: the sentence on its unknown frame
        self._unplaced: dict[str, str] = {}
        self._remark_height()
        self._health = Health(
            self._config,
            self._lag,
            FlyableVolume.load(volume) if volume else None,
            Elapsed(self),
        )
        refuse_unknown(self, member or ())
        self.get_logger().info(
            "loading the filter; the first time it is compiled, which takes a minute, unless "
            "compile_nodes has done so"
        )
        warm_up()
        moving = own["publish_tf"] == ODOM
        self._frames = FramesInput(self, self._epoch.seconds, self._on_frames, moving)
        frames = self._frames.frames
        self.outputs = Outputs(
            self,
            self._epoch,
            frames,
            self._body,
            own["publish_tf"],
            own["odom_frame"],
            self._config.planar,
        )
        self._anchors = AnchorsInput(self, self._on_anchors, own["anchors_file"])
        self.streams = self._subscribe({"uwb/tdoa_corrected"} if member is not None else ())
        self._pose = Input(self, PoseWithCovarianceStamped, "initialpose", self._on_pose, 10)
        if not self.frozen:  # or anybody could keep changes from being found
            Input(self, Calibration, CALIBRATION, self._on_calibration, ANCHORS_QOS)
        self._reset = self.create_service(Trigger, "~/reset", self._on_reset)
        follow_changes(self, lambda: self._config, self._on_config)
        self._status = StatusOutput(self)
        self._diagnostics = Diagnostics(self, self._report, self._tell_status)
        self._anchors.start()
        if member is None:
            self.turns = StreamPoller([self.streams.take])
        self.ready = "ready"

    def _remark_height(self) -> None:
        """Log a warning if fixed_height seems to be the height of the antenna."""
        arm = sum(
            effect.values.get("z", 0.0)
            for effect in self._effects.effects
            if isinstance(effect, TagLeverArm)
        )
        if (
            self._config.known_height_std > 0.0
            and abs(arm) > MAST
            and abs(self._config.fixed_height - arm) < 0.5 * MAST
        ):
            self.get_logger().warning(
                f"fixed_height is that of {self._body}, and equals the height of the antenna "
                f"over it ({TagLeverArm.name} of effects_file): "
                f"give 0.0 for a {self._body} on the floor"
            )

    def _subscribe(self, handed: Collection[str]) -> Streams:
        """Return Streams of all measurements that the filter takes.

        Parameters
        ----------
        handed : collection of str
            Topics that another node of this process delivers in memory.
        """
        streams = Streams(self, self._epoch, self._advance)
        self._takers = {"imu": self._take_imu, "tdoa": self._take_tdoa} | {
            name: partial(self._take_sensor, name) for name in SENSORS
        }
        for stream, topics in TOPICS.items():
            if stream in SENSORS and not getattr(self._config, f"use_{stream}"):
                continue
            for topic, kind, *fields in topics:
                codec = CdrCodec(kind, *fields, of_twist=stream in SENSORS)
                streams.add(codec, topic, partial(self._receive, stream), topic in handed)
        streams.wait_for("uwb/tdoa_corrected", self.due)
        return streams

    def due(self) -> float:
        """Return the stamp, in s since 1970, up to which no odometry will come."""
        return (
            -math.inf
            if self._estimator is None
            else self._estimator.next_odometry + self._epoch.begin
        )

    def _on_anchors(self, anchors: Anchors) -> None:
        # Keep the filter if some anchors stay, else start a new filter with the messages kept so
        # far.
        if self._estimator is not None and self._estimator.stay(anchors):
            self._estimator.change_anchors(anchors)
            self._watch = self._new_watch(anchors)
            return
        if self._estimator is not None:
            self._publish(*self._estimator.finish())
            self._past.update(
                self._estimator.counts, restarts=1, recoveries=self._estimator.recoveries
            )
        self._estimator = Estimator(anchors, self._config, self._reorder, self._lag, self._effects)
        self._imu_corrector = ImuCorrector(self._effects.effects)
        self._watch, self._restarts = self._new_watch(anchors), 0
        self.outputs.set_world(self._world or anchors.frame)
        early, self._early = self._early, deque()
        for stream, part in early:
            self._takers[stream](*part)
        self._advance()

    def _new_watch(self, anchors: Anchors) -> StreamWatch:
        return StreamWatch(
            anchors, self._lag, [FEW_ANCHORS] if self._config.known_height_std > 0.0 else []
        )

    def _on_calibration(self, _: Calibration) -> None:
        if self._estimator is not None:
            self._estimator.recalibrated()

    def _on_config(self, config: FilterConfig) -> None:
        self._config = config
        if self._estimator is not None:
            self._estimator.configure(config)

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = self._estimator is not None and not self.frozen
        if response.success:
            response.message = "starting over"
            self._start_over()
        else:
            response.message = (
                self.refuse("a reset")
                if self.frozen
                else "there are no anchors yet: nothing has started"
            )
        return response

    def _start_over(self) -> None:
        self._publish(*self._estimator.reset())
        self._watch.restart()

    def _on_pose(self, message: PoseWithCovarianceStamped) -> None:
        if self.frozen and self.outputs.published:
            self.refuse("a pose on initialpose after the first odometry")
            return
        try:
            if self._estimator is None:
                raise InputError("there are no anchors yet; give the pose again when there are.")
            self._estimator.set_pose(
                *pose_from_message(message, self.outputs.world, self._epoch, self._estimator.newest)
            )
        except InputError as error:
            self.get_logger().warning(f"initialpose: not taken: {error}")

    def _on_frames(self) -> None:
        """Place all IMU frames again after a static transform was added or changed."""
        before, self._placed = self._placed, {}
        for frame in before:
            self._place_imu(frame, say=False)
        moved = [frame for frame in before if before[frame] != self._placed[frame]]
        self._placed |= {
            frame: before[frame] for frame in before if frame not in moved
        }  # an IMU that did not move keeps its state
        if moved and self._estimator is not None:
            self.get_logger().warning(f"the transform of '{moved[0]}' is new: starting over")
            self._start_over()

    def _place_imu(self, frame: str, say: bool = True) -> ImuMount | None:
        """Return the ImuMount of an IMU frame, or None if it is the body frame or unknown.

        Parameters
        ----------
        frame : str
            Frame of the IMU.
        say : bool
            Log a problem, once for each frame.
        """
        if frame in self._placed:
            return self._placed[frame][0]
        mount: ImuMount | None = None
        trouble: str | None = None
        if frame not in ("", self._body):
            between = self._frames.frames.between(self._body, frame)
            if between is None:
                trouble = unknown_frame("imu/data", frame, self._body)
                if say:
                    self.get_logger().warning(trouble)
            else:
                mount = ImuMount(*between)
        if len(self._placed) < MOST_FRAMES:
            self._placed[frame] = mount, trouble
        return mount

    def _place(self, name: str, frame: str) -> Place | None:
        """Return (Rotation, arm (3,) m) of a sensor in SENSORS; None in the body frame, or unknown."""
        in_body = frame in ("", self._body)
        place = None if in_body else self._frames.frames.between(self._body, frame)
        if in_body or place:
            self._unplaced.pop(name, None)
        else:
            self._unplaced[name] = unknown_frame(name, frame, self._body)
            self.warn_at_times(f"frame of {name}", self._unplaced[name])
        return place

    def _frame_troubles(self) -> list[str]:
        """Return sentences on problems with the frames of the IMU."""
        lately, self._lately = self._lately, self._lately[-1:]
        troubles = [
            *filter(None, (self._placed[frame][1] for frame in lately if frame in self._placed))
        ]
        if len(lately) > 1:
            names = ", ".join(f"'{frame}'" for frame in lately[:MOST_NAMED])
            troubles.insert(
                0,
                (
                    f"imu/data comes in {len(lately)} frames ({names}): stop all but one of the "
                    "drivers"
                ),
            )
        return troubles

    def _receive(self, stream: str, *part: Any) -> None:
        """Pass messages of a stream to the filter, or keep them until anchors arrive."""
        n = len(part[1])
        self._health.received[stream] += n
        if self._estimator is not None:
            self._takers[stream](*part)
            return
        frame, *columns = part
        self._early.extend(
            (stream, (frame, *(column[k : k + 1] for column in columns))) for k in range(n)
        )
        while len(self._early) > EARLY:
            stream, (_, t, rows, _) = self._early.popleft()
            self._past["invalid" if stream == "tdoa" else f"{stream}_invalid"] += 1
            if stream == "tdoa":
                self.outputs.publish_residuals(
                    Residuals.refused(t, rows["anchor_a"], rows["anchor_b"], INVALID)
                )

    def _advance(self) -> None:
        self._frames.catch_up()
        if self._estimator is not None:
            self._publish(*self._estimator.advance())
            self._say_restart()

    def _take_imu(self, frame: str, t: np.ndarray, rows: np.ndarray, arrival: np.ndarray) -> None:
        mount = self._place_imu(frame)
        if frame not in self._lately and len(self._lately) < MOST_FRAMES:
            self._lately.append(frame)
        # REP 145: linear_acceleration is the specific force
        gyro, accel = (rows["angular_velocity"].copy(), rows["linear_acceleration"].copy())
        unmeasured = (rows["angular_velocity_covariance"][:, 0] == -1.0) | (
            rows["linear_acceleration_covariance"][:, 0] == -1.0
        )
        if unmeasured.any():
            self.warn_at_times(
                "unmeasured",
                "imu/data says with a covariance of -1 that it has no angular velocity or no "
                "acceleration: such "
                "samples are not used; without a whole IMU set use_imu to false",
            )
            gyro[unmeasured] = math.nan
        if mount is not None:  # before effects: these have the body axes, as in `diagnose`
            gyro, accel = mount.in_body(t, gyro, accel)
        if not self._imu_corrector.idle:
            gyro, accel = self._imu_corrector.correct(t, gyro, accel)
        self._watch.add_imu(t + self._epoch.begin, self._arrived(arrival), gyro, accel)
        self._estimator.add_imu(t, gyro, accel)

    def _take_tdoa(self, frame: str, t: np.ndarray, rows: np.ndarray, arrival: np.ndarray) -> None:
        a, b = rows["anchor_a"], rows["anchor_b"]
        self._watch.add_tdoa(t + self._epoch.begin, self._arrived(arrival), a, b, rows["raw"])
        variance = rows["bias_std"] ** 2 + rows["variance"]
        self._estimator.add_tdoa(
            t, a, b, rows["corrected"], variance, rows["bias_slope"], rows["bias_state"]
        )

    def _take_sensor(
        self, name: str, frame: str, t: np.ndarray, rows: np.ndarray, arrival: np.ndarray
    ) -> None:
        """Pass messages of a sensor in SENSORS to the filter."""
        sensor = SENSORS[name]
        fields = {field: rows[field] for field in sensor.fields}
        if sensor.in_body is not None and (place := self._place(name, frame)):
            fields = sensor.in_body(fields, *place)
        stream = sensor.read(t, fields)
        if sensor.assumed is not None:
            self._assumed[name] = sensor.assumed(stream)
        self._estimator.add(name, self._stream_corrector.correct(name, stream))

    def _say_restart(self) -> None:
        """Log why the filter has restarted, once per restart."""
        restarted = self._estimator.restarted
        if restarted != self._said_restart and restarted is not None:
            self.warn_at_times("restarted", restarted.sentence)
        self._said_restart = restarted

    def _publish(self, odometry: Odometry, residuals: Residuals) -> None:
        # Publish odometry and residuals. While a fault holds, the covariance is that of an unknown
        # pose.
        if len(odometry.t):
            turns = self._yaw_may_turn(odometry)
            if self._fault:
                odometry = with_fault_covariance(odometry, self._estimator.workspace)
            self.outputs.publish_odometry(odometry, turns, self._estimator.rival)
            self._health.last_odometry = self._health.now()
            self._health.last_position = odometry.p[-1], odometry.covariance[-1, :3, :3]
            self._attitude = odometry.q[-1:], odometry.covariance[-1:]
        if len(residuals.t):
            self.outputs.publish_residuals(residuals)

    def _yaw_may_turn(self, odometry: Odometry) -> np.ndarray:
        """Return whether the filter follows several yaws, (n,) bool.

        Without inertial samples and velocities nothing shows the yaw, and it stays.
        """
        counts = self._estimator.counts
        shown = counts["imu_used"] + counts["velocity_used"] > 0
        return (poses_of(odometry)[-1] > LARGEST_YAW_STD) & shown

    def _arrived(self, arrival: np.ndarray) -> np.ndarray:
        """Return the arrival times of messages on the node's clock, (n,) s; NaN without a time."""
        if not self._ros_clock.ros_time_is_active:
            return arrival
        return np.full(len(arrival), 1e-9 * self._ros_clock.now().nanoseconds or math.nan)

    def _stream_findings(self) -> list[Finding]:
        """Return the findings of the rules over streams, most severe first; [] without anchors."""
        if self._estimator is None:
            return []
        estimator = self._estimator
        restarts, self._restarts = self._restarts, estimator.counts["restarts"]
        if self._restarts != restarts:
            self._watch.restart()
        found = self._watch.findings(estimator.sign_turns)
        return most_severe_first([*found, *estimator.findings])

    def _wiring(self) -> list[str]:
        """Return sentences on topics that are connected wrongly."""
        received = {
            topics[0][0]: self._health.received[stream] for stream, topics in TOPICS.items()
        }
        troubles = []
        for topic, end in self.streams.inputs.items():
            total = received.get(topic, 0)
            troubles.append(end.trouble(total - self._received_before.get(topic, 0)))
        self._received_before = received
        troubles += [refusals.trouble() for refusals in self._single]
        return [*filter(None, [*troubles, several_publishers(self, "odometry")])]

    @property
    def _single(self) -> list[Refusals]:
        """Return the Refusals of inputs that are not streams."""
        return [self._pose.refusals, *self._anchors.refusals, *self._frames.refusals]

    def _behind(self) -> float | None:
        """Return the age of the newest odometry on the node's clock, s; None without odometry."""
        if not self.outputs.published:
            return None
        return 1e-9 * (
            self.get_clock().now().nanoseconds - Time.from_msg(self.outputs.stamp).nanoseconds
        )

    def _tell_status(self) -> None:
        """Publish on `status` whether a vehicle may fly by the odometry.

        Nothing is published while simulated time stands still, because no measurement can arrive.
        """
        if self._diagnostics.paused:
            return
        self._health.look(self._estimator, self._counts())
        status, yaw_std = self._judge(), self._yaw_std()
        stamp = self.outputs.stamp if self.outputs.published else self.get_clock().now().to_msg()
        self._status.publish(
            status, yaw_std, self._health.use.age("tdoa"), stamp, self.outputs.world
        )

    def _judge(self) -> Status:
        """Return the current Status: whether a vehicle may fly by the odometry.

        At the end of a fault, the filter opens what the fault has spoiled.
        """
        last = self._health.last_odometry
        age = math.inf if last is None else self._health.now() - last
        status = status_of(
            self._estimator,
            self._yaw_std(),
            age,
            self._health.use,
            self._findings,
            self._anchors.refused,
            off_the_clock(self._behind()),
        )
        fault = status.status == FAULT
        over, self._fault = self._fault and not fault, fault
        if not over or self._estimator is None:
            return status
        self._estimator.distrust()
        self._attitude = None  # it is that of the fault
        return self._judge()

    def _counts(self) -> Counter[str]:
        """Return the totals over all estimators so far, by result of a message."""
        counts = Counter(self._past)
        if self._estimator is not None:
            counts.update(
                self._estimator.counts,
                recoveries=self._estimator.recoveries,
                yaw_doubts=self._estimator.yaw_doubts,
            )
        return counts

    def _yaw_std(self) -> float:
        """Return the standard deviation of the yaw in the world frame, rad, or NaN."""
        if self._estimator is None or not self._estimator.running or self._attitude is None:
            return math.nan
        return rotation_std(*self._attitude)[0, 2]

    def _look_for_imu(self) -> None:
        """Do not wait for inertial samples if two successive reports find no publisher of them.

        Otherwise the first poses come `lag` late, and bias_node does not wait so long for them. One
        report does not suffice: the publishers of a driver are discovered one after another.
        """
        missing = (
            self._health.corrects and not self.streams.inputs["imu/data"].get_publisher_count()
        )
        if self._estimator is not None:
            self._estimator.expect_imu(not (missing and self._imu_missing))
        self._imu_missing = missing

    def _report(self) -> Report:
        self._frames.catch_up()  # without odometry, no other call reads /tf
        counts, estimator = self._counts(), self._estimator
        waiting = Counter(stream for stream, _ in self._early)
        if estimator is not None:
            waiting = Counter(dict(zip(STREAMS, estimator.waiting)))
        self._health.behind = self._behind()
        self._health.corrects = self.streams.inputs["uwb/tdoa_corrected"].get_publisher_count() > 0
        self._look_for_imu()
        self._findings = self._stream_findings()
        level, text, values = self._health.report(
            self._anchors.refused, estimator, counts, self._wiring(), self._findings
        )
        alarms: list[str] = estimator.alarms if estimator is not None else []
        refused, unsure = (
            (None, None) if estimator is None else (estimator.refused_pose, estimator.unsure)
        )
        heard = ", ".join(self._lately[:MOST_NAMED])
        frames = [*self._frame_troubles(), *self._unplaced.values(), self._frames.trouble]
        others = [*filter(None, [*frames, self.outputs.trouble, refused, unsure, *alarms])]
        if level == OK and others:
            level, text = WARN, together(others)
        outside: list[str] = self._imu_corrector.outside if estimator is not None else []
        values |= {
            "not to be flown by": self._judge().why or "nothing",
            "yaw": yaw_in_words(self._yaw_std()),
            "frames of imu/data": heard or "none yet",
            "changed since the start": "; ".join(alarms) or "nothing",
            "beyond where effects were seen": "; ".join(outside) or "nothing",
            "TDOAs received": self._health.received["tdoa"],
            **{name: counts[name] for name in VERDICTS.values()},
            "waiting": waiting["tdoa"],
            "IMU samples received": self._health.received["imu"],
            **{name: counts[name] for name in ("imu_used", "imu_late", "imu_invalid")},
            "imu_waiting": waiting["imu"],
            "odometry published": self.outputs.published,
            **{name: counts[name] for name in ("recoveries", "restarts", "yaw_doubts")},
        }
        for stream in SENSORS:
            names = [f"{stream}_{verdict}" for verdict in VERDICTS.values()]
            values |= {
                f"{stream}_received": self._health.received[stream],
                f"{stream}_waiting": waiting[stream],
                **{name: counts[name] for name in names},
            }
        for stream, parameters in self._assumed.items():
            values[f"{stream} deviations of"] = ", ".join(parameters) or "the messages"
        inputs = self.streams.inputs
        values |= {f"lost on {name}": end.lost for name, end in inputs.items()}
        for refusals in (*self.streams.refusals, *self._single):
            values[f"unreadable on {refusals.topic}"] = refusals.count
        for name, end in inputs.items():
            values[f"publishers of {name}"] = end.get_publisher_count()
        odometry, residual = self.outputs.odometry.publisher, self.outputs.residual.publisher
        values["subscribers of odometry"] = odometry.get_subscription_count()
        values["subscribers of uwb/residual"] = residual.get_subscription_count()
        return level, text, values


def main(argv: Sequence[str] | None = None) -> int:
    """Run the node and return the exit code."""
    return run(EkfNode, __doc__.replace("SENSORS", sensors.in_words()), argv)


if __name__ == "__main__":
    sys.exit(main())
