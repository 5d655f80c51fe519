"""What a rule says when it finds something wrong."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

# the estimate is wrong; it may be worse than it could be; good to know
ERROR, WARNING, NOTE = "error", "warning", "note"
SEVERITIES = (ERROR, WARNING, NOTE)


@dataclass(frozen=True)
class Finding:
    """rule : its name, for machines; severity : of SEVERITIES; cause : what is wrong, a clause; evidence : the numbers
    that show it; remedy : a line to copy; value : the number that decided, in SI units."""

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


def most_severe_first(findings: Iterable[Finding]) -> list[Finding]:
    """The findings in order of severity; within one in the order in which they came."""
    return sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))
