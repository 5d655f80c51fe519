# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Decide whether a vehicle may fly by the odometry, from the Estimator and from all findings."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
import math

import numpy as np

from uwb_tdoa_bias.common.anchors import Anchors, FlyableVolume
from uwb_tdoa_bias.common.sensors import LOCATING

from ..core.yaw_check import YAW_KNOWN
from ..estimator import Estimator
from ..results import Odometry
from .finding import Finding

SILENT = 1.0  # s without a used measurement before it is reported
WINDOW = 1.5  # s over which shares of TDOAs are computed
# s, the same for rejected TDOAs: 46 % at most in 22 measured flights, some of which land
WINDOW_OF_REJECTED = 4.0
# s after initialization before rejected TDOAs are reported: on the floor, 85 % for 3 s
SETTLED = 5.0
LARGEST_UNUSED = 0.5  # share of TDOAs that are not used for one reason, before it is reported
FEWEST = 10  # fewest TDOAs of a window
# rad and m/s, standard deviations that are added while a fault makes the estimate wrong. That of the
# yaw is more than of a uniform yaw, initialization.ANY_YAW: no user shall rely on a wrong estimate.
FAULT_YAW_STD, FAULT_SPEED_STD = math.pi, 2.0
WAITING, STARTING, RUNNING, LOST, FAULT = range(5)  # values of EstimatorStatus
REASONS = "late", "invalid", "rejected"
USED = (
    "used",
    "compensated",
    *(f"{name}_{verdict}" for name in LOCATING for verdict in ("used", "compensated")),
)


class Use:
    """Track which measurements the filter uses; `update` is called several times per second."""

    def __init__(self, lag: float) -> None:
        """Store the time `lag`, in s, for which the filter waits for a silent stream."""
        self._lag = lag
        # (s, counts) of the last seconds
        self._looks: deque[tuple[float, dict[str, int]]] = deque()
        self._since: dict[
            str, float
        ] = {}  # s, by kind: time of the last look that found more messages
        self._running_since = math.inf  # s
        self._now = -math.inf

    def update(
        self, now: float, received: Mapping[str, int], counts: Mapping[str, int], running: bool
    ) -> None:
        """Store totals at one time.

        Parameters
        ----------
        now : float
            Time, in s.
        received : mapping
            Messages by stream.
        counts : mapping
            Totals by verdict.
        running : bool
            Whether the filter has a position.
        """
        totals = {
            "arrival": received["tdoa"] + sum(received[name] for name in LOCATING),
            "tdoa": sum(counts[name] for name in USED),
            "imu": counts["imu_used"],
            "velocity": counts["velocity_used"],
            "restarts": counts["restarts"],
            "counted": counts["used"] + counts["compensated"],
            **{reason: counts[reason] for reason in REASONS},
        }
        before = self._looks[-1][1] if self._looks else dict.fromkeys(totals, 0)
        self._since |= {
            kind: now
            for kind in ("arrival", "tdoa", "imu", "velocity")
            if totals[kind] > before[kind]
        }
        if not running or totals["restarts"] > before["restarts"]:
            self._running_since = math.inf
        if running and self._running_since == math.inf:
            self._running_since = now
        self._now = now
        self._looks.append((now, totals))
        while len(self._looks) > 2 and self._looks[1][0] <= now - WINDOW_OF_REJECTED:
            self._looks.popleft()

    def age(self, kind: str) -> float:
        """Return the time since a message of a kind was used, or arrived, in s; inf before the first.

        Parameters
        ----------
        kind : str
            "tdoa" (TDOAs and distances), "imu", "velocity"; or "arrival" of TDOAs and distances.
        """
        return self._now - self._since[kind] if kind in self._since else math.inf

    def lately(self, kind: str) -> bool:
        """Return whether a message of a kind was used lately."""
        return self.age(kind) < SILENT

    def _shares(self, window: float) -> dict[str, float]:
        """Return {result: share of the TDOAs, 0 to 1} over the last `window` s; {} for too few."""
        until = self._now - window
        first = next((totals for at, totals in reversed(self._looks) if at <= until), None)
        if first is None:
            return {}
        last = self._looks[-1][1]
        recent = {name: max(last[name] - first[name], 0) for name in ("counted", *REASONS)}
        total = sum(recent.values())
        return {name: count / total for name, count in recent.items()} if total >= FEWEST else {}

    @property
    def contradicted(self) -> bool:
        """Return whether the filter rejects most TDOAs although it has run for a while."""
        settled = self._now - self._running_since > SETTLED
        return settled and self._shares(WINDOW_OF_REJECTED).get("rejected", 0.0) > LARGEST_UNUSED

    @property
    def why_unused(self) -> str | None:
        """Return a sentence on why most TDOAs are not used, or None."""
        shares = self._shares(WINDOW)
        for name in ("late", "invalid"):
            if shares.get(name, 0.0) > LARGEST_UNUSED:
                return self._sentence(name)
        none_used = self.age("tdoa") > SILENT and shares.get("rejected", 0.0) > LARGEST_UNUSED
        return self._sentence("rejected") if none_used or self.contradicted else None

    def _sentence(self, reason: str) -> str:
        reasons = {
            "late": (
                "come too late to be used: if they arrive late or in bursts, raise lag (-p "
                f"lag:=, now {self._lag} s); if they come out of "
                "order, raise reorder; otherwise another stream is stamped ahead"
            ),
            "invalid": (
                "are invalid (not finite, or of ids that uwb/anchors does not list): correct the "
                "driver, or list its anchors"
            ),
            "rejected": "contradict the filter: check the anchors' positions, and tdoa_std",
        }
        return f"more than half of the TDOAs {reasons[reason]}"


def flyability(
    volume: FlyableVolume | None, anchors: Anchors, position: np.ndarray, covariance: np.ndarray
) -> tuple[str | None, dict[str, str]]:
    """Return a sentence on a position that may not be flown, or None, and {key: text}.

    The efficiency is the Cramer-Rao bound of one round of TDOAs divided by the filter's stated 3D
    standard deviation, squared. The filter also uses earlier rounds and the IMU. An efficiency
    of n means the precision of n independent rounds.

    Parameters
    ----------
    volume : FlyableVolume or None
        Volume in which the tag may fly; without one there is nothing to say.
    anchors : Anchors
        Present anchors.
    position : (3,) array
        Position in the world frame, in m.
    covariance : (3, 3) array
        Covariance of the position, in m^2.
    """
    if volume is None:
        return None, {}
    if not volume.belongs_to(anchors):
        trouble = "flyable_volume was made for other anchors: make it anew with plan"
        return trouble, {"flyable": "unknown"}
    flyable = bool(volume.contains(position))
    bound, used = float(volume.bound_at(position)), 2 if volume.planar else 3
    values = {"flyable": "yes" if flyable else "no"}
    if np.isfinite(bound):
        claimed = float(np.sqrt(np.trace(covariance[:used, :used])))
        values |= {
            "bound of one round": f"{bound:.3f} m",
            "claimed by the filter": f"{claimed:.3f} m",
            "efficiency": f"{(bound / max(claimed, 1e-9)) ** 2:.3g}",
        }
    if flyable:
        return None, values
    trouble = (
        "the tag is outside of the flyable volume: its position may be wrong by metres; fly it back"
    )
    return trouble, values


@dataclass(frozen=True)
class Status:
    """Store whether a vehicle may fly by the odometry.

    Attributes
    ----------
    status : int
        WAITING, STARTING, RUNNING, LOST or FAULT.
    yaw_known : bool
        Whether the yaw is known.
    why : str
        Reason against flying by the odometry; "" without one.
    """

    status: int
    yaw_known: bool
    why: str

    @property
    def lost(self) -> bool:
        """Return whether the filter ran and has lost the tag."""
        return self.status == LOST


def yaw_in_words(std: float) -> str:
    """Return a text on a yaw with a standard deviation in rad; NaN means no odometry."""
    if math.isnan(std):
        return "unknown: there is no odometry"
    return f"{'known' if std <= YAW_KNOWN else 'not known yet'}: +-{math.degrees(std):.0f} degrees"


def fault_of(findings: Sequence[Finding], use: Use, left_out: Finding | None) -> Finding | None:
    """Return the most severe Finding that makes the position wrong, or None.

    Parameters
    ----------
    findings : sequence of Finding
        The most severe first.
    use : Use
        Measurements that the filter uses.
    left_out : Finding or None
        Reason why the filter ignores the IMU.
    """
    imu_used = use.lately("imu") and left_out is None
    return next((finding for finding in findings if finding.position_wrong(imu_used)), None)


def status_of(
    estimator: Estimator | None,
    yaw_std: float,
    odometry_age: float,
    use: Use,
    findings: Sequence[Finding] = (),
    refused_anchors: str | None = None,
    off_the_clock: str | None = None,
) -> Status:
    """Return the Status of an Estimator.

    Parameters
    ----------
    estimator : Estimator or None
        None before the anchors arrive.
    yaw_std : float
        Standard deviation of the yaw, in rad; NaN without odometry.
    odometry_age : float
        Time since the last odometry, in s.
    use : Use
        Measurements that the filter uses.
    findings : sequence of Finding
        Findings that hold now, the most severe first.
    refused_anchors : str or None
        Reason why the last anchors were refused.
    off_the_clock : str or None
        Sentence on the age of the odometry by its stamp.
    """
    if estimator is None:
        missing = "there are no anchors yet: publish them on uwb/anchors, or set anchors_file"
        why = f"the anchors are refused: {refused_anchors}" if refused_anchors else missing
        return Status(WAITING, False, why)
    if estimator.lost:
        return Status(LOST, False, estimator.lost)
    left_out = estimator.without_imu
    fault = fault_of(findings, use, left_out)
    if not estimator.running:
        if fault is not None:
            return Status(FAULT, False, fault.sentence)
        if use.age("arrival") > SILENT:
            return Status(WAITING, False, "there are no TDOAs: see /diagnostics")
        restarted = estimator.restarted
        return Status(
            STARTING,
            False,
            use.why_unused
            or (restarted.sentence if restarted else "the start position is looked for"),
        )
    yaw_known = bool(yaw_std <= YAW_KNOWN)  # a message takes no other type for true
    if fault is not None:
        return Status(FAULT, False, fault.sentence)
    if odometry_age > SILENT:
        why = "neither TDOAs nor inertial samples are used: there is no odometry; see /diagnostics"
        return Status(WAITING, False, why)
    why = off_the_clock or _reason_against_flying(estimator, use, yaw_known, findings)
    return Status(RUNNING, yaw_known, why)


def _reason_against_flying(
    estimator: Estimator, use: Use, yaw_known: bool, findings: Sequence[Finding]
) -> str:
    """Return why a vehicle must not fly by this filter, which has no fault; "" if it may."""
    imu_fault = estimator.without_imu  # Finding for which the IMU is left out, or None
    if estimator.unsure:
        return estimator.unsure
    if use.age("tdoa") > SILENT:
        trouble = use.why_unused or f"no TDOA was used for more than {SILENT:g} s"
        sources = [
            *(["the IMU"] if use.lately("imu") and imu_fault is None else []),
            *(["the velocities"] if use.lately("velocity") else []),
        ]
        motion = (
            f"by {' and '.join(sources)} alone"
            if sources
            else "on as the tag moved last, without the IMU and without velocities,"
        )
        return f"{trouble}: the position goes {motion} and drifts"
    if use.why_unused:
        return use.why_unused
    if not yaw_known and imu_fault is not None:
        return (
            f"the yaw is not known, because the filter goes without the IMU: {imu_fault.sentence}"
        )
    if not yaw_known and estimator.yaw_doubts:
        return (
            "the yaw was wrong, and is looked for again: do not steer by it; it is known once the "
            "tag has moved"
        )
    if not yaw_known and not (use.lately("imu") or use.lately("velocity")):
        return (
            "the yaw is not known, because neither an IMU nor velocities are used: do not steer "
            "by it; give imu/data, or odometry of wheels"
        )
    if not yaw_known:
        return (
            "the yaw is not known yet: do not steer by it; it is once the tag has moved, or if it "
            "is told (initialpose)"
        )
    return findings[0].sentence if findings and findings[0].severity == "error" else ""


def with_fault_covariance(odometry: Odometry, size: np.ndarray) -> Odometry:
    """Return Odometry with a covariance for a tag anywhere in its workspace, moving, with any yaw.

    The standard deviation of each coordinate grows by the full size of the workspace, more than
    that of a uniform position. FAULT_SPEED_STD is added to each velocity. FAULT_YAW_STD is added
    about the vertical, since gravity still determines roll and pitch.

    Parameters
    ----------
    odometry : Odometry
        Estimates.
    size : (3,) array
        Size of the workspace, in m.
    """
    covariance = odometry.covariance.copy()
    x, y, z, w = odometry.q.T
    # world z axis in the body frame
    up = np.stack([2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x**2 + y**2)], axis=1)
    covariance[:, :3, :3] += np.diag(size**2)
    covariance[:, 3:6, 3:6] += FAULT_SPEED_STD**2 * np.eye(3)
    covariance[:, 6:, 6:] += FAULT_YAW_STD**2 * up[:, :, None] * up[:, None, :]
    return replace(odometry, covariance=covariance)
