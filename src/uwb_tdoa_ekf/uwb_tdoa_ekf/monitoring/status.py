"""Whether the odometry may be flown by, for who does: one decision, from what the Estimator says of
itself, and from what is found.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
from typing import TYPE_CHECKING

import numpy as np

from ..results import Odometry
from .use import SILENT

if TYPE_CHECKING:
    from collections.abc import Sequence

    from ..estimator import Estimator
    from ..streams.finding import Finding
    from .use import Use

YAW_KNOWN = math.radians(
    20.0
    # rad; while four yaws are followed it is 100 degrees, with one left below 20: docs/reliability.md
)
ANY_YAW, ANY_SPEED = math.pi, 2.0  # rad and m/s, stated while a fault makes everything wrong
WAITING, STARTING, RUNNING, LOST, FAULT = range(5)  # as in EstimatorStatus


@dataclass(frozen=True)
class Status:
    """status : one of the above; why : what keeps it from being flown by, a sentence, "" if nothing
    does.
    """

    status: int
    yaw_known: bool
    why: str

    @property
    def lost(self) -> bool:
        """Whether it ran, and does not know any more where the tag is."""
        return self.status == LOST


def yaw_in_words(std: float) -> str:
    """Text on a yaw of a standard deviation, rad, NaN without odometry."""
    if math.isnan(std):
        return "unknown: there is no odometry"
    return f"{'known' if std <= YAW_KNOWN else 'not known yet'}: +-{math.degrees(std):.0f} degrees"


def fault_of(findings: Sequence[Finding], use: Use, left_out: Finding | None) -> Finding | None:
    """The most severe of Findings that makes the position wrong, or None. left_out : by which the
    filter goes without the IMU, or None.
    """
    imu_used = use.imu_used and left_out is None
    return next((finding for finding in findings if finding.position_wrong(imu_used)), None)


def status_of(
    estimator: Estimator | None,
    yaw_std: float,
    odometry_age: float,
    use: Use,
    findings: Sequence[Finding] = (),
) -> Status:
    """Status of an Estimator, None without anchors. yaw_std : rad, NaN without odometry;
    odometry_age : s since there was one; findings : what stands, most severe first.
    """
    if estimator is None:
        return Status(
            WAITING,
            False,
            "there are no anchors yet: publish them on uwb/anchors, or set anchors_file",
        )
    if estimator.lost:
        return Status(LOST, False, estimator.lost)
    left_out = estimator.without_imu
    fault = fault_of(findings, use, left_out)
    if not estimator.running:
        if fault is not None:
            return Status(FAULT, False, fault.sentence)
        if use.arrival_age > SILENT:
            return Status(WAITING, False, "there are no TDOAs: see /diagnostics")
        restarted = estimator.restarted
        return Status(
            STARTING,
            False,
            use.trouble
            or (restarted.sentence if restarted else "the start position is looked for"),
        )
    known = yaw_std <= YAW_KNOWN
    if fault is not None:
        return Status(FAULT, False, fault.sentence)
    if odometry_age > SILENT:
        why = "neither TDOAs nor inertial samples are used: there is no odometry; see /diagnostics"
        return Status(WAITING, False, why)
    return Status(RUNNING, known, _why(estimator, use, known, findings))


def _why(estimator: Estimator, use: Use, known: bool, findings: Sequence[Finding]) -> str:
    """What keeps a filter that runs, and has no fault, from being flown by."""
    left_out = estimator.without_imu
    if estimator.unsure:
        return estimator.unsure
    if use.tdoa_age > SILENT:
        said = use.trouble or f"no TDOA was used for more than {SILENT:g} s"
        sources = [
            *(["the IMU"] if use.imu_used and left_out is None else []),
            *(["the velocities"] if use.velocity_used else []),
        ]
        way = (
            f"by {' and '.join(sources)} alone"
            if sources
            else "on as the tag moved last, without the IMU and without velocities,"
        )
        return f"{said}: the position goes {way} and drifts"
    if use.trouble:
        return use.trouble
    if not known and left_out is not None:
        return f"the yaw is not known, because the filter goes without the IMU: {left_out.sentence}"
    if not known and estimator.yaw_doubts:
        return (
            "the yaw was wrong, and is looked for again: do not steer by it; it is known once the "
            "tag has moved"
        )
    if not known and not (use.imu_used or use.velocity_used):
        return (
            "the yaw is not known, because neither an IMU nor velocities are used: do not steer "
            "by it; give imu/data, or odometry of wheels"
        )
    if not known:
        return (
            "the yaw is not known yet: do not steer by it; it is once the tag has moved, or if it "
            "is told (initialpose)"
        )
    return findings[0].sentence if findings and findings[0].severity == "error" else ""


def doubted(odometry: Odometry, size: np.ndarray) -> Odometry:
    """Return Odometry with a covariance of a tag that may be anywhere in its workspace and have any
    yaw. size : (3,) m, of that.
    """
    covariance = odometry.covariance.copy()
    x, y, z, w = odometry.q.T
    up = np.stack(
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x**2 + y**2)], axis=1
    )  # of the world, in the body
    covariance[:, :3, :3] += np.diag(size**2)
    covariance[:, 3:6, 3:6] += ANY_SPEED**2 * np.eye(3)
    covariance[:, 6:, 6:] += ANY_YAW**2 * up[:, :, None] * up[:, None, :]
    return replace(odometry, covariance=covariance)
