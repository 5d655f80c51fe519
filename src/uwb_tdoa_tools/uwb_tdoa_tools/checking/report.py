# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""Write the findings of `check` as text and JSON, and as remarks of tools that estimate."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
import math
from pathlib import Path
from typing import Any

import numpy as np

from uwb_tdoa_bias.common.errors import InputError
from uwb_tdoa_bias.common.flight import Flight
from uwb_tdoa_bias.effects.base import listed
from uwb_tdoa_ekf.monitoring.finding import Finding

from .. import cli, command_lines
from ..cli import as_json
from ..estimate import FlightEstimator
from ..parallel import Progress
from ..readers.inputs import Reading
from .check import Report, check, different_surveys
from .ordered import OrderedRecording, displacement
from .recording import Recording, of_flight, read_recording
from .tdoa_rules import SAME, gained, largest_displacement
from .watch import BEFORE_TRUTH, EXCHANGED, FIRST

# the rule of `check` for a survey that does not fit without another mistake
MISFIT = "survey_misfit"
# largest median shift of the anchors, in standard deviations, that a calibration can correct
LARGEST_SHIFT = 3.0
SYMBOL = {"error": "ERROR", "warning": "warning", "note": "note"}


def text(report: Report) -> str:
    """Return the lines about one Report: the verdict first, then the findings, most severe first."""
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
    """Return the verdict in a few words."""
    counts = {severity: sum(f.severity == severity for f in findings) for severity in SYMBOL}
    if not counts["error"] and not counts["warning"]:
        return "OK" if not counts["note"] else "OK, with a remark"
    return ", ".join(
        f"{count} {severity}{'s' * (count > 1)}" for severity, count in counts.items() if count
    )


def lines(finding: Finding) -> Iterator[str]:
    """Yield the lines of text about one Finding."""
    yield f"  {SYMBOL[finding.severity]}: {finding.cause}"
    yield f"      seen:   {finding.evidence}"
    first, *more = command_lines.as_it_runs(finding.remedy).splitlines()
    yield f"      remedy: {first}"
    for line in more:
        yield f"              {line}"


def as_dict(reports: Iterable[Report], together: Iterable[Finding]) -> dict[str, Any]:
    """Return the content for JSON.

    {"recordings": [{"recording", "facts", "findings", "ends"}], "together": [findings about several
    recordings]}. "ends" are publishers and subscriptions of live topics.
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


SHORTEST = 10.0  # s; shorter flights get no remark


def survey_remarks(flight: Flight) -> Iterator[str]:
    """Yield sentences about the survey of a Flight: missing anchors, and positions that cannot be right.

    The test is how much moving the anchors explains (see SurveyFit).

    Raises
    ------
    InputError
        If no TDOA is between two anchors of the survey.
    """
    tdoa, anchors = flight.tdoa, flight.anchors
    known = (anchors.index(tdoa.a) >= 0) & (anchors.index(tdoa.b) >= 0)
    heard = np.unique([tdoa.a, tdoa.b])
    lacking = heard[anchors.index(heard) < 0].tolist()
    if len(tdoa) and not known.any():
        raise InputError(
            f"{flight.name}: the tag hears anchors {_listed(heard)}, the survey has "
            f"{_listed(anchors.ids)}, and no "
            "TDOA is between two that it has; give the survey of that room."
        )
    if lacking:
        share = 100.0 * np.mean(~known)
        yield (
            f"the survey has no anchor {_listed(lacking)}: {share:.0f} % of the TDOAs are not "
            "used; survey it, too."
        )
    if not (len(tdoa) and np.ptp(tdoa.t) > SHORTEST):
        return
    recording = of_flight(flight)
    if gained(OrderedRecording.of(recording).survey_fit) is not None:
        causes = [
            f"{one.cause}: {one.evidence}; {one.remedy}."
            for one in check(recording).findings
            if one.rule in BEFORE_TRUTH
        ]
        yield from causes or [
            (
                "the survey does not fit the TDOAs: of another room, or anchors have been moved; "
                "`check` says more."
            )
        ]


def _listed(ids: Iterable[int]) -> str:
    return ", ".join(map(str, ids))


def remarks_on(
    flights: Sequence[Flight], surveys: Sequence[str | Path | None] = ()
) -> Iterator[str]:
    """Yield sentences on the surveys of Flights, each alone and in comparison.

    surveys : files of the surveys, as of `remark_on_surveys`; () to name none
    """
    for flight in flights:
        yield from (f"{flight.name}: {remark}" for remark in survey_remarks(flight))
    yield from (
        f"{finding.cause}: {finding.evidence}; {finding.remedy}."
        for finding in different_surveys(flights)
    )
    if surveys:
        yield from remark_on_surveys(surveys, flights)


def nothing_comes_first(
    command: str, reading: Reading, paths: Sequence[str], estimator: FlightEstimator, std: float
) -> bool:
    """Return whether `check` finds no mistake that looks like misplaced anchors.

    These are mistakes of ids, signs, units and the scale of the survey, and a survey of another
    room. They are printed, and a command that estimates anchors must stop.

    command : name of the command, for its messages; reading : how recordings are read
    paths : files and folders to read; raises InputError
    std : standard deviation of a coordinate of an anchor as given, m
    """
    found, misfits = [], []
    with Progress(command) as progress:
        for path, survey in progress.over(reading.find(paths), "checking recordings"):
            recording = read_recording(reading, path, survey)
            findings = check(recording, others=(), estimator=estimator).findings
            found += [finding for finding in findings if finding.rule in (*FIRST, EXCHANGED)]
            off = misfit_beyond(recording, findings, std)
            if off is not None:
                misfits.append((recording.name, off))
                found += [finding for finding in findings if finding.rule == MISFIT]
    for finding in found:
        cli.show(*lines(finding))
    if misfits:
        needed = max(off for _, off in misfits) / LARGEST_SHIFT
        cli.say(
            command,
            f"stopped, and nothing is written: the survey does not fit {listed(n for n, _ in misfits)}"
            ", as said above. Give the survey of that room. If its anchors can be off by that much, "
            f"survey improves them with --std {math.ceil(20.0 * needed) / 20.0:g} (m, standard "
            f"deviation of a coordinate; {std:g} is assumed).",
        )
    elif found:
        cli.say(
            command,
            "stopped, and nothing is written: ids, signs, units and scale first, as said above; "
            "then "
            "anchors.",
        )
    return not found


def misfit_beyond(recording: Recording, findings: Iterable[Finding], std: float) -> float | None:
    """Return by how much anchors are off in the median, m, if that is beyond their accuracy.

    None if no finding is about a survey that does not fit, or if a calibration can correct that.
    std : standard deviation of a coordinate of an anchor, m
    """
    if not any(finding.rule == MISFIT for finding in findings):
        return None
    fit = OrderedRecording.of(recording).survey_fit
    off = float(np.median(displacement(fit.positions, fit.all_moved[1])))
    return off if off > LARGEST_SHIFT * std else None


def remark_on_surveys(
    surveys: Sequence[str | Path | None], recordings: Sequence[Recording | Flight]
) -> Iterator[str]:
    """Yield a sentence if some recordings have different surveys of one installation.

    surveys : their files, None for the anchors of a bag
    """
    off = [largest_displacement(recordings[0].anchors, one.anchors) for one in recordings]
    if not any(0.0 < distance <= SAME for distance in off):
        return
    names: dict[str, list[str]] = {}
    for survey, one in zip(surveys, recordings):
        names.setdefault("the anchors in the bag" if survey is None else str(survey), []).append(
            one.name
        )
    if len(names) < 2:
        return
    each = "; ".join(f"{', '.join(of)}: {survey}" for survey, of in names.items())
    apart = max(distance for distance in off if distance <= SAME)
    yield (
        f"the flights have different surveys ({each}), in which the same ids are up to "
        f"{100.0 * apart:.1f} cm apart. Each flight is used with its own, one correction is fitted to "
        f"all, and what is written and printed for the nodes is for {next(iter(names))}."
    )
