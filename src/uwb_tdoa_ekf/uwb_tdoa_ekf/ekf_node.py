"""ekf_node: inertial samples and corrected TDOAs in, odometry out.

imu/data (sensor_msgs/Imu), uwb/tdoa_corrected (TdoaCorrected), uwb/anchors (AnchorArray), /tf_static; if they are there: height
(sensor_msgs/Range, REP 117), pressure (sensor_msgs/FluidPressure), velocity (geometry_msgs/TwistWithCovarianceStamped, in the
body frame), velocity/odometry (the twist of another nav_msgs/Odometry), initialpose (geometry_msgs/PoseWithCovarianceStamped)
  -> odometry (nav_msgs/Odometry), /tf (tf2_msgs/TFMessage), uwb/residual (TdoaResidual: one for each TdoaCorrected),
     /diagnostics (diagnostic_msgs/DiagnosticArray).
Service ~/reset (std_srvs/Trigger): start anew.
Every parameter is documented in config/ekf_node.yaml.
"""

from collections import Counter, deque
from functools import partial
import math
import sys
import time

from geometry_msgs.msg import PoseWithCovarianceStamped, TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
import numpy as np
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import FluidPressure, Imu, Range
from std_srvs.srv import Trigger
from uwb_tdoa_bias.effects import AidCorrector, EffectSet, ImuCorrector
from uwb_tdoa_bias.foundation import ros
from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flyable import FlyableVolume
from uwb_tdoa_bias.foundation.ros_anchors import AnchorsInput
from uwb_tdoa_bias.foundation.ros_frames import FramesInput, unknown_frame
from uwb_tdoa_bias.foundation.ros_parameters import refuse_unknown, say_unused
from uwb_tdoa_msgs.msg import TdoaCorrected

from .core import aids
from .core.config import RENAMED
from .core.verdicts import INVALID
from .ekf_parameters import ODOM, declare_parameters, follow_changes
from .estimator import STREAMS, VERDICTS, Estimator
from .frames import to_odometry
from .imu_mount import ImuMount
from .monitoring.health import OK, WARN, Health
from .monitoring.stream_watch import FEW_ANCHORS, StreamWatch
from .outputs import Outputs
from .told_pose import told_pose

EARLY = 5000  # messages kept while there are no anchors
UNKNOWN_VARIANCE = 1e6  # (m/s)^2, at which and above a velocity is not measured


class EkfNode(Node):
    """Converts messages for an Estimator and publishes what it says. The filter is all in there."""

    NAME = "ekf_node"

    def __init__(self, files=()):
        """files : parameter files that were given, to say which do not match."""
        super().__init__(self.NAME)
        self._config, own = declare_parameters(self)
        self._reorder, self._lag, self._world, self._body = (
            own[name] for name in ("reorder", "lag", "world_frame", "body_frame")
        )
        if not self._reorder < self._lag:
            raise InputError(f"reorder, lag: {self._reorder!r}, {self._lag!r} must be seconds with 0 <= reorder < lag.")
        volume, effects_file = own["flyable_volume"], own["effects_file"]
        self._effects = EffectSet.from_yaml(effects_file) if effects_file else EffectSet()
        self._aid_corrector = AidCorrector(self._effects.effects)
        self._invalid = {  # how a message counts that none has received
            self._take_imu: "imu_invalid", self._take_tdoa: "invalid", self._take_height: "height_invalid",
            self._take_pressure: "pressure_invalid", self._take_velocity: "velocity_invalid",
        }  # fmt: skip
        self._estimator = None
        self._epoch, self._clock = ros.Epoch(), self.get_clock()
        self._received_before = {}  # messages by topic, by the last report
        self._early = deque()
        self._past = Counter()  # accounts of estimators that were replaced, and of messages that none received
        self._imu_frame, self._imu_mount, self._frame_trouble = own["body_frame"], None, None
        self._health = Health(self._config, self._lag, FlyableVolume.load(volume) if volume else None)
        refuse_unknown(self, RENAMED)
        self.get_logger().info("loading the filter; the first time it is compiled, which takes a minute")
        _warm_up(self._config)
        moving = own["publish_tf"] == ODOM
        self._frames = FramesInput(self, self._epoch.seconds, self._on_frames, moving)
        self._outputs = Outputs(self, self._epoch, self._frames.frames, self._body, own["publish_tf"], own["odom_frame"])
        self._anchors = AnchorsInput(self, self._on_anchors, own["anchors_file"])
        self._inputs = self._subscribe()
        self.create_subscription(PoseWithCovarianceStamped, "initialpose", self._on_pose, 10)
        self._reset = self.create_service(Trigger, "~/reset", self._on_reset)
        follow_changes(self, lambda: self._config, self._on_config)
        say_unused(self, files)
        self._diagnostics = ros.Diagnostics(self, self._report)
        self._anchors.start()
        self.get_logger().info("ready")

    def _subscribe(self):
        """{topic: subscription} of all streams."""
        inputs = {
            "imu/data": ros.StreamInput(self, Imu, "imu/data", self._on_imu),
            "uwb/tdoa_corrected": ros.StreamInput(self, TdoaCorrected, "uwb/tdoa_corrected", self._on_tdoa),
        }
        topics = {  # of each aid: topic, type, what takes its messages
            "height": [("height", Range, self._take_height)],
            "pressure": [("pressure", FluidPressure, self._take_pressure)],
            "velocity": [
                ("velocity", TwistWithCovarianceStamped, self._take_velocity),
                ("velocity/odometry", Odometry, self._take_velocity),
            ],
        }
        for aid in aids.STREAMS:
            for topic, kind, take in topics[aid] if getattr(self._config, f"use_{aid}") else ():
                inputs[topic] = ros.StreamInput(self, kind, topic, partial(self._on_aid, aid, take))
        return inputs

    def _on_anchors(self, anchors):
        if self._estimator is not None:
            self._publish(*self._estimator.finish())
            self._past.update(self._estimator.counts, restarts=1, recoveries=self._estimator.recoveries)
        self._estimator = Estimator(anchors, self._config, self._reorder, self._lag)
        self._imu_corrector = ImuCorrector(self._effects.effects)
        ignored = [FEW_ANCHORS] if self._config.fixed_height_std > 0.0 else []
        self._watch, self._restarts = StreamWatch(anchors, self._lag, ignored), 0
        self._outputs.set_world(self._world or anchors.frame)
        early, self._early = self._early, deque()
        for take, message in early:
            take(message)
        self._publish(*self._estimator.advance())

    def _on_config(self, config):
        self._config = config
        if self._estimator is not None:
            self._estimator.retune(config)

    def _on_reset(self, _, response):
        response.success = self._estimator is not None
        response.message = "starting over" if response.success else "there are no anchors yet: nothing has started"
        if response.success:
            self._start_over()
        return response

    def _start_over(self):
        self._publish(*self._estimator.reset())
        self._watch.restart()

    def _on_pose(self, message):
        try:
            if self._estimator is None:
                raise InputError("there are no anchors yet; give the pose again when there are.")
            self._estimator.tell_pose(*told_pose(message, self._outputs.world, self._epoch, self._estimator.newest))
        except InputError as error:
            self.get_logger().warning(f"initialpose: not taken: {error}")

    def _on_frames(self):
        """A constant transform is new, or another."""
        if self._imu_frame == self._body:
            return
        before = self._frame_trouble, self._imu_mount
        self._place_imu(self._imu_frame)
        if before != (self._frame_trouble, self._imu_mount) and self._estimator is not None:
            self.get_logger().warning(f"the transform of '{self._imu_frame}' is new: starting over")
            self._start_over()

    def _place_imu(self, frame):
        """Find out how an IMU of this frame sits on the body."""
        self._imu_frame, self._imu_mount, self._frame_trouble = frame, None, None
        if frame in ("", self._body):
            return
        between = self._frames.frames.between(self._body, frame)
        if between is None:
            self._frame_trouble = unknown_frame("imu/data", frame, self._body)
            self.get_logger().warning(self._frame_trouble)
        else:
            self._imu_mount = ImuMount(*between)

    def _on_imu(self, message):
        self._health.imu += 1
        self._receive(self._take_imu, message)

    def _on_tdoa(self, message):
        self._health.tdoa += 1
        self._receive(self._take_tdoa, message)

    def _on_aid(self, aid, take, message):
        self._health.aids[aid] += 1
        self._receive(take, message)

    def _receive(self, take, message):
        if self._estimator is not None:
            take(message)
            self._publish(*self._estimator.advance())
            return
        self._early.append((take, message))
        if len(self._early) > EARLY:
            take, message = self._early.popleft()
            self._past[self._invalid[take]] += 1
            if take == self._take_tdoa:
                t = self._epoch.seconds(message.header.stamp)
                a, b = message.anchor_a, message.anchor_b
                self._outputs.publish_residual(t, a, b, math.nan, math.nan, 0.0, INVALID)

    def _take_imu(self, message):
        t = self._epoch.seconds(message.header.stamp)
        if message.header.frame_id != self._imu_frame:
            self._place_imu(message.header.frame_id)
        rate, force = message.angular_velocity, message.linear_acceleration  # the specific force, says REP 145
        gyro, accel = (rate.x, rate.y, rate.z), (force.x, force.y, force.z)
        if message.angular_velocity_covariance[0] == -1.0 or message.linear_acceleration_covariance[0] == -1.0:
            self.get_logger().warning(
                "imu/data says with a covariance of -1 that it has no angular velocity or no acceleration: such "
                "samples are not used; without a whole IMU set use_imu to false",
                once=True,
            )
            gyro = (math.nan,) * 3
        if not self._imu_corrector.idle:
            gyro, accel = (x[0].tolist() for x in self._imu_corrector.correct(*map(np.array, ([t], [gyro], [accel]))))
        if self._imu_mount is not None:
            gyro, accel = self._imu_mount.in_body(t, gyro, accel)
        self._watch.add_imu(t + self._epoch.begin, self._now(), gyro, accel)
        self._estimator.add_imu(t, gyro, accel)

    def _take_tdoa(self, message):
        t = self._epoch.seconds(message.header.stamp)
        self._watch.add_tdoa(t + self._epoch.begin, self._now(), message.anchor_a, message.anchor_b, message.raw)
        variance = message.bias_std**2 + message.variance
        self._estimator.add_tdoa(t, message.anchor_a, message.anchor_b, message.corrected, variance)

    def _take_height(self, message):
        distance = message.range
        if not message.min_range <= distance <= message.max_range:  # out of range, says REP 117
            distance = math.inf
        self._estimator.add_height(*self._corrected("height", message.header.stamp, distance))

    def _take_pressure(self, message):
        self._estimator.add_pressure(*self._corrected("pressure", message.header.stamp, message.fluid_pressure))

    def _take_velocity(self, message):
        v, covariance = message.twist.twist.linear, message.twist.covariance
        variance = [float(covariance[place]) for place in (0, 7, 14)]
        std = [math.sqrt(x) if 0.0 <= x < UNKNOWN_VARIANCE else math.inf for x in variance]
        self._estimator.add_velocity(*self._corrected("velocity", message.header.stamp, (v.x, v.y, v.z), std))

    def _corrected(self, stream, stamp, *values):
        """Stamp, s, and values of a height, pressure or velocity without the effects."""
        columns = (self._epoch.seconds(stamp), *values)
        if self._aid_corrector.idle:
            return columns
        corrected = self._aid_corrector.correct(stream, *(np.array([column]) for column in columns))
        return [column[0].tolist() for column in corrected]

    def _publish(self, odometry, residuals):
        if len(odometry.t):
            # the variance is that of the mean over one odometry interval
            variance = self._config.gyro_noise**2 * self._config.odometry_rate
            self._outputs.publish_odometry(odometry, self._estimator.rates_at(odometry.t) - odometry.gyro_bias, variance)
            self._health.last_odometry = time.monotonic()
            self._health.last_position = odometry.p[-1], odometry.covariance[-1, :3, :3]
        if len(residuals.t):
            self._outputs.publish_residuals(residuals)

    def _now(self):
        """s on the clock of the node, NaN while it has none."""
        if not self._clock.ros_time_is_active:
            return time.time()
        return 1e-9 * self._clock.now().nanoseconds or math.nan

    def _stream_findings(self):
        """What the rules over streams find; [] without anchors."""
        if self._estimator is None:
            return []
        restarts, self._restarts = self._restarts, self._estimator.counts["restarts"]
        if self._restarts != restarts:
            self._watch.restart()
        return self._watch.findings()

    def _wiring(self):
        """What is wrong with who publishes what to whom, a list of sentences."""
        received = {"imu/data": self._health.imu, "uwb/tdoa_corrected": self._health.tdoa, **self._health.aids}
        troubles = []
        for topic, end in self._inputs.items():
            total = received.get(topic, 0)
            troubles.append(end.trouble(total - self._received_before.get(topic, 0)))
        self._received_before = received
        return [*filter(None, [*troubles, ros.several_publishers(self, "odometry")])]

    def _behind(self):
        """s from the stamp of the newest odometry to now, by the clock of the node; None without odometry."""
        if not self._outputs.published:
            return None
        return 1e-9 * (self.get_clock().now().nanoseconds - Time.from_msg(self._outputs.stamp).nanoseconds)

    def _report(self):
        counts, estimator = Counter(self._past), self._estimator
        early = Counter(self._invalid[take].rpartition("_")[0] for take, _ in self._early)
        waiting = {stream: early["" if stream == "tdoa" else stream] for stream in STREAMS}
        if estimator is not None:
            counts.update(estimator.counts, recoveries=estimator.recoveries)
            waiting = dict(zip(STREAMS, estimator.waiting))
        self._health.behind = self._behind()
        troubles = self._wiring(), self._stream_findings()
        level, text, values = self._health.report(self._anchors.refused, estimator, counts, *troubles)
        alarms = estimator.alarms if estimator is not None else []
        others = [*filter(None, [self._frame_trouble, self._outputs.trouble, *alarms])]
        if level == OK and others:
            level, text = WARN, others[0]
        values |= {"changed since the start": "; ".join(alarms) or "nothing"}
        values |= {"TDOAs received": self._health.tdoa} | {name: counts[name] for name in VERDICTS.values()}
        values |= {"waiting": waiting["tdoa"], "IMU samples received": self._health.imu}
        values |= {name: counts[name] for name in ("imu_used", "imu_late", "imu_invalid")}
        values |= {"imu_waiting": waiting["imu"], "odometry published": self._outputs.published}
        values |= {name: counts[name] for name in ("recoveries", "restarts")}
        for aid, received in self._health.aids.items():
            values |= {f"{aid}_received": received, f"{aid}_waiting": waiting[aid]}
            values |= {f"{aid}_{verdict}": counts[f"{aid}_{verdict}"] for verdict in VERDICTS.values()}
        values |= {f"lost on {name}": end.lost for name, end in self._inputs.items()}
        values |= {f"publishers of {name}": end.get_publisher_count() for name, end in self._inputs.items()}
        values |= {"subscribers of odometry": self._outputs.odometry.get_subscription_count()}
        values |= {"subscribers of uwb/residual": self._outputs.residual.get_subscription_count()}
        return level, text, values


def _warm_up(config):
    """Compile, or load from numba's cache, what the first messages would."""
    estimator = Estimator(Anchors.from_positions([[0, 0, 0], [5, 0, 1], [0, 5, 2], [5, 5, 0]]), config)
    watch = StreamWatch(estimator.anchors, 0.25)
    for step in range(400):
        watch.add_imu(0.01 * step, 0.01 * step, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))
        watch.add_tdoa(0.01 * step, 0.01 * step, step % 4, (step + 1) % 4, 0.0)
        estimator.add_imu(0.01 * step, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))
        estimator.add_tdoa(0.01 * step, step % 4, (step + 1) % 4, 0.0)
        estimator.add_height(0.01 * step, 1.0)
        estimator.add_pressure(0.01 * step, 1e5)
        estimator.add_velocity(0.01 * step, (0.0, 0.0, 0.0), (0.1, 0.1, 0.1))
        odometry, _ = estimator.advance()
    to_odometry(odometry.q, odometry.v, odometry.covariance)
    watch.findings()
    estimator.tell_pose(4.0, (1.0, 1.0, 1.0), np.eye(3), 0.0, 0.1)
    estimator.finish()


def main(argv=None):
    """Run the node; returns the exit code."""
    return ros.run(EkfNode, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
