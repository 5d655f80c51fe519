"""ekf_node: inertial samples and corrected TDOAs in, odometry out.

imu/data (sensor_msgs/Imu), uwb/tdoa_corrected (TdoaCorrected), uwb/anchors (AnchorArray); if they are there: height
(sensor_msgs/Range, REP 117), pressure (sensor_msgs/FluidPressure), velocity (geometry_msgs/TwistWithCovarianceStamped, in the
body frame), velocity/odometry (the twist of another nav_msgs/Odometry)
  -> odometry (nav_msgs/Odometry), /tf (tf2_msgs/TFMessage), uwb/residual (TdoaResidual: one for each TdoaCorrected),
     /diagnostics (diagnostic_msgs/DiagnosticArray).
Every parameter is documented in config/ekf_node.yaml.
"""

from collections import Counter, deque
from dataclasses import fields
from functools import partial
import math
import sys
import time

from geometry_msgs.msg import TransformStamped, TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
import numpy as np
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rclpy.time import Time
from sensor_msgs.msg import FluidPressure, Imu, Range
from tf2_msgs.msg import TFMessage
from uwb_tdoa_bias.foundation import ros
from uwb_tdoa_bias.foundation.anchors import Anchors
from uwb_tdoa_bias.effects import AidCorrector, EffectSet, ImuCorrector
from uwb_tdoa_bias.foundation.errors import InputError
from uwb_tdoa_bias.foundation.flyable import FlyableVolume
from uwb_tdoa_msgs.msg import TdoaCorrected, TdoaResidual

from .core import aids
from .core.config import RENAMED, FilterConfig, current_names
from .core.verdicts import INVALID
from .estimator import STREAMS, VERDICTS, Estimator
from .frames import to_odometry
from .monitoring.health import OK, WARN, Health
from .monitoring.monitor import Monitor

PARAMETERS = {  # beside those of FilterConfig: default and meaning, as in config/ekf_node.yaml
    "world_frame": ("", 'frame of the odometry and the parent on /tf; "" for the frame of uwb/anchors'),
    "body_frame": (
        "base_link", "frame of tag and IMU, whose axes must agree with it: the child on /tf; one per tag"
    ),
    "publish_tf": (True, "world -> body on /tf"),
    "flyable_volume": (
        "", 'flyable.npz of plan; a warning on /diagnostics while the tag is outside; "" for none'
    ),
    "effects_file": (
        "", "effects.yaml, the same as bias_node's: what it says of gyroscope, accelerometer, height and velocity is taken out"
    ),
    "reorder": (0.003, "s of stamps; how long a TDOA waits for older ones that are still on their way"),
    "lag": (0.25, "s of stamps; how long a silent stream is waited for; what comes later than that is late"),
}  # fmt: skip
EARLY = 5000  # messages kept while there are no anchors
UNKNOWN_VARIANCE = 1e6  # (m/s)^2, at which and above a velocity is not measured
UNKNOWN_RATE = 1e6  # (rad/s)^2, variance of an angular velocity that nothing measured


class EkfNode(Node):
    """Converts messages for an Estimator and publishes what it says. The filter is all in there."""

    NAME = "ekf_node"

    def __init__(self):
        super().__init__(self.NAME)
        self._config = _declare_filter_config(self)
        others = {name: ros.parameter(self, name, value, text) for name, (value, text) in PARAMETERS.items()}
        self._reorder, self._lag, self._world = (others[name] for name in ("reorder", "lag", "world_frame"))
        volume, effects_file = others["flyable_volume"], others["effects_file"]
        self._effects = EffectSet.from_yaml(effects_file) if effects_file else EffectSet()
        self._aid_corrector = AidCorrector(self._effects.effects)
        if not 0.0 <= self._reorder < self._lag < math.inf:
            raise InputError(f"reorder, lag: {self._reorder!r}, {self._lag!r} must be seconds with 0 <= reorder < lag.")
        self.get_logger().info("loading the filter; the first time it is compiled, which takes a minute")
        _warm_up(self._config)

        self._invalid = {  # how a message counts that none has received
            self._take_imu: "imu_invalid", self._take_tdoa: "invalid", self._take_height: "height_invalid",
            self._take_pressure: "pressure_invalid", self._take_velocity: "velocity_invalid",
        }  # fmt: skip
        self._estimator = None
        self._epoch = ros.Epoch()
        self._early = deque()
        self._past = Counter()  # accounts of estimators that were replaced, and of messages that none received
        self._health = Health(self._config, self._lag, FlyableVolume.load(volume) if volume else None)
        # One message object each, for all: what is published is copied.
        self._odometry = Odometry(child_frame_id=others["body_frame"])
        self._transform = TransformStamped(child_frame_id=others["body_frame"])
        self._tf, self._residual = TFMessage(transforms=[self._transform]), TdoaResidual()

        self._odometry_publisher = ros.publish_stream(self, Odometry, "odometry")
        self._residual_publisher = ros.publish_stream(self, TdoaResidual, "uwb/residual")
        self._tf_publisher = self.create_publisher(TFMessage, "/tf", ros.TF_QOS) if others["publish_tf"] else None
        self._anchors = ros.AnchorsInput(self, self._on_anchors)
        self._inputs = {
            "imu/data": ros.subscribe_stream(self, Imu, "imu/data", self._on_imu),
            "uwb/tdoa_corrected": ros.subscribe_stream(self, TdoaCorrected, "uwb/tdoa_corrected", self._on_tdoa),
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
                self._inputs[topic] = ros.subscribe_stream(self, kind, topic, partial(self._on_aid, aid, take))
        self._diagnostics = ros.Diagnostics(self, self._report)
        self.get_logger().info("ready")

    def _on_anchors(self, anchors):
        if self._estimator is not None:
            self._publish(*self._estimator.finish())
            self._past.update(self._estimator.counts, restarts=1, recoveries=self._estimator.recoveries)
        self._estimator = Estimator(anchors, self._config, self._reorder, self._lag)
        self._imu_corrector, self._monitor = ImuCorrector(self._effects.effects), Monitor(anchors)
        world = self._world or anchors.frame
        for message in (self._odometry, self._transform, self._residual):
            message.header.frame_id = world
        early, self._early = self._early, deque()
        for take, message in early:
            take(message)
        self._publish(*self._estimator.advance())

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
                self._publish_residual(t, message.anchor_a, message.anchor_b, math.nan, math.nan, 0.0, INVALID)

    def _take_imu(self, message):
        t = self._epoch.seconds(message.header.stamp)
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
        self._estimator.add_imu(t, gyro, accel)

    def _take_tdoa(self, message):
        t = self._epoch.seconds(message.header.stamp)
        self._estimator.add_tdoa(t, message.anchor_a, message.anchor_b, message.corrected, message.bias_std)

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
            self._publish_odometry(odometry)
            self._monitor.add_odometry(odometry)
        if len(residuals.t):
            self._monitor.add(residuals)
            columns = (
                residuals.t, residuals.a, residuals.b, residuals.innovation, residuals.variance, residuals.weight,
                residuals.verdict,
            )  # fmt: skip
            for row in zip(*(column.tolist() for column in columns)):
                self._publish_residual(*row)

    def _publish_residual(self, t, a, b, innovation, variance, weight, verdict):
        out = self._residual
        out.header.stamp = self._epoch.stamp(t)
        out.anchor_a, out.anchor_b = a, b
        out.innovation, out.innovation_variance = innovation, variance
        out.weight, out.verdict = weight, verdict
        self._residual_publisher.publish(out)

    def _publish_odometry(self, odometry):
        n = len(odometry)
        velocity, covariance = to_odometry(odometry.q, odometry.v, odometry.covariance)
        pose, twist = covariance[:, :6, :6].reshape(n, 36), np.zeros((n, 6, 6))
        twist[:, :3, :3] = covariance[:, 6:, 6:]
        rates = self._estimator.rates_at(odometry.t) - odometry.gyro_bias
        known = np.isfinite(rates[:, 0])
        rate_variance = (
            self._config.gyro_noise**2 * self._config.odometry_rate
        )  # of the mean over one odometry interval
        twist[:, [3, 4, 5], [3, 4, 5]] = np.where(known, rate_variance, UNKNOWN_RATE)[:, None]
        twist = twist.reshape(n, 36)
        out, tf = self._odometry, self._transform.transform
        columns = (odometry.t, odometry.p, odometry.q, velocity, np.where(known[:, None], rates, 0.0))
        for i, (t, p, q, u, rate) in enumerate(zip(*(column.tolist() for column in columns))):
            out.header.stamp = self._transform.header.stamp = self._epoch.stamp(t)
            position, orientation, twist_out = out.pose.pose.position, out.pose.pose.orientation, out.twist.twist
            position.x, position.y, position.z = p
            orientation.x, orientation.y, orientation.z, orientation.w = q
            twist_out.linear.x, twist_out.linear.y, twist_out.linear.z = u
            twist_out.angular.x, twist_out.angular.y, twist_out.angular.z = rate
            out.pose.covariance, out.twist.covariance = pose[i], twist[i]
            self._odometry_publisher.publish(out)
            if self._tf_publisher is not None:
                tf.translation.x, tf.translation.y, tf.translation.z = p
                tf.rotation = orientation
                self._tf_publisher.publish(self._tf)
        self._health.odometry += n
        self._health.last_odometry = time.monotonic()
        self._health.last_position = odometry.p[-1], odometry.covariance[-1, :3, :3]

    def _behind(self):
        """s from the stamp of the newest odometry to now, by the clock of the node; None without odometry."""
        if not self._health.odometry:
            return None
        return 1e-9 * (self.get_clock().now().nanoseconds - Time.from_msg(self._odometry.header.stamp).nanoseconds)

    def _report(self):
        counts, estimator = Counter(self._past), self._estimator
        early = Counter(self._invalid[take].rpartition("_")[0] for take, _ in self._early)
        waiting = {stream: early["" if stream == "tdoa" else stream] for stream in STREAMS}
        if estimator is not None:
            counts.update(estimator.counts, recoveries=estimator.recoveries)
            waiting = dict(zip(STREAMS, estimator.waiting))
        self._health.behind = self._behind()
        level, text, values = self._health.report(self._anchors.refused, estimator, counts)
        alarms = self._monitor.alarms if estimator is not None else []
        if alarms and level == OK:
            level, text = WARN, alarms[0]
        values |= {"changed since the start": "; ".join(alarms) or "nothing"}
        values |= {"TDOAs received": self._health.tdoa} | {name: counts[name] for name in VERDICTS.values()}
        values |= {"waiting": waiting["tdoa"], "IMU samples received": self._health.imu}
        values |= {name: counts[name] for name in ("imu_used", "imu_late", "imu_invalid")}
        values |= {"imu_waiting": waiting["imu"], "odometry published": self._health.odometry}
        values |= {name: counts[name] for name in ("recoveries", "restarts")}
        for aid, received in self._health.aids.items():
            values |= {f"{aid}_received": received, f"{aid}_waiting": waiting[aid]}
            values |= {f"{aid}_{verdict}": counts[f"{aid}_{verdict}"] for verdict in VERDICTS.values()}
        values |= {f"publishers of {name}": end.get_publisher_count() for name, end in self._inputs.items()}
        values |= {"subscribers of odometry": self._odometry_publisher.get_subscription_count()}
        values |= {"subscribers of uwb/residual": self._residual_publisher.get_subscription_count()}
        return level, text, values


def _declare_filter_config(node):
    """Declare every parameter of FilterConfig; what was given under an old name counts, with a warning."""
    old = {name: _value_of_old(node, name) for name in RENAMED}
    given = {name: value for name, value in old.items() if value is not None}
    defaults = {field.name: field.default for field in fields(FilterConfig)}
    defaults |= current_names(given, node.get_logger().warning)
    texts = {field.name: field.metadata["text"] for field in fields(FilterConfig)}
    return FilterConfig(**{name: ros.parameter(node, name, value, texts[name]) for name, value in defaults.items()})


def _value_of_old(node, name):
    """What was given for a parameter that the node does not have any more, or None."""
    value = node.declare_parameter(name, None, ParameterDescriptor(dynamic_typing=True)).value
    node.undeclare_parameter(name)
    return value


def _warm_up(config):
    """Compile, or load from numba's cache, what the first messages would."""
    estimator = Estimator(Anchors.from_positions([[0, 0, 0], [5, 0, 1], [0, 5, 2], [5, 5, 0]]), config)
    for step in range(200):
        estimator.add_imu(0.01 * step, (0.0, 0.0, 0.0), (0.0, 0.0, 9.81))
        estimator.add_tdoa(0.01 * step, step % 4, (step + 1) % 4, 0.0)
        estimator.add_height(0.01 * step, 1.0)
        estimator.add_pressure(0.01 * step, 1e5)
        estimator.add_velocity(0.01 * step, (0.0, 0.0, 0.0), (0.1, 0.1, 0.1))
        odometry, _ = estimator.advance()
    to_odometry(odometry.q, odometry.v, odometry.covariance)


def main(argv=None):
    """Run the node; returns the exit code."""
    return ros.run(EkfNode, __doc__, argv)


if __name__ == "__main__":
    sys.exit(main())
