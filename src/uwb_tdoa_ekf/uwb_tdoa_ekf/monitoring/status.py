"""Whether the odometry may be flown by, for who does: one decision, from what the Estimator says of itself."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ..estimator import Estimator

YAW_KNOWN = math.radians(20.0)  # rad; while four yaws are followed it is 100 degrees, with one left below 20: docs/reliability.md
SILENT = 1.0  # s without TDOAs that are said: the position then goes by the IMU alone
WAITING, STARTING, RUNNING, LOST = range(4)  # as in EstimatorStatus


@dataclass(frozen=True)
class Status:
    """status : one of the above; why : what keeps it from being flown by, a sentence, "" if nothing does."""

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


def status_of(estimator: Estimator | None, yaw_std: float, tdoa_age: float) -> Status:
    """Status of an Estimator, None without anchors. yaw_std : rad, NaN without odometry; tdoa_age : s since a TDOA arrived, inf
    before the first."""
    if estimator is None:
        return Status(WAITING, False, "there are no anchors yet: publish them on uwb/anchors, or set anchors_file")
    if estimator.lost:
        return Status(LOST, False, estimator.lost)
    if not estimator.running:
        if tdoa_age > SILENT:
            return Status(WAITING, False, "there are no TDOAs: see /diagnostics")
        return Status(STARTING, False, "the start position is looked for")
    known = yaw_std <= YAW_KNOWN
    if tdoa_age > SILENT:
        return Status(RUNNING, known, f"no TDOA has come for more than {SILENT:g} s: the position goes by the IMU alone and drifts")
    if not known:
        return Status(
            RUNNING, False, "the yaw is not known yet: do not steer by it; it is once the tag has moved, or if it is told (initialpose)"
        )
    return Status(RUNNING, True, "")
