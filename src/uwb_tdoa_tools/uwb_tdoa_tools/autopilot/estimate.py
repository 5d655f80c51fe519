# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""One estimate of the filter, in the frames of ROS and in those of MAVLink.

ROS (REP 103, nav_msgs/Odometry): the world has z up, the body is forward, left, up (FLU). The
velocity is in the body frame. The covariance of the attitude is that of small rotations about the
axes of the world.

MAVLink (ODOMETRY): the world has z down, the body is forward, right, down (FRD). Everything is
turned by one constant rotation on each side, so a Mahalanobis distance is equal in both.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.sensors.sensor import UNKNOWN_VARIANCE

FRD, NED = "frd", "ned"
WORLDS = (FRD, NED)
# World of ROS to that of MAVLink. FRD keeps the x axis of the world. NED takes x as east.
_WORLD = {
    FRD: np.diag([1.0, -1.0, -1.0]),
    NED: np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
}
_BODY = _WORLD[FRD]  # FLU to FRD
UPPER = np.triu_indices(6)
LOWEST_QUALITY, BEST_QUALITY = 1, 100  # %, of an estimate that can be used


@dataclass(frozen=True)
class Estimate:
    """Pose and velocity at one stamp.

    Attributes
    ----------
    stamp : int
        ns since 1970.
    p : (3,) array
        Position in the world, in m.
    q : (4,) array
        Quaternion x y z w, body to world.
    v, w : (3,) arrays
        Velocity, in m/s, and angular velocity, in rad/s, in the body frame; w is NaN if unknown.
    pose_covariance : (6, 6) array
        Of [position, rotation about the axes of the world], in m and rad.
    twist_covariance : (6, 6) array
        Of [v, w].
    """

    stamp: int
    p: np.ndarray
    q: np.ndarray
    v: np.ndarray
    w: np.ndarray
    pose_covariance: np.ndarray
    twist_covariance: np.ndarray

    @classmethod
    def from_numbers(cls, stamp: int, pose: np.ndarray, twist: np.ndarray) -> Estimate | None:
        """Return the Estimate of the numbers of a nav_msgs/Odometry; None if they are not one.

        Parameters
        ----------
        stamp : int
            ns since 1970.
        pose : (43,) array
            Position, quaternion x y z w, covariance by rows.
        twist : (42,) array
            Velocity, angular velocity, covariance by rows.
        """
        length = math.sqrt(float(pose[3:7] @ pose[3:7]))
        if not (np.isfinite(pose).all() and np.isfinite(twist).all() and length > 0.5):
            return None
        pose_covariance, twist_covariance = pose[7:].reshape(6, 6), twist[6:].reshape(6, 6)
        if min(pose_covariance.diagonal().min(), twist_covariance.diagonal().min()) < 0.0:
            return None
        known = twist_covariance.diagonal()[3:] < UNKNOWN_VARIANCE
        w = np.where(known, twist[3:6], math.nan)
        return cls(
            stamp, pose[:3], pose[3:7] / length, twist[:3], w, pose_covariance, twist_covariance
        )

    @property
    def deviation(self) -> float:
        """Return the largest standard deviation of a coordinate, in m."""
        return math.sqrt(self.pose_covariance.diagonal()[:3].max())

    @property
    def attitude_deviation(self) -> float:
        """Return the largest standard deviation of a rotation, in rad."""
        return math.sqrt(self.pose_covariance.diagonal()[3:].max())

    @property
    def quality(self) -> int:
        """Return 100 less the deviation in cm, and at least 1: as MAVLink counts, in percent."""
        return max(LOWEST_QUALITY, BEST_QUALITY - round(100.0 * self.deviation))

    def in_mavlink(self, world_frame: str, hall_yaw: float = 0.0) -> Estimate:
        """Return the Estimate in the frames of MAVLink.

        Parameters
        ----------
        world_frame : str
            FRD: x stays the x axis of the anchors' frame. NED: x is north.
        hall_yaw : float
            For NED: angle of the x axis of the anchors' frame from east, counterclockwise, in rad.
        """
        turn = _WORLD[world_frame]
        if world_frame == NED:
            turn = turn @ Rotation.from_euler("z", hall_yaw).as_matrix()
        attitude = turn @ Rotation.from_quat(self.q).as_matrix() @ _BODY
        q = Rotation.from_matrix(attitude).as_quat()
        return replace(
            self,
            p=turn @ self.p,
            q=-q if q[3] < 0.0 else q,
            v=_BODY @ self.v,
            w=_BODY @ self.w,
            pose_covariance=_turned(turn, self.pose_covariance),
            twist_covariance=_turned(_BODY, self.twist_covariance),
        )


def _turned(turn: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Return the (6, 6) covariance of two vectors that are both turned by a (3, 3) matrix."""
    both = np.zeros((6, 6))
    both[:3, :3] = both[3:, 3:] = turn
    return both @ covariance @ both.T


def missing(protocol: str, error: ImportError, package: str) -> InputError:
    """Return the error of a protocol that needs a package which cannot be imported."""
    name = (error.name or package).partition(".")[0]
    return InputError(
        f"protocol: {protocol} needs the Python package {name}; install it with "
        f"`pip install {package}`."
    )


class Link:
    """A link to an autopilot. This one leads to nobody: odometry goes out on a topic alone."""

    def send(self, estimate: Estimate, resets: int) -> None:
        """Send an estimate, which is in the frames of ROS.

        Parameters
        ----------
        estimate : Estimate
            What the autopilot is to use.
        resets : int
            Number of jumps so far (Gate.resets).
        """

    def say(self, text: str) -> None:
        """Tell the autopilot why nothing is sent, or "" if it is; called once a second."""

    def turn(self) -> None:
        """Take what came from the autopilot, and answer it; called many times per second."""

    def report(self) -> tuple[str, dict[str, Any]]:
        """Return (sentence on what is wrong with the link or "", {key: value} for /diagnostics)."""
        return "", {}

    def close(self) -> None:
        """End the link."""


# Decide which estimates an autopilot gets, and when it must accept a jump.
#
# An autopilot fuses whatever arrives: PX4 ignores the quality unless EKF2_EV_QMIN is set. So an
# estimate that may not be flown by is not sent at all.


RUNNING = 2  # EstimatorStatus.STATUS_RUNNING
# s before the clock that a stamp may be: PX4 drops what is older than EKF2_DELAY_MAX, 0.2 s
OLDEST, EARLIEST = 0.2, -0.1
BREAK = 0.4  # s without an estimate after which PX4 stops and starts its fusion anew
SLACK = 0.1  # share of a period by which a stamp may be early
# Change of position, velocity and attitude from one estimate to the next, besides motion, that an
# autopilot must not take for motion. Three steps of 15 measured flights exceed it, all near the end of a flight.
JUMP = np.array([0.3, 0.75, 0.2])  # m, m/s, rad
# m/s^2, rad/s: motion between two estimates that the earlier one does not predict
ACCELERATION, TURN_RATE = 20.0, 10.0
CROWD = "two or more nodes publish odometry or status: stop all but one ekf_node in this namespace"
NOT_HEARD = "nothing came on status: start ekf_node in this namespace"


class Gate:
    """Pass estimates on while the filter may be flown by.

    Attributes
    ----------
    why : str
        Reason why the last estimate was not passed; "" if it was, or was one too many for the rate.
    resets : int
        Number of jumps and silences that an autopilot must not take for motion.
    passed : int
        Number of estimates that were passed.
    publishers : int
        Number of publishers of odometry, or of status if it has more. With two, estimates of
        different filters would alternate.
    """

    def __init__(self, rate: float, largest_deviation: float, needs_yaw: bool = True) -> None:
        """Wait for a status.

        Parameters
        ----------
        rate : float
            Most estimates per second of their stamps.
        largest_deviation : float
            Largest standard deviation of a coordinate, in m.
        needs_yaw : bool
            Whether the yaw is sent, and so must be known.
        """
        self.why, self.resets, self.passed, self.publishers = NOT_HEARD, 0, 0, 1
        self._period, self._largest, self._needs_yaw = 1e9 / rate, largest_deviation, needs_yaw
        self._closed = NOT_HEARD
        self._before: Estimate | None = None
        self._due = -math.inf  # ns, stamp of the next estimate
        self._silent = False  # True from an estimate that was held back to the next that passes

    def set_status(self, status: int, yaw_known: bool, why: str) -> None:
        """Take the status of the filter: one of EstimatorStatus, and its reason."""
        self._closed = ""
        if status != RUNNING:
            self._closed = why or "the filter is not running"
        elif self._needs_yaw and not yaw_known:
            self._closed = why or "the yaw is not known"

    def admit(self, estimate: Estimate, now: int) -> bool:
        """Return whether an estimate is to be sent.

        Parameters
        ----------
        estimate : Estimate
            The next one, in the frames of ROS.
        now : int
            Time of the clock, in ns since 1970.
        """
        before, self._before = self._before, estimate
        self.why = self._closed or self._fault(estimate, now)
        if self.why:
            self._silent = True
            return False
        if before is not None and (self._silent or jumped(before, estimate)):
            self.resets += bool(self.passed)
            self._due = -math.inf
        self._silent = False
        if estimate.stamp < self._due - SLACK * self._period:
            return False
        late = estimate.stamp >= self._due + self._period
        self._due = (estimate.stamp if late else self._due) + self._period
        self.passed += 1
        return True

    def _fault(self, estimate: Estimate, now: int) -> str:
        """Return why an estimate cannot be used, or ""."""
        if self.publishers > 1:
            return CROWD
        age = 1e-9 * (now - estimate.stamp)
        if not EARLIEST < age < OLDEST:
            return (
                f"odometry is stamped {abs(age):.1f} s {'before' if age > 0.0 else 'after'} the clock "
                "of this node: set the clocks alike, use_sim_time for a recording, or shorten the delay"
            )
        if estimate.deviation > self._largest:
            return (
                f"the position has a deviation of {estimate.deviation:.1f} m, above "
                f"largest_deviation ({self._largest:g} m): see status"
            )
        return ""


def jumped(before: Estimate, after: Estimate) -> bool:
    """Return whether an estimate is elsewhere than motion explains.

    A restart, a recovery and a pose that was set do that, and the first TDOA after a silence may.
    """
    return bool((changes(before, after) > JUMP).any())


def changes(before: Estimate, after: Estimate) -> np.ndarray:
    """Return the changes of position, m, velocity, m/s, and attitude, rad, besides motion; (3,).

    They are inf after a gap, or if the stamps fall back.
    """
    dt = 1e-9 * (after.stamp - before.stamp)
    if not 0.0 <= dt < BREAK:
        return np.full(3, math.inf)
    turn = Rotation.from_quat(before.q).as_matrix()
    moved = after.p - before.p - turn @ before.v * dt
    faster = Rotation.from_quat(after.q).as_matrix() @ after.v - turn @ before.v
    turned = 2.0 * math.acos(min(1.0, abs(float(before.q @ after.q))))
    sizes = np.array([*(math.sqrt(float(change @ change)) for change in (moved, faster)), turned])
    motion = np.array([ACCELERATION * dt * dt, ACCELERATION * dt, TURN_RATE * dt])
    return np.maximum(sizes - motion, 0.0)
