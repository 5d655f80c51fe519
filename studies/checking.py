# Copyright uwb_tdoa maintainers
# SPDX-License-Identifier: Apache-2.0
"""checking: put mistakes of drivers, surveys and clocks into flights, and count what `check` reports.

The unchanged flights are judged, too. With --healthy, recordings of ten kinds without a mistake are
judged instead: every error, and every warning about anchors, is false.
"""

from functools import partial
from pathlib import Path

from mistakes import MISTAKES, arriving
import numpy as np

from uwb_tdoa_bias.common.survey import read_survey
from uwb_tdoa_ekf.monitoring.finding import ERROR, WARNING
from uwb_tdoa_tools import choices, cli
from uwb_tdoa_tools.checking.check import check
from uwb_tdoa_tools.checking.recording import of_flight
from uwb_tdoa_tools.checking.tdoa_rules import largest_displacement
from uwb_tdoa_tools.readers import inputs
from uwb_tdoa_tools.readers.streams import protocol

from . import table
from .healthy import KINDS, healthy

# rules of warnings that blame anchors
OF_SINGLE = {
    "anchor_changed",
    "anchor_displaced",
    "anchor_silent",
    "anchor_missing",
    "survey_differs",
}
ANOTHER = 0.3  # m that an anchor of another room is elsewhere at least


def add_options(add):
    """add : add_argument of a parser."""
    add("flights", nargs="+", metavar="FLIGHT", help=choices.RECORDINGS)
    words = "judge healthy recordings of ten kinds instead; FLIGHT: those that are cut to pieces"
    add("--healthy", action="store_true", help=words)
    add("--survey", required=True, metavar="DIR", help="folder of all surveys")
    add(
        "--only",
        nargs="+",
        metavar="MISTAKE",
        choices=[*MISTAKES, "nothing"],
        help=f"of {', '.join(MISTAKES)}, nothing",
    )
    table.add_options(add, draws=20)


def run(args):
    """Print the table."""
    reading = inputs.Reading(args.survey)
    found = reading.find(args.flights)
    if args.healthy:
        show_healthy(found, reading, args)
        return
    surveys = [
        (path.name, read_survey(path)) for path in sorted(Path(args.survey).glob("anchor_?*"))
    ]
    kinds = [(survey, protocol(reading.read((path, survey)).tdoa)) for path, survey in found]
    tasks = [
        (number, recording, _partner(number, found, kinds))
        for number, recording in enumerate(found)
    ]
    judge = partial(judge_flight, reading=reading, surveys=surveys, only=args.only)
    said = table.results(judge, tasks, args, unit="flight")
    cli.show(markdown([row for rows in said for row in rows]))


def show_healthy(found, reading, args):
    """Print false errors and false warnings about anchors, for each kind."""
    cli.show(table.head("kind", "errors", "about anchors", "recordings", "errors", "warnings"))
    judge = partial(judge_healthy, found=found, reading=reading)
    for kind, said in table.trials(judge, KINDS, args):
        errors, warnings = (
            [rule for one in said for rule in one[severity]] for severity in (ERROR, WARNING)
        )
        named = (", ".join(sorted(rules)) for rules in (errors, warnings))
        counts = (sum(bool(one[severity]) for one in said) for severity in (ERROR, WARNING))
        cli.show(table.line([kind, *named, len(said), *counts]))


def judge_healthy(item, found, reading):
    """{ERROR: rules, WARNING: rules about single anchors} of (kind, seed)."""
    findings = check(of_flight(healthy(*item, found, reading))).findings
    said = {ERROR: [], WARNING: []}
    for one in findings:
        if one.severity == ERROR or (one.severity == WARNING and one.rule in OF_SINGLE):
            said[one.severity].append(one.rule)
    return said


def _partner(number, found, kinds):
    """(path, survey) of another flight with the same survey and protocol, or None: whose tag may
    fly along.
    """
    same = [
        recording for k, recording in enumerate(found) if k != number and kinds[k] == kinds[number]
    ]
    return same[number % len(same)] if same else None


def judge_flight(task, reading, surveys, only=None):
    """[{"flight", "live", "mistake", "said": {rule: severity}, "named": bool}] of one flight:
    (number, recording, partner).

    Flights with an even number are judged as bags recorded live, with arrival times. The remaining
    flights are judged as logs, which have only stamps.
    """
    number, recording, partner = task
    flight = of_flight(reading.read(recording))
    other = of_flight(reading.read(partner)) if partner else None
    live = number % 2 == 0
    rooms = [
        anchors for _, anchors in surveys if largest_displacement(anchors, flight.anchors) > ANOTHER
    ]
    rows = []
    for name in ["nothing", *MISTAKES] if only is None else only:
        mistake = MISTAKES.get(name)
        if mistake and not possible(mistake, flight, other, rooms):
            continue
        rng = np.random.default_rng([number, *name.encode()])
        arrives = live or (mistake is not None and "live" in mistake.needs)
        made = arriving(flight, number) if arrives else flight
        if mistake:
            second = rooms[int(rng.integers(len(rooms)))] if mistake.needs == "rooms" else other
            made = mistake.make(made, rng, second)
        report = check(made, [] if mistake and mistake.alone else surveys)
        said = {finding.rule: finding.severity for finding in report.findings}
        named = (
            any(rule in said for rule in mistake.named) if mistake else ERROR not in said.values()
        )
        rows.append(
            {"flight": flight.name, "live": arrives, "mistake": name, "said": said, "named": named}
        )
    return rows


def possible(mistake, flight, other, rooms):
    """Whether a flight can have the mistake."""
    return not (
        ("imu" in mistake.needs and flight.imu is None)
        or (mistake.needs in ("tdoa2", "tdoa3") and mistake.needs != protocol(flight.tdoa))
        or (mistake.needs == "other" and other is None)
        or (mistake.needs == "rooms" and not rooms)
    )


def markdown(rows):
    """Markdown: a line for each mistake, with how often `check` named it.

    A column lists other rules that it reported, unless it reports them without the mistake, too.
    """
    lines = [table.head("mistake", "what else was said", "named", "flights", texts=2)]
    for name in dict.fromkeys(row["mistake"] for row in rows):
        mine = [row for row in rows if row["mistake"] == name]
        usual = _of_flights(rows) if name in MISTAKES else {}
        besides = {}
        for row in mine:
            expected = set(MISTAKES[name].named) if name in MISTAKES else set()
            for rule in row["said"].keys() - expected - usual.get(row["flight"], set()):
                besides[rule] = besides.get(rule, 0) + 1
        text = MISTAKES[name].text if name in MISTAKES else "nothing: no error is said"
        said = ", ".join(
            f"{rule} {count}" for rule, count in sorted(besides.items(), key=lambda item: -item[1])
        )
        lines.append(table.line([text, said, sum(row["named"] for row in mine), len(mine)]))
    return "\n".join(lines)


def _of_flights(rows):
    """{flight: rules that stand without any mistake}."""
    return {row["flight"]: set(row["said"]) for row in rows if row["mistake"] == "nothing"}
