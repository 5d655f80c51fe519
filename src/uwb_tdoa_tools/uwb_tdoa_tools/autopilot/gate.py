# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Decide which estimates an autopilot gets, and when it must accept a jump.

An autopilot fuses whatever arrives: PX4 ignores the quality unless EKF2_EV_QMIN is set. So an
estimate that may not be flown by is not sent at all.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from .estimate import Estimate

RUNNING = 2  # EstimatorStatus.STATUS_RUNNING
OLDEST, EARLIEST = 0.5, -0.1  # s before the clock that a stamp may be
BREAK = 0.4  # s without an estimate after which PX4 stops and starts its fusion anew
SLACK = 0.1  # share of a period by which a stamp may be early
# Change of position, velocity and attitude from one estimate to the next, besides motion, that an
# autopilot must not take for motion. Three steps of 15 measured flights exceed it, all near the end of a flight.
JUMP = np.array([0.3, 0.75, 0.2])  # m, m/s, rad
# m/s^2, rad/s: motion between two estimates that the earlier one does not predict
ACCELERATION, TURN_RATE = 20.0, 10.0
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
        self.why, self.resets, self.passed = NOT_HEARD, 0, 0
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
        age = 1e-9 * (now - estimate.stamp)
        if not EARLIEST < age < OLDEST:
            return (
                f"odometry is stamped {abs(age):.1f} s {'before' if age > 0.0 else 'after'} the clock "
                "of this node: set the clocks alike, or use_sim_time for a recording"
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
