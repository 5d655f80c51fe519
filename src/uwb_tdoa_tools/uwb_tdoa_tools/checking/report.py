"""What `check` says: text for people, a dict for machines."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

from .. import command_lines
from ..outputs import as_json

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from uwb_tdoa_ekf.streams import Finding

    from .check import Report

SYMBOL = {"error": "ERROR", "warning": "warning", "note": "note"}


def text(report: Report) -> str:
    """Lines about one Report: the verdict first, then the findings, most severe first."""
    facts = ", ".join(
        f"{name} {value}" if name in ("TDOAs", "IMU") else value
        for name, value in report.facts.items()
    )
    out = [f"{report.recording}: {verdict(report.findings)}  ({facts})"]
    out += [f"  {end.topic} from {end.node}: {end.qos}" for end in report.ends if end.publishes]
    for finding in report.findings:
        out += lines(finding)
    return "\n".join(out)


def verdict(findings: Sequence[Finding]) -> str:
    """In a few words."""
    counts = {severity: sum(f.severity == severity for f in findings) for severity in SYMBOL}
    if not counts["error"] and not counts["warning"]:
        return "OK" if not counts["note"] else "OK, with a remark"
    return ", ".join(
        f"{count} {severity}{'s' * (count > 1)}" for severity, count in counts.items() if count
    )


def lines(finding: Finding) -> Iterator[str]:
    """Lines of text about one Finding."""
    yield f"  {SYMBOL[finding.severity]}: {finding.cause}"
    yield f"      seen:   {finding.evidence}"
    first, *more = command_lines.as_it_runs(finding.remedy).splitlines()
    yield f"      remedy: {first}"
    for line in more:
        yield f"              {line}"


def as_dict(reports: Iterable[Report], together: Iterable[Finding]) -> dict[str, Any]:
    """For JSON: {"recordings": [{"recording", "facts", "findings", "ends"}], "together": [findings
    about several recordings]}; ends : who publishes and hears live topics.
    """
    return {
        "recordings": [
            {
                "recording": r.recording,
                "facts": r.facts,
                "findings": [_finding(f) for f in r.findings],
                "ends": [asdict(end) for end in r.ends],
            }
            for r in reports
        ],
        "together": [_finding(f) for f in together],
    }


def _finding(finding: Finding) -> dict[str, Any]:
    return as_json(asdict(finding))
