"""What a rule says when it finds something wrong."""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

# the estimate is wrong; it may be worse than it could be; good to know
ERROR, WARNING, NOTE = "error", "warning", "note"
SEVERITIES = (ERROR, WARNING, NOTE)
# ERRORs by which the position is wrong, and its stated deviation too small; rules over a survey are
# among them whatever they are called
POSITION_WRONG = frozenset(
    [
        "tdoa_sign",
        "tdoa_one_sign",
        "tdoa_large",
        "tdoa_unit",
        "two_tags",
        "ids_unknown",
        "ids_exchanged",
        "anchor_scale",
        "tdoa_clipped",
        "stamps_unit",
        "stamps_coarse",
    ]
)
SURVEY = "survey"
WRONG_WITH_IMU = frozenset(  # the same while the filter uses the IMU
    [
        "imu_force_unit",
        "imu_no_gravity",
        "imu_rate_unit",
        "imu_turned",
        "imu_axes",
        "imu_silent",
        "imu_axis_dead",
        "stamps_apart",
    ]
)
# share by which the number that decided may change until a finding that goes on is said anew
SAME = 0.3
# share of TDOAs with unknown ids, which are not used: below it the others determine the position
FEW_UNKNOWN = 0.5


@dataclass(frozen=True)
class Finding:
    """rule : its name, for machines; severity : of SEVERITIES; cause : what is wrong, a clause;
    evidence : the numbers that show it; remedy : a line to copy; value : the number that decided,
    in SI units.
    """

    rule: str
    severity: str
    cause: str
    evidence: str
    remedy: str
    value: float

    @property
    def sentence(self) -> str:
        """All of it in one line, for /diagnostics."""
        return f"{self.cause} ({self.evidence}): {' '.join(self.remedy.split())}"

    @property
    def brief(self) -> str:
        """The same without the evidence."""
        return f"{self.cause}: {' '.join(self.remedy.split())}"

    def position_wrong(self, imu_used: bool = True) -> bool:
        """Return whether it makes the position wrong. imu_used : whether the filter uses the IMU."""
        if self.severity != ERROR or (self.rule == "ids_unknown" and self.value < FEW_UNKNOWN):
            return False
        return (
            self.rule in POSITION_WRONG
            or self.rule.startswith(SURVEY)
            or (imu_used and self.rule in WRONG_WITH_IMU)
        )


def most_severe_first(findings: Iterable[Finding]) -> list[Finding]:
    """The findings in order of severity; within one in the order in which they came."""
    return sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))


class Steady:
    """Keeps the text of each finding that goes on: numbers in it would be others each second."""

    def __init__(self) -> None:
        self._said: dict[
            tuple[str, str], Finding
        ] = {}  # by rule and severity, as it was found first

    def __call__(self, findings: Iterable[Finding]) -> list[Finding]:
        """The findings, each as it was first said, as long as it goes on and the number that
        decided is much the same.
        """
        out = []
        for finding in findings:
            said = self._said.get((finding.rule, finding.severity), finding)
            out.append(said if _much_alike(said.value, finding.value) else finding)
        self._said = {(finding.rule, finding.severity): finding for finding in out}
        return out


def _much_alike(one: float, other: float) -> bool:
    return abs(one - other) <= SAME * max(abs(one), abs(other)) or (
        math.isnan(one) and math.isnan(other)
    )
